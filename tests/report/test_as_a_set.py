"""The pages together: one visual language, as `page_rules` has it, and nothing from elsewhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hil.report import colours
from hil.report.drift_page import Along, drift_page
from hil.report.excitation_page import excitation_page
from hil.report.fleet_page import fleet_page
from hil.report.page import Badge, Page, Section, page_html
from hil.report.run_report import run_page
from hil.report.simulation_page import _errors, found
from hil.report.study_sections import study_sections
from hil.report.try_out_page import trial_page
from hil.spec.load import load_spec
from hil.studies.figure import Curve, Figure, Look, Panel
from hil.workflow.judging import judge_run
from tests.excitation import test_report as test_excite_report
from tests.maintenance import test_simulation as simulated
from tests.report import test_drift_page, test_fleet_report
from tests.support.page_rules import faults, panels
from tests.support.report_html import Page as Html
from tests.support.report_runs import dwell_plan, fourier_plan, write_run
from tests.support.study_parts import bars, result, six_panels
from tests.support.trial_parts import short_trial

COUNTS = {"samples": 1, "gaps": 0, "missing": 0, "duplicates": 0}
registry = test_drift_page.registry
survey = test_fleet_report.survey
cache, optimised, report = (
    getattr(test_excite_report, name) for name in ("cache", "optimised", "report")
)


def run_of(root: Path, plan: object, **more: object) -> Page:
    run = write_run(root, plan, **more)  # type: ignore[arg-type]
    if not more:
        judge_run(run, load_spec(run.path / "spec.yaml"), COUNTS)
    return run_page(run.path)


@pytest.fixture(scope="module")
def pages(registry, survey, report, tmp_path_factory) -> dict[str, Page]:
    """A page of every kind."""
    root, what = tmp_path_factory.mktemp("pages"), found(simulated.told(simulated.GOOD))
    weeks = Section("weeks", "Weeks", "", (_errors(what, Along((1.0,), "week [1]", "week"), "A"),))
    told = study_sections([result(six_panels(), bars())])
    return {
        "dwell run": run_of(root, dwell_plan()),
        "Fourier run": run_of(root, fourier_plan()),
        "run that was cut off": run_of(root, dwell_plan(), outcome=None, finish=False),
        "run that failed": run_of(root, fourier_plan(), outcome="fault", reason="a fault"),
        "study": Page("study", "", Badge("", ""), "", sections=tuple(told)),
        "excitation": excitation_page(report),
        "drift": drift_page(registry, "ur5"),
        "fleet": fleet_page(survey),
        "try-out": trial_page(short_trial()[0]),
        "simulation": Page("weeks", "", Badge("", ""), "", sections=(weeks,)),
    }


@pytest.mark.thorough
def test_every_page_keeps_the_rules(pages: dict[str, Page]) -> None:
    assert {name: faults(page) for name, page in pages.items() if faults(page)} == {}
    assert all(panels(page) for page in pages.values())


@pytest.mark.thorough
def test_no_page_loads_anything(pages: dict[str, Page]) -> None:
    for name, page in pages.items():
        html = Html(page_html(page))
        assert [load for load in html.loads if not load.startswith("#")] == [], name
        assert not any("url(" in style or "@import" in style for style in html.styles)


@pytest.mark.thorough
def test_every_plot_of_a_page_is_said_in_words(pages: dict[str, Page]) -> None:
    for page in pages.values():
        plots = [named for tag, named in Html(page_html(page)).tags if named.get("class") == "plot"]
        assert len(plots) == len(panels(page))
        assert all(named["role"] == "img" and named["aria-label"] for named in plots)


@pytest.mark.parametrize(
    ("x", "y", "second", "legend", "told"),
    [
        ("time", "error [A]", colours.PREDICTED, "dash", "'time' has no unit"),
        ("time [s]", "error [furlong]", colours.PREDICTED, "dash", "has no unit"),
        ("time [s]", "a title that is longer than its axis [A]", colours.UP, "dash", "cut off"),
        ("time [s]", "error [A]", "#123456", "dash", "not of the palette"),
        ("time [s]", "error [A]", colours.PREDICTED, "wavy", "unknown look"),
        ("time [s]", "error [A]", colours.PREDICTED, "solid", "differ in colour alone"),
    ],
)
def test_a_page_that_breaks_a_rule_is_told(
    x: str, y: str, second: str, legend: str, told: str
) -> None:
    dash = legend if legend in colours.STROKES else "dash"
    ends = np.arange(2.0)
    looks = (Look(colours.MEASURED), Look(second, dash=dash), Look(colours.PREDICTED, legend))
    curves = [Curve(name, ends, ends, look=look) for name, look in zip("abc", looks, strict=True)]
    panel = Panel("J1", x, y, tuple(curves), alt="What it shows, in words.")
    block = Figure("error", "Error", "", (panel,), 0)
    page = Page("p", "", Badge("", ""), "", sections=(Section("s", "S", "", (block,)),))
    assert any(told in fault for fault in faults(page)), faults(page)
