"""What the page of a run says of its models under loads: one order, one look, names by mass."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from hil.report.curves import dressed
from hil.report.model_sections import _setting, criteria_under_loads
from hil.report.page import page_html
from hil.report.run_facts import RunFacts, read_facts
from hil.report.run_figures import error_per_joint
from hil.report.run_report import run_page, timeline
from hil.report.run_summary import load_name, weighing_warnings, weighings
from hil.report.study_sections import HONEST_MEANS, columns_of, study_sections
from hil.spec.load import load_spec
from hil.studies.figure import Curve, Figure, Panel
from hil.studies.result import Table
from hil.workflow.judging import judge_run
from tests.support.report_html import Page
from tests.support.report_runs import fourier_plan, write_run
from tests.support.study_parts import result

COUNTS = {"samples": 1, "gaps": 0, "missing": 0, "duplicates": 0}
NAMES = ("rigid-wls", "rigid-irls", "rigid-linear")
RAW = {"rigid-wls": 0.3, "rigid-irls": 0.2, "rigid-linear": 0.1}
"""The spec's order, and errors that rank them the other way round."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three models of which the first was judged under its loads."""
    made = write_run(tmp_path_factory.mktemp("loads"), fourier_plan())
    judge_run(made, load_spec(made.path / "spec.yaml"), COUNTS)
    (folder,) = made.path.glob("fit/*")
    for name in NAMES[1:]:
        shutil.copytree(folder, folder.with_name(f"{name}-0123456789ab"))
    for file in made.path.glob("fit/*/evaluation.json"):
        told = json.loads(file.read_text("utf-8"))
        told["held_out"]["total"]["mean_raw"] = RAW[file.parent.name.rpartition("-")[0]]
        told["verdict"]["rows"] = []
        file.write_text(json.dumps(told), "utf-8")
    spec = (made.path / "spec.yaml").read_text("utf-8")
    fits = ", ".join(f"{{estimator: {name}}}" for name in NAMES)
    lines = [f"fit: [{fits}]" if x.startswith("fit:") else x for x in spec.splitlines()]
    (made.path / "spec.yaml").write_text("\n".join(lines), "utf-8")
    rows = [
        {"estimator": "rigid-wls", "metric": "load_error_ratio", "what": "5 kg load",
         "value": 1.42, "max": 1.5, "unit": "1", "passed": True},
        {"estimator": "rigid-wls", "metric": "contradicted_loads", "what": "run (3 kg)",
         "value": 1, "max": 0, "unit": "1", "passed": False},
    ]  # fmt: skip
    verdict = {"passed": False, "verdict": "rejected", "rows": rows}
    (made.path / "verdict.json").write_text(json.dumps(verdict), "utf-8")
    return made.path


def under_loads() -> Figure:
    """As a study of loads draws them, in the order of the spec."""
    told = [Curve(name, ("0 kg",), (1.0,), "bars") for name in ("unaware", "declared")]
    models = [Curve(name, ("0 kg",), (1.0,), "bars") for name in NAMES]
    panels = (Panel(NAMES[0], "", "", tuple(told)), Panel("J1", "", "", tuple(models)))
    return Figure("fig", "Errors under loads", "", panels)


def colours(panel: Panel) -> dict[str, tuple[str, str]]:
    drawn = [(one.name, one.look) for one in panel.curves if one.style == "bars"]
    return {name: (look.colour, look.pattern) for name, look in drawn if look}


@pytest.mark.thorough
def test_models_stand_in_the_order_of_the_spec_everywhere(run: Path) -> None:
    page = run_page(run)
    assert [s.title for s in page.sections if s.id.startswith("model-")] == [
        f"Model {name}" for name in NAMES
    ]
    table, _, plots = page.sections[0].blocks
    assert [row[0].text for row in table.rows] == list(NAMES)  # type: ignore[union-attr]
    assert list(colours(plots.panels[0])) == list(NAMES)  # type: ignore[union-attr]


def test_a_model_looks_the_same_in_every_figure_and_nothing_else_does(run: Path) -> None:
    facts = read_facts(run)
    models = colours(error_per_joint(facts.listed_fits).panels[0])
    (_, part) = study_sections([result(under_loads())], [fit.name for fit in facts.listed_fits])
    (plots,) = (block for block in part.blocks if block.kind == "figure")
    told, joint = map(colours, plots.panels)
    assert joint == models
    assert not {colour for colour, _ in told.values()} & {c for c, _ in models.values()}


def test_a_study_of_no_model_of_the_page_looks_as_ever() -> None:
    figure = Figure("f", "", "", (Panel("", "", "", (Curve("measured", (1.0,), (1.0,)),)),))
    (_, part) = study_sections([result(figure)], NAMES)
    (plots,) = (block for block in part.blocks if block.kind == "figure")
    assert plots == dressed(figure, 1200)


