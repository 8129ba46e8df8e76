"""The figures of pages as files for papers: vectors, as wide as printed, in the page's looks."""

from __future__ import annotations

import copy
import json
import re
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure
from report_runs import dwell_plan, write_run
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core.errors import DataError
from hil.report import colours, render_report
from hil.report import plotly_figures as figures
from hil.report.blocks import Badge, Page, Panel, Plots, Section
from hil.report.drift_figures import Along
from hil.report.encode import figure_json
from hil.report.page_figures import PagePanel, figures_of
from hil.report.paper_plots import drawn_plots
from hil.report.render import write_page
from hil.report.traces import axes, line

OLD = Path(__file__).with_name("old_page.html")
MM = {"column": 88.0, "page": 181.0}
T = np.arange(2000) / 125.0
NOISE = np.random.default_rng(0).standard_normal(2000)
DATES = Along(("2026-11-22 10:00:00", "2026-11-23 10:00:00"), "time [UTC]", changes=(
    ("2026-11-22 12:00:00", "v2"),))  # fmt: skip
TWO = np.array([1e-9, 1.0])
LOG = {
    "data": [DATES.placed(line(TWO, TWO, "chance", colours.MEASURED), range(2))],
    "layout": DATES.layout("probability [1]", yaxis={"type": "log", "title": {"text": "p [1]"}}),
}
KINDS = {
    "time": figures.measured_predicted(T, NOISE, NOISE, "A", "motor current"),
    "band": figures.residual_over(T, NOISE, "velocity [°/s]", "A", 0.1),
    "regression": figures.regression(NOISE, NOISE, "A"),
    "bars": figures.rmse_bars(["J1", "J2"], {"a": T[:2], "b": T[1:3]}, ("noise", T[:2]), "A"),
    "grid": figures.coverage(T, NOISE, "position [°]", "velocity [°/s]"),
    "dates and powers": LOG,
}


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with a plot of every kind."""
    panels = tuple(Panel(name, figure, "What it shows.") for name, figure in KINDS.items())
    wide = tuple(Panel(name, KINDS["time"], "Wide.", True) for name in ("Heat, limit", "Error"))
    blocks = (Plots("Every kind", "", panels), Plots("Over time", "", wide))
    sections = (Section("kinds", "Kinds", "", blocks),)
    out = tmp_path_factory.mktemp("page") / "page.html"
    return write_page(Page("p", "", Badge("", ""), "", sections=sections), out)


def streams_of(pdf: bytes) -> bytes:
    found = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", pdf, re.DOTALL)
    return b"".join(zlib.decompress(each) for each in found if each[:1] == b"\x78")


def read(page: Path, name: str) -> PagePanel:
    return next(panel for panel in figures_of(page)[0].panels if panel.title == name)


def test_a_page_gives_back_what_it_was_made_of(page: Path) -> None:
    every, *wide = figures_of(page)
    assert [panel.title for panel in every.panels] == list(KINDS)
    assert [each.title for each in wide] == ["Heat, limit", "Error"]
    time = every.panels[0]
    assert (time.x_title, time.y_title) == ("time [s]", "motor current [A]")
    shown = KINDS["time"]["data"][0]
    np.testing.assert_allclose(time.figure["data"][0]["y"], shown["y"], rtol=1e-6)
    assert read(page, "grid").figure["data"][0]["z"].shape == (48, 48)


@pytest.mark.parametrize("width", MM)
@pytest.mark.parametrize("name", KINDS)
def test_a_pdf_is_vectors_with_fonts_inside_as_wide_as_printed(
    page: Path, name: str, width: str
) -> None:
    pdf = drawn_plots([read(page, name)], "pdf", width)
    assert pdf[:5] == b"%PDF-"
    assert pdf.rstrip().endswith(b"%%EOF")
    assert b"/FontFile2" in pdf
    assert b"/Type3" not in pdf
    assert b"/Subtype /Image" not in pdf
    box = re.search(rb"/MediaBox \[ ?0 0 ([0-9.]+)", pdf)
    assert box is not None
    assert float(box[1]) / 72 * 25.4 == pytest.approx(MM[width], abs=0.1)


@pytest.mark.parametrize("name", KINDS)
def test_an_svg_is_well_formed_and_has_no_pixels(page: Path, name: str) -> None:
    svg = ElementTree.fromstring(drawn_plots([read(page, name)], "svg"))
    assert float(svg.attrib["width"].removesuffix("pt")) == pytest.approx(88 / 25.4 * 72, abs=0.3)
    tags = {each.tag.rpartition("}")[2] for each in svg.iter()}
    assert "path" in tags
    assert "image" not in tags


def test_colours_and_dashes_are_those_of_the_page(page: Path) -> None:
    svg = drawn_plots([read(page, "regression")], "svg").decode()
    for colour in (colours.MEASURED, colours.PREDICTED):
        assert colour.lower() in svg
    drawn = re.search(rf"[^>]*stroke: {colours.PREDICTED.lower()}[^>]*", svg)
    assert drawn is not None
    assert "stroke-dasharray" in drawn[0]


def test_equal_plots_are_equal_files(page: Path) -> None:
    assert drawn_plots([read(page, "bars")], "pdf") == drawn_plots([read(page, "bars")], "pdf")


@pytest.mark.parametrize("days", [0.001, 0.04, 1, 2, 9, 40, 90, 400, 4000])
def test_dates_are_told_over_any_span(days: float) -> None:
    ends = [str(np.datetime64("2026-11-22T10:00:00") + np.timedelta64(round(86400 * days * k), "s"))
            for k in (0, 1)]  # fmt: skip
    along = Along(tuple(ends), "time [UTC]")
    trace = along.placed(line(TWO, TWO, "chance", colours.MEASURED), range(2))
    figure = {"data": [trace], "layout": along.layout("probability [1]")}
    assert "xtick_2" in drawn_plots([PagePanel("", figure, False)], "svg").decode()


@pytest.mark.quick
def test_powers_and_names_are_no_tex(page: Path) -> None:
    text = drawn_plots([read(page, "dates and powers")], "svg").decode()
    assert re.search(r"<!-- 10⁻[⁰-⁹] -->", text)
    assert "mathdefault" not in text
    assert "<!-- v2 -->" in text.replace("<!--  v2 -->", "<!-- v2 -->")


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


def drawn_only(draw: Callable[[Figure], None], *given: object) -> bytes:
    """As `on_sheet`, without laying it out and saving it, which takes most of the time."""
    draw(Figure())
    return b""


@pytest.mark.parametrize("name", KINDS)
def test_a_damaged_figure_is_drawn_or_told_with_its_page_and_title(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = json.loads(figure_json(KINDS[name]))
    file, told = tmp_path / "page.html", list[str]()
    monkeypatch.setattr("hil.report.paper_plots.on_sheet", drawn_only)
    for place in places(whole):
        damaged = copy.deepcopy(whole)
        part: Any = damaged
        for key in place[:-1]:
            part = part[key]
        del part[place[-1]]
        text = f'<h3>a</h3><figcaption>{name}</figcaption><script type="application/json">'
        file.write_text(f"{text}{json.dumps(damaged)}</script>", "utf-8")
        try:
            drawn_plots(figures_of(file)[0].panels, "svg")
        except DataError as error:
            told.append(error.message)
    assert len(told) >= 8
    assert all(str(file) in text and f"in the plot {name!r}" in text for text in told)


def test_axes_keep_their_titles() -> None:
    layout = axes("time [s]", "<b> & error [A]")
    assert PagePanel("", {"data": [], "layout": layout}, False).y_title == "<b> & error [A]"
