"""Figures and tables as files for papers."""

from __future__ import annotations

import csv
import io
import re
import zlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import hil
from hil.core.errors import DataError, SpecError
from hil.report.matplotlib_figure import drawn
from hil.report.paper import csv_text, figures, items, latex_text
from hil.studies.figure import Curve, Figure, Panel
from hil.studies.result import Part, StudyResult, Table
from hil.studies.store import write_study
from tests.support.study_parts import bars, curve, result, six_panels

SIZE = {"column": 88.0, "page": 181.0}
TABLE = Table(
    "table-2",
    "RMSE & time",
    ("method", "J1 [A]", "R², %"),
    (("LS_1", 0.25, 99), ("LASSO, α = 0.001", 0.0125, None), ("[net]", float("nan"), -3)),
    "Both of 50 % of the rows.",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run")
    write_study(result(bars(), tables=(TABLE,)), path / "study" / "counted-1")
    return path


def width_mm(pdf: bytes) -> float:
    found = re.search(rb"/MediaBox \[ ?0 0 ([0-9.]+)", pdf)
    assert found is not None
    return float(found[1]) / 72 * 25.4


def streams_of(pdf: bytes) -> bytes:
    found = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", pdf, re.DOTALL)
    return b"".join(zlib.decompress(each) for each in found if each[:1] == b"\x78")


@pytest.mark.thorough
def test_every_figure_and_table_becomes_files_named_by_its_key(run: Path, tmp_path: Path) -> None:
    written = hil.figures(run, tmp_path / "out", formats=("pdf", "png", "svg"))
    names = {"table-2.csv", "table-2.tex", "contents.md"}
    names |= {"fig-4.pdf", "fig-4.png", "fig-4.svg"}
    assert {path.name for path in written} == names
    assert {path.name for path in (tmp_path / "out").iterdir()} == names


@pytest.mark.parametrize("width", ["column", "page"])
def test_a_pdf_is_as_wide_as_it_is_printed(width: str) -> None:
    assert width_mm(drawn(bars(), "pdf", width)) == pytest.approx(SIZE[width], abs=0.1)


def test_fonts_are_embedded_as_outlines() -> None:
    pdf = drawn(bars(), "pdf")
    assert b"/FontFile2" in pdf
    assert b"/Type3" not in pdf


@pytest.mark.thorough
def test_no_panel_is_too_narrow_to_be_read() -> None:
    """Three side by side as asked for would be 29 mm wide in a column: two are."""
    column, page = (ElementTree.fromstring(drawn(six_panels(9), "svg", w)) for w in SIZE)
    assert sum(each.get("id", "").startswith("axes_") for each in column.iter()) == 6
    heights = [float(each.attrib["height"][:-2]) for each in (column, page)]
    assert heights[0] > 3 * 30 * 72 / 25.4  # three rows
    assert heights[1] < 3 * 50 * 72 / 25.4  # two


@pytest.mark.thorough
@pytest.mark.parametrize("format_", ["pdf", "svg", "png"])
def test_equal_figures_are_equal_files(format_: str) -> None:
    assert drawn(bars(), format_) == drawn(bars(), format_)


@pytest.mark.thorough
def test_a_long_line_is_thinned_and_keeps_its_extremes() -> None:
    x = np.arange(100_000.0)
    y = np.where(x == 77_777, 9.0, 0.0)
    long = Figure("f", "", "", (Panel("", "x", "y", (curve("spike", x, y),)),))
    pdf = drawn(long, "pdf")
    assert len(pdf) < 100_000
    flat = Figure("f", "", "", (Panel("", "x", "y", (curve("spike", x, 0 * y),)),))
    assert streams_of(pdf) != streams_of(drawn(flat, "pdf"))


@pytest.mark.thorough
@pytest.mark.parametrize(
    "panel",
    [
        Panel("no curve", "", "", ()),
        Panel("nothing known", "x [°]", "y", (Curve("a", (1.0,), (float("nan"),), "points"),)),
        Panel("$x_1$", "µ²", "Σ", (Curve("identity", style="identity"),), corner="$R$ = {1}"),
        Panel("names", "", "", (Curve("", ("a", "b"), (1.0, 2.0), "line", (0.1, 0.1)),)),
        Panel("long " * 30, "x " * 60, "y " * 60, (Curve("a", (1.0,), (2.0,), "bars"),)),
    ],
    ids=lambda panel: panel.title[:10],
)
def test_odd_panels_are_drawn_without_a_warning(panel: Panel) -> None:
    assert drawn(Figure("f", "", "", (panel, panel)), "png")[:4] == b"\x89PNG"


def test_csv_holds_all_digits_and_nothing_where_there_is_no_number() -> None:
    rows = list(csv.reader(io.StringIO(csv_text(TABLE))))
    assert rows[0] == list(TABLE.columns)
    assert rows[1] == ["LS_1", "0.25", "99"]
    assert rows[2] == ["LASSO, α = 0.001", "0.0125", ""]
    assert rows[3][1] == ""


def test_latex_is_a_booktabs_table_with_special_characters_escaped() -> None:
    lines = latex_text(TABLE).splitlines()
    assert lines[0] == "% RMSE & time"
    assert r"\begin{tabular}{lrr}" in lines
    assert r"method & J1 [A] & R$^2$, \% \\" in lines
    assert r"LS\_1 & 0.2500 & 99 \\" in lines
    assert r"LASSO, $\alpha$ = 0.001 & 0.0125 & -- \\" in lines
    assert r"{}[net] & -- & $-$3 \\" in lines
    assert [line for line in lines if line.endswith("rule")] == [
        r"\toprule",
        r"\midrule",
        r"\bottomrule",
    ]


def test_a_key_of_two_protocols_is_told_apart_by_them() -> None:
    parts = (
        Part("One", "honest", (), (TABLE,), (bars(),)),
        Part("Two", "paper: sees the target", (), (TABLE,)),
    )
    found = items([StudyResult("s", "S", (), parts)])
    assert [item.stem for item in found] == ["table-2-honest", "fig-4", "table-2-paper"]


def test_several_studies_of_a_run_are_told_apart_by_their_names() -> None:
    stems = [item.stem for item in items([result(bars()), result(bars(), study="other")])]
    assert stems == ["counted-fig-4", "other-fig-4"]
    same = [item.stem for item in items([result(bars()), result(bars())])]
    assert len(set(same)) == 2


def test_a_run_without_studies_and_report_says_how_to_make_it(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no report") as caught:
        figures(tmp_path, tmp_path)
    assert caught.value.hint == f"make it first: hil report {tmp_path}"


@pytest.mark.parametrize(("formats", "width"), [(("gif",), "column"), (("pdf",), "poster")])
def test_unknown_formats_and_widths_are_refused(
    run: Path, tmp_path: Path, formats: tuple[str, ...], width: str
) -> None:
    with pytest.raises(SpecError, match="there is no"):
        figures(run, tmp_path, formats=formats, width=width)