def test_criteria_under_loads_are_shown_and_count_in_the_verdict_of_their_model(run: Path) -> None:
    facts = read_facts(run)
    table = criteria_under_loads(facts.listed_fits)
    assert table is not None
    assert [[cell.text for cell in row] for row in table.rows] == [
        ["error under a load over that with the first", "rigid-wls", "5 kg load, the worst",
         "1.42", "1.50", "passed"],
        ["declared loads contradicted", "rigid-wls", "all loads; wrong: 3 kg", "1", "0",
         "missed"],
    ]  # fmt: skip
    comparison = run_page(run).sections[0].blocks[0]
    assert [row[-1].text for row in comparison.rows] == [  # type: ignore[union-attr]
        "rejected, 1 of 2 criteria missed",
        "for comparison",
        "for comparison",
    ]


def facts_with(run: Path, *masses: float) -> RunFacts:
    facts = read_facts(run)
    return replace(facts, plan=facts.plan | {"loads": [{"mass_kg": mass} for mass in masses]})


def test_loads_are_named_by_their_mass(run: Path) -> None:
    assert load_name(facts_with(run, 0.0, 1.0, 3.0), 2) == "3 kg"
    assert load_name(facts_with(run, 0.0, 3.0, 3.0), 2) == "3 kg (load 2)"
    assert [load_name(facts_with(run, 0.0), load) for load in (1, "x", None)] == [
        "load 1",
        "load x",
        "load None",
    ]


def test_what_was_weighed_is_told_by_mass(run: Path) -> None:
    event = {"kind": "weighing", "load": 2, "result": "waived", "problem": "load 2: too light"}
    facts = replace(facts_with(run, 0.0, 1.0, 3.0), events=[event])
    assert weighings(facts) == {"3 kg": "too light"}
    assert weighing_warnings(facts) == ["The failed weighing was waived: 3 kg: too light."]
    (table,) = timeline(facts).blocks
    assert "load: 3 kg" in table.rows[0][2].text  # type: ignore[union-attr]


def test_the_contents_have_one_entry_for_a_study_and_none_is_cut(run: Path) -> None:
    study = replace(result(), title="Under loads: rigid-wls and others, models of this run")
    other = replace(study, parameters={"estimators": ["rigid-lmi"]})
    sections = study_sections([study, other])
    assert [s.entry for s in sections if s.entry] == [
        "Study: Under loads (1)",
        "Study: Under loads (rigid-lmi)",
    ]
    assert study_sections([study])[0].entry == "Study: Under loads"
    page = Page(page_html(replace(run_page(run), sections=tuple(study_sections([study])))))
    assert [load for load in page.loads if load.startswith("#study")] == ["#study-1"]


def test_studies_of_one_title_say_of_which_models_they_are() -> None:
    stored = {"models": ["fit/rigid-wls-0123", "fit/rigid-irls-4567"], "estimators": []}
    fresh = {"models": [], "estimators": ["rigid-lmi", {"estimator": "rigid-wls", "loss": "huber"}]}
    sections = study_sections([replace(result(), parameters=one) for one in (stored, fresh)])
    assert [s.title for s in sections if s.title.startswith("Study")] == [
        "Study: A study (of rigid-wls, rigid-irls)",
        "Study: A study (of rigid-lmi, rigid-wls)",
    ]


def test_an_honest_protocol_is_explained_in_a_line() -> None:
    assert study_sections([result()])[1].lead == HONEST_MEANS


def test_long_tables_come_after_the_figures() -> None:
    def table(rows: int) -> Table:
        return Table(f"t{rows}", "", ("a", "b"), tuple((str(i), 1.0) for i in range(rows)))

    (_, part) = study_sections([result(under_loads(), tables=(table(45), table(3)))])
    kinds = [(block.kind, len(getattr(block, "rows", ()))) for block in part.blocks]
    assert kinds == [("paragraphs", 0), ("table", 3), ("figure", 0), ("table", 45)]


def test_a_table_may_ask_for_its_decimals() -> None:
    rows = (("a", 5.037312, -0.0001), ("b", 3.0, float("nan")))
    table = Table("t", "", ("", "x", "y"), rows, decimals=3)
    assert columns_of(table)[1:] == [["5.037", "3.000"], ["0.000", "–"]]


def test_settings_are_said_in_words_and_those_not_set_are_left_out() -> None:
    assert [_setting(value) for value in (True, None, 0.01)] == ["yes", None, "0.01"]
    assert _setting({"order": 5, "rate_hz": None}) == "order 5"
