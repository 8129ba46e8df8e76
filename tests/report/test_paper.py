"""Figures and tables as files for papers: of studies, and of pages."""

from __future__ import annotations

import copy
import csv
import io
import json
import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure as Sheet
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core.errors import DataError, SpecError
from hil.report import colours, render_report
from hil.report.drift_page import Along
from hil.report.matplotlib_figure import drawn
from hil.report.page import Badge, Page, Section, write_page
from hil.report.paper import csv_text, figures, items, latex_text
from hil.report.plotly_figure import figure_json, panel_of, placed_figures, plotly_of
from hil.studies.figure import Curve, Figure, Look, Panel
from hil.studies.result import Part, StudyResult, Table
from hil.studies.store import write_study
from tests.support.panels import PANELS
from tests.support.paths import FILES
from tests.support.report_runs import dwell_plan, write_run
from tests.support.study_parts import bars, curve, result, six_panels

# Figures and tables as files for papers


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
    assert caught.value.hint == f"write it first: hil report {tmp_path}"


@pytest.mark.parametrize(("formats", "width"), [(("gif",), "column"), (("pdf",), "poster")])
def test_unknown_formats_and_widths_are_refused(
    run: Path, tmp_path: Path, formats: tuple[str, ...], width: str
) -> None:
    with pytest.raises(SpecError, match=r"unknown (format|width)"):
        figures(run, tmp_path, formats=formats, width=width)


# The figures of pages as files for papers: vectors, as wide as printed, in the page's looks


OLD = FILES / "old_page.html"
MM = {"column": 88.0, "page": 181.0}
KINDS = {
    name: replace(panel, title=name, alt="What it shows.", wide=False)
    for name, panel in PANELS.items()
    if name not in ("identity", "ranges")
}


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with a plot of every kind."""
    wide = tuple(
        replace(KINDS["joints"], title=name, wide=True) for name in ("Heat, limit", "Error")
    )
    blocks = (
        Figure("k", "Every kind", "", tuple(KINDS.values()), 0),
        Figure("o", "Over time", "", wide, 0),
    )
    sections = (Section("kinds", "Kinds", "", blocks),)
    out = tmp_path_factory.mktemp("page") / "page.html"
    return write_page(Page("p", "", Badge("", ""), "", sections=sections), out)


def read(page: Path, name: str) -> Figure:
    every = placed_figures(page)[0].figure
    return replace(every, panels=tuple(p for p in every.panels if p.title == name))


def test_a_page_gives_back_what_it_was_made_of(page: Path) -> None:
    every, *wide = (placed.figure for placed in placed_figures(page))
    assert [panel.title for panel in every.panels] == list(KINDS)
    assert [each.title for each in wide] == ["Heat, limit", "Error"]
    joints = next(panel for panel in every.panels if panel.title == "joints")
    assert (joints.x_title, joints.y_title) == ("x [s]", "y [A]")
    np.testing.assert_allclose(joints.curves[0].y, KINDS["joints"].curves[0].y, rtol=1e-6)
    (grid,) = read(page, "grid").panels
    assert grid.grid is not None
    assert grid.grid.log_count.shape == (48, 48)


@pytest.mark.thorough
@pytest.mark.parametrize("name", KINDS)
def test_a_pdf_is_vectors_with_fonts_inside_as_wide_as_printed(page: Path, name: str) -> None:
    width = "page" if name in ("bars", "joints") else "column"
    pdf = drawn(read(page, name), "pdf", width)
    assert pdf[:5] == b"%PDF-"
    assert pdf.rstrip().endswith(b"%%EOF")
    assert b"/FontFile2" in pdf
    assert b"/Type3" not in pdf
    assert b"/Subtype /Image" not in pdf
    box = re.search(rb"/MediaBox \[ ?0 0 ([0-9.]+)", pdf)
    assert box is not None
    assert float(box[1]) / 72 * 25.4 == pytest.approx(MM[width], abs=0.1)


@pytest.mark.thorough
@pytest.mark.parametrize("name", KINDS)
def test_an_svg_is_well_formed_and_has_no_pixels(page: Path, name: str) -> None:
    svg = ElementTree.fromstring(drawn(read(page, name), "svg"))
    assert float(svg.attrib["width"].removesuffix("pt")) == pytest.approx(88 / 25.4 * 72, abs=0.3)
    tags = {each.tag.rpartition("}")[2] for each in svg.iter()}
    assert "path" in tags
    assert "image" not in tags


def test_colours_and_dashes_are_those_of_the_page(page: Path) -> None:
    svg = drawn(read(page, "regression"), "svg").decode()
    for colour in (colours.MEASURED, colours.PREDICTED):
        assert colour.lower() in svg
    dashed = re.search(rf"[^>]*stroke: {colours.PREDICTED.lower()}[^>]*", svg)
    assert dashed is not None
    assert "stroke-dasharray" in dashed[0]


@pytest.mark.thorough
def test_equal_plots_are_equal_files(page: Path) -> None:
    assert drawn(read(page, "bars"), "pdf") == drawn(read(page, "bars"), "pdf")


@pytest.mark.thorough
@pytest.mark.parametrize("days", [0.001, 0.04, 1, 2, 9, 40, 90, 400, 4000])
def test_dates_are_told_over_any_span(days: float) -> None:
    ends = [str(np.datetime64("2026-11-22T10:00:00") + np.timedelta64(round(86400 * days * k), "s"))
            for k in (0, 1)]  # fmt: skip
    along = Along(tuple(ends), "time [UTC]")
    curve = Curve("chance", ends, (1e-9, 1.0), look=Look(colours.MEASURED))
    panel = along.panel("", "probability [1]", [curve])
    assert "xtick_2" in drawn(Figure("", "", "", (panel,)), "svg").decode()


def test_powers_and_names_are_no_tex(page: Path) -> None:
    text = drawn(read(page, "powers"), "svg").decode()
    assert re.search(r"<!-- 10⁻[⁰-⁹] -->", text)
    assert "mathdefault" not in text
    dated = drawn(read(page, "dates"), "svg").decode()
    assert "<!-- v2 -->" in dated.replace("<!--  v2 -->", "<!-- v2 -->")


@pytest.mark.thorough
def test_a_run_gives_its_report_and_a_page_what_stands_in_it(
    tmp_path: Path, page: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.report.matplotlib_figure.on_sheet", drawn_only)
    run = write_run(tmp_path, dwell_plan(poses=6)).path
    render_report(run)
    told = {path.name for path in hil.figures(run, tmp_path / "of-run", formats=("svg",))}
    assert {"excitation-pose-map.svg", "recording-tracking-error.svg", "contents.md"} <= told
    done = CliRunner().invoke(app, ["figures", str(page), "-o", str(tmp_path / "of-page")])
    assert done.exit_code == 0, done.output
    names = {path.name for path in (tmp_path / "of-page").iterdir()}
    assert names == {"kinds-every-kind.pdf", "kinds-heat.pdf", "kinds-error.pdf", "contents.md"}
    assert "Kinds: Heat, limit." in (tmp_path / "of-page" / "contents.md").read_text("utf-8")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("<p>nothing</p>", "no plots"),
        ('<h3>a</h3><script type="application/json">{"layout": </script>', "damaged"),
        ('<script type="application/json">{}</script>', "damaged"),
        ('<h3>a</h3><script type="application/json">{"y": {"bdata": "AAA="}}</script>', "damaged"),
    ],
)
def test_what_is_no_page_of_hil_is_told(text: str, told: str, tmp_path: Path) -> None:
    file = tmp_path / "page.html"
    file.write_text(text, "utf-8")
    with pytest.raises(DataError, match=told):
        placed_figures(file)


@pytest.mark.thorough
def test_a_page_of_before_is_drawn_too(tmp_path: Path) -> None:
    out = tmp_path / "old"
    done = CliRunner().invoke(app, ["figures", str(OLD), "-o", str(out)])
    assert done.exit_code == 0, done.output
    assert (out / "kinds-every-kind.pdf").read_bytes()[:5] == b"%PDF-"


def places(part: Any, above: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where something stands in a document, but for numbers in arrays."""
    for key in part if isinstance(part, dict) else range(len(part)):
        yield (*above, key)
        if isinstance(part[key], dict | list):
            yield from places(part[key], (*above, key))


