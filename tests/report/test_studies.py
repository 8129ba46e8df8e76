"""What the page shows of studies."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil.core.errors import DataError, FitError
from hil.report import render_report
from hil.report.colours import looks_of
from hil.report.curves import diagonal, dressed, fewer
from hil.report.page import Badge, Page, Section, page_html
from hil.report.plotly_figure import plotly_of
from hil.report.study_sections import columns_of, study_sections
from hil.report.text import summary_lines
from hil.report.words import number
from hil.studies.figure import Curve, Figure, Panel
from hil.studies.result import Part, StudyResult, Table
from hil.studies.store import read_study, write_problem, write_study
from tests.support.report_runs import dwell_plan, write_run
from tests.support.study_parts import bars, curve, result, six_panels


def traces(figure: Figure, panel: int = 0) -> list[dict[str, object]]:
    data: list[dict[str, object]] = plotly_of(dressed(figure, 1200).panels[panel])["data"]
    return data


def test_parts_stand_open_below_the_summary() -> None:
    sections = study_sections([result(bars())])
    assert [(s.title, s.folded) for s in sections] == [
        ("Study: A study", False),
        ("Honest (honest protocol)", False),
    ]


def test_two_of_one_study_are_told_apart_by_what_they_were_asked_for() -> None:
    asked = [{"epochs": 10, "folds": 5}, {"epochs": 30, "folds": 5}]
    sections = study_sections([replace(result(), parameters=one) for one in asked])
    titles = [s.title for s in sections if s.title.startswith("Study")]
    assert titles == ["Study: A study (epochs 10)", "Study: A study (epochs 30)"]


def test_a_part_that_follows_a_paper_says_what_its_numbers_are_no_measure_of() -> None:
    part = Part("As in the paper", "paper: the current is among the inputs")
    _, section = study_sections([replace(result(), parts=(part,))])
    assert section.title == "As in the paper (paper protocol)"
    assert section.lead.startswith("Protocol paper: the current is among the inputs. ")
    assert "they do not measure how well a model predicts" in section.lead


def test_a_name_looks_the_same_in_every_panel() -> None:
    panels = dressed(six_panels(), 1200).panels
    colours = {
        (trace["name"], (trace.get("line") or trace["marker"])["color"])
        for panel in panels
        for trace in plotly_of(panel)["data"]
    }
    assert len(colours) == 3


def test_neighbours_are_told_apart_without_colour() -> None:
    looks = looks_of(bars()).values()
    assert len({look.pattern for look in looks}) == 2
    names = [Curve(str(i), (0.0,), (0.0,)) for i in range(6)]
    lines = looks_of(Figure("f", "", "", (Panel("", "", "", tuple(names)),))).values()
    assert len({look.dash for look in lines}) == len({look.symbol for look in lines}) == 6


def test_bars_have_error_bars_and_every_name_below_them() -> None:
    names = tuple(f"parameter {i}" for i in range(20))
    drawn = plotly_of(dressed(bars(names), 1200).panels[0])
    assert drawn["layout"]["xaxis"]["tickvals"] == list(names)
    first = drawn["data"][0]
    assert (first["type"], first["error_y"]["array"].tolist()) == ("bar", [0.1] * 20)


def test_the_identity_line_goes_over_everything_in_the_panel() -> None:
    panel = Panel("", "", "", (curve("a", [-1, 2], [0, 5]), Curve("same", style="identity")))
    assert diagonal(panel).tolist() == [-1, 5]


def test_uncertainty_of_a_long_line_is_drawn_as_its_edges() -> None:
    x = tuple(map(float, range(40)))
    long = Curve("r", x, x, "line", tuple(0.5 for _ in x))
    figure = Figure("f", "", "", (Panel("", "", "", (long,)),))
    upper, lower, _ = traces(figure)
    assert np.allclose(np.subtract(upper["y"], lower["y"]), 1.0)
    short = replace(figure, panels=(Panel("", "", "", (fewer(long, 10),)),))
    (trace,) = traces(short)
    assert "error_y" in trace


@pytest.mark.thorough
def test_a_page_with_a_hundred_large_panels_stays_light() -> None:
    """Twenty figures of six panels, two series of 6500 points each; plotly itself is 2 MB."""
    x = np.arange(6500.0)
    y = np.sin(x / 100)
    both = (curve("measured", x, y), curve("estimated", x, y, "points"))
    panels = tuple(Panel(f"J{j}", "time [s]", "current [A]", both) for j in range(6))
    figures = [Figure(f"fig-{i}", "Many", "", panels) for i in range(20)]
    sections = tuple(study_sections([result(*figures)]))
    page = Page("many", "", Badge("PASSED", "pass"), "", sections=sections)
    assert len(page_html(page).encode()) < 6e6


def test_numbers_of_a_column_have_equally_many_decimals_where_they_can() -> None:
    rows = (("a", 0.0235, 1e-9), ("b", 0.4757, 12.0), ("c", float("nan"), 3))
    table = Table("t", "", ("", "x", "y"), rows)
    assert columns_of(table)[1:] == [["0.0235", "0.4757", "–"], ["1.00e-09", "12.0", "3"]]


def test_one_small_number_of_a_column_costs_the_others_no_needless_digits() -> None:
    column = (14.1532, 129.84, 0.0312, 22.719, 0.0)
    table = Table("t", "", ("", "x"), tuple((str(value), value) for value in column))
    assert columns_of(table)[1] == ["14.2", "129.8", "0.0312", "22.7", "0.0"]


def test_what_is_rounded_up_to_a_power_of_ten_gets_no_digit_more() -> None:
    assert [number(value) for value in (99.97, 100.0, 0.9999, 9.94)] == [
        "100",
        "100",
        "1.00",
        "9.94",
    ]


def test_a_damaged_result_is_a_warning_and_costs_nothing_else(tmp_path: Path) -> None:
    run = write_run(tmp_path, dwell_plan(poses=4))
    path = write_study(result(bars()), run.path / "study" / "counted-1")
    path.write_text(path.read_text("utf-8")[:-40], "utf-8")
    with pytest.raises(DataError, match="is damaged"):
        read_study(path)
    assert "is damaged" in " ".join(summary_lines(run.path))
    assert "is damaged" in render_report(run.path).read_text("utf-8")


def test_a_failed_study_is_told_until_it_is_made(tmp_path: Path) -> None:
    run = write_run(tmp_path, dwell_plan(poses=4))
    folder = run.path / "study" / "counted-1"
    write_problem("counted", "too few poses", "record more", folder)
    told = "The study counted failed: too few poses → record more"
    assert told in " ".join(" ".join(summary_lines(run.path)).split())
    write_study(result(bars()), folder)
    assert "The study counted failed" not in " ".join(summary_lines(run.path))


@pytest.mark.parametrize(
    ("panel", "table", "told"),
    [
        (Panel("P", "", "", (Curve("c", (1.0,), ()),)), None, "1 values of x for 0 of y"),
        (Panel("P", "", "", (Curve("c", ("a", 1.0), (1.0, 2.0)),)), None, "mixes names and"),
        (None, Table("t", "", ("a", "b"), (("x",),)), "1 values for 2 columns in 'x'"),
    ],
)
def test_a_result_that_cannot_be_shown_is_refused_when_it_is_made(
    tmp_path: Path, panel: Panel | None, table: Table | None, told: str
) -> None:
    figures = (Figure("f", "", "", (panel,)),) if panel else ()
    with pytest.raises(FitError, match=told):
        write_study(result(*figures, tables=(table,) if table else ()), tmp_path)
    assert not (tmp_path / "study.json").exists()


def test_a_result_survives_its_file(tmp_path: Path) -> None:
    made = result(six_panels(5), tables=(Table("t", "T", ("a", "b"), (("x", 0.5),)),))
    path = write_study(made, tmp_path)
    assert read_study(path) == StudyResult.from_dict(json.loads(path.read_text("utf-8"))) == made


def test_texts_are_escaped(tmp_path: Path) -> None:
    run = write_run(tmp_path, dwell_plan(poses=4))
    nasty = "<script>alert(1)</script>"
    panel = Panel(nasty, nasty, nasty, (Curve(nasty, (nasty,), (1.0,), "bars"),), corner=nasty)
    figure = Figure("f", nasty, nasty, (panel,))
    part = Part(nasty, nasty, (nasty,), (), (figure,))
    study = StudyResult("s", nasty, (nasty,), (part,), {}, 0.0, (nasty,))
    write_study(study, run.path / "study" / "s-1")
    assert nasty not in render_report(run.path).read_text("utf-8")


def test_two_panels_a_row_are_larger_than_three() -> None:
    for per_row, larger in ((2, True), (3, False)):
        figure = replace(six_panels(), per_row=per_row)
        page = Page("p", "", Badge("", ""), "", sections=(Section("s", "S", "", (figure,)),))
        assert ('class="panels two"' in page_html(page)) == larger
