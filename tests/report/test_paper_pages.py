"""The figures of pages as files for papers: vectors, as wide as printed, in the page's looks."""

from __future__ import annotations

import copy
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
from hil.core.errors import DataError
from hil.report import colours, render_report
from hil.report.drift_page import Along
from hil.report.matplotlib_figure import drawn
from hil.report.page import Badge, Page, Section, write_page
from hil.report.plotly_figure import figure_json, figures_of, panel_of, plotly_of
from hil.studies.figure import Curve, Figure, Look, Panel
from tests.report.test_figures import PANELS
from tests.support.paths import FILES
from tests.support.report_runs import dwell_plan, write_run

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


def streams_of(pdf: bytes) -> bytes:
    found = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", pdf, re.DOTALL)
    return b"".join(zlib.decompress(each) for each in found if each[:1] == b"\x78")


def read(page: Path, name: str) -> Figure:
    every = figures_of(page)[0].figure
    return replace(every, panels=tuple(p for p in every.panels if p.title == name))


def test_a_page_gives_back_what_it_was_made_of(page: Path) -> None:
    every, *wide = (placed.figure for placed in figures_of(page))
    assert [panel.title for panel in every.panels] == list(KINDS)
    assert [each.title for each in wide] == ["Heat, limit", "Error"]
    joints = next(panel for panel in every.panels if panel.title == "joints")
    assert (joints.x_title, joints.y_title) == ("x [s]", "y [A]")
    np.testing.assert_allclose(joints.curves[0].y, KINDS["joints"].curves[0].y, rtol=1e-6)
    (grid,) = read(page, "grid").panels
    assert grid.grid is not None
    assert grid.grid.log_count.shape == (48, 48)


@pytest.mark.thorough
@pytest.mark.parametrize("width", MM)
@pytest.mark.parametrize("name", KINDS)
def test_a_pdf_is_vectors_with_fonts_inside_as_wide_as_printed(
    page: Path, name: str, width: str
) -> None:
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
def test_a_run_gives_its_report_and_a_page_what_stands_in_it(tmp_path: Path, page: Path) -> None:
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
        figures_of(file)


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


@pytest.mark.thorough
@pytest.mark.parametrize("name", KINDS)
def test_a_damaged_figure_is_drawn_or_told_with_its_page_and_title(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = json.loads(figure_json(plotly_of(KINDS[name])))
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
            drawn(figures_of(file)[0].figure, "svg")
        except DataError as error:
            told.append(error.message)
    assert len(told) >= 8
    assert all(str(file) in text and f"in the plot {name!r}" in text for text in told)


def test_axes_keep_their_titles() -> None:
    shown = plotly_of(Panel("", "time [s]", "<b> & error [A]", ()))
    assert panel_of(json.loads(figure_json(shown)), "").y_title == "<b> & error [A]"