def drawn_only(draw: Callable[[Sheet], None], *given: object) -> bytes:
    """As `on_sheet`, without laying it out and saving it, which takes most of the time."""
    draw(Sheet())
    return b""


def short(panel: Panel) -> Panel:
    """The same with few points a curve: what is said of each point is a place in a document."""
    return replace(panel, curves=tuple(map(_short, panel.curves)))


def _short(curve: Curve) -> Curve:
    parts = {name: getattr(curve, name)[:40] for name in ("x", "y", "y_error", "hover")}
    return replace(curve, **parts)


@pytest.mark.thorough
@pytest.mark.parametrize("name", KINDS)
def test_a_damaged_figure_is_drawn_or_told_with_its_page_and_title(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = json.loads(figure_json(plotly_of(short(KINDS[name]))))
    file, told = tmp_path / "page.html", list[str]()
    monkeypatch.setattr("hil.report.matplotlib_figure.on_sheet", drawn_only)
    for place in places(whole):
        damaged = copy.deepcopy(whole)
        part: Any = damaged
        for key in place[:-1]:
            part = part[key]
        del part[place[-1]]
        text = f'<h3>a</h3><figcaption>{name}</figcaption><script type="application/json">'
        file.write_text(f"{text}{json.dumps(damaged)}</script>", "utf-8")
        try:
            drawn(placed_figures(file)[0].figure, "svg")
        except DataError as error:
            told.append(error.message)
    assert len(told) >= 8
    assert all(str(file) in text and f"in the plot {name!r}" in text for text in told)


def test_axes_keep_their_titles() -> None:
    shown = plotly_of(Panel("", "time [s]", "<b> & error [A]", ()))
    assert panel_of(json.loads(figure_json(shown)), "").y_title == "<b> & error [A]"
