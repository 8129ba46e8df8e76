"""The report of a fleet: who has drifted, who stands out, how old everybody is; page and JSON."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import DataError
from hil.core.parallel import one_thread
from hil.maintenance.fleet_specs import experiment_for, spec_for
from hil.models import fleet_survey
from hil.models.drift import Probe
from hil.models.drift_features import Features, feature_names
from hil.models.fleet_fits import FitResult, RobotFit, register_fit
from hil.models.fleet_outliers import compare_robots
from hil.models.fleet_probes import probe_fleet
from hil.models.fleet_survey import Survey, SurveyedRobot, survey_fleet, survey_robot
from hil.models.model_registry import Registry
from hil.recording.run_group import FleetGroup, Member
from hil.report.fleet_page import fleet_page, standing_out
from hil.report.page import page_html
from hil.workflow.running import run as run_experiment
from tests.support.fleet_parts import FITTED, written
from tests.support.report_html import Page

JOINTS = tuple(f"J{j}" for j in range(6))
WORN = 11
PROBE = FITTED.replace("trajectories: 3", "trajectories: 4")


def probed(change: np.ndarray, changed: bool) -> Probe:
    names = feature_names(JOINTS)
    values = np.zeros(len(names))
    values[: 3 * len(JOINTS) : 3] = change - 1.0
    nothing = np.zeros(len(names))
    features = Features(
        names, values, nothing, nothing, np.zeros(6), 1, np.eye(len(names)), values[None]
    )
    return Probe("u", "2026-11-22", "run", "", 1, 0.01, features, changed, (), 0.5, 5)


@pytest.fixture(scope="module")
def survey() -> Survey:
    """Thirty robots; one has 30 % more friction in J2, another has drifted."""
    dice = np.random.default_rng(7)
    age, celsius = np.linspace(1, 9, 30), dice.uniform(25, 35, (30, 6))
    change = np.exp(0.02 * age[:, None] + dice.normal(0, 0.01, (30, 6)))
    change[WORN, 2] *= 1.3
    level = 5.0 * dice.uniform(0.85, 1.15, (30, 6)) * change
    robots = tuple(
        SurveyedRobot(
            f"ur5-{k:03d}", Path(f"run-{k}"), Path("model"), age[k], JOINTS, level[k], celsius[k],
            probed(change[k], changed=k == 4),
        )
        for k in range(30)
    )  # fmt: skip
    given = {"age": age, "temperature": celsius}
    return Survey(
        "simulated", Path("fleet-simulated"), robots, ("ur5-030",), compare_robots(level, given),
        compare_robots(change, given),
    )  # fmt: skip


def test_a_worn_joint_stands_out_by_its_change_though_not_by_its_friction(survey: Survey) -> None:
    assert survey.outlying(survey.change) == [(WORN, 2)]
    assert survey.outlying(survey.friction) == []
    out = {one.robot: why for one, why in standing_out(survey)}
    assert set(out) == {"ur5-004", "ur5-011"}
    assert "change of friction of J2 +3" in out["ur5-011"] or "+2" in out["ur5-011"]


def test_the_page_says_who_is_to_be_looked_at_and_loads_nothing(survey: Survey) -> None:
    page = Page(page_html(fleet_page(survey)))
    assert not [url for url in page.loads if url.startswith(("http", "//"))]
    looked = page.tables["Changed since their champion, or different from the others"]
    assert [row[0].split()[-1] for row in looked if "ur5" in row[0]] == ["ur5-004", "ur5-011"]
    assert len(page.figures) == 4 * len(JOINTS)
    assert "the probability of any outlier among all robots and joints is 1 %" in page.text
    assert "of 30 probed; 0.3 expected by chance" in page.text
    assert "1 not measured" in page.text


def test_what_has_no_model_is_told_and_not_compared(survey: Survey) -> None:
    none = np.empty(0)
    bare = replace(
        survey.robots[0], joint_names=(), friction=none, temperature=none, problem="it has no model"
    )
    told = replace(survey, robots=(bare, *survey.robots[1:]))
    assert "ur5-000: it has no model" in Page(page_html(fleet_page(told))).text
    json.dumps(told.to_dict(), default=str)


@pytest.mark.thorough
def test_who_is_not_compared_is_named(survey: Survey) -> None:
    age = np.array([one.age for one in survey.robots])
    age[2] = np.nan
    change = np.array([one.change for one in survey.robots])
    told = replace(
        survey,
        robots=tuple(replace(one, age=a) for one, a in zip(survey.robots, age, strict=True)),
        change=compare_robots(change, {"age": age}),
    )
    page = Page(page_html(fleet_page(told)))
    assert "change of friction of ur5-002 is not compared: age is unknown" in page.text
    assert told.outlying(told.change) == [(WORN, 2)]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fleet of two robots that were measured and one that was not."""
    folder = tmp_path_factory.mktemp("fleet")
    spec, station = written(folder, {"a": "seed: 1", "b": "seed: 2", "c": "seed: 3"}, PROBE)
    specs = {name: spec_for(PROBE, "small.yaml", name) for name in "abc"}
    made = FleetGroup.create(folder / "runs", "small", specs, spec, str(station))
    members: list[Member] = []
    with one_thread():
        for name in "ab":
            one = experiment_for(specs[name], folder, station, made.spec_of(name))
            report = run_experiment(one, runs=made.runs).to_dict()
            members.append(Member("small", name, report))
    made.write([*members, Member("small", "c", {})])
    return made.path


@pytest.mark.thorough
def test_a_small_fleet_is_reported_with_ages_and_without_judgement(
    fleet: Path, tmp_path: Path
) -> None:
    done = CliRunner().invoke(
        app,
        ["fleet", "report", str(fleet), "--registry", str(tmp_path), "--workers", "1", "--json"],
    )
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["missing"] == ["c"]
    assert told["friction"] is None
    assert [one["age_years"] for one in told["robots"]] == pytest.approx([10.7, 9.7], abs=1.1)
    assert np.all(np.array([one["friction_nm"] for one in told["robots"]]) > 0.5)
    assert Path(told["page"]).is_file()


@pytest.mark.thorough
def test_runs_of_a_fleet_are_judged_as_probes_of_its_champions(fleet: Path, tmp_path: Path) -> None:
    registry = Registry(tmp_path / "registry")
    bare = probe_fleet(fleet, registry, 0.01)
    assert ["no models of" in one.error for one in bare] == [True, True]
    members = FleetGroup.open(fleet).members()
    # each the model of the other: the same arm, and none was fitted to its own run
    for one, other in zip(members[:2], reversed(members[:2]), strict=True):
        model = Path(other.report["models"][0])
        model = model if model.is_absolute() else fleet / model
        assert one.run is not None
        fit = RobotFit(one.robot, one.run, FitResult(model.name, passed=True), model)
        assert register_fit(fit, registry).role == "champion"
    told = probe_fleet(fleet, registry, 0.01)
    assert [(one.robot, one.error, one.note) for one in told] == [("a", "", ""), ("b", "", "")]
    assert told[0].probe is not None
    assert told[0].probe.false_alarm == pytest.approx(0.005, rel=0.01)
    again = probe_fleet(fleet, registry, 0.1)
    assert again[0].note == "evaluated earlier, at a rate of 0.005, not 0.051"
    found = survey_fleet(fleet, registry, workers=1)
    assert found.false_alarms == pytest.approx(0.01, rel=0.01)
    assert all(np.isfinite(one.change).all() for one in found.robots)
    with pytest.raises(DataError, match=r"fleet\.json"):
        survey_fleet(tmp_path, registry, workers=1)
    # what was said under a champion that was is not said of the present one
    version = registry.register("a", Path(members[0].report["models"][0]), {})
    registry.promote("a", version.number, reason="new", evidence={}, instead_of=1)
    found = survey_fleet(fleet, registry, workers=1)
    assert [one.probe is None for one in found.robots] == [True, False]


@pytest.mark.thorough
def test_models_of_another_estimator_or_that_break_down_are_not_compared(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def state(run: Path, model: Path) -> tuple[str, tuple[str, ...], np.ndarray, np.ndarray]:
        if "c" in run.name:
            raise ZeroDivisionError("a plug-in")
        return f"estimator-{run.name}", JOINTS, np.ones(6), np.ones(6)

    monkeypatch.setattr(fleet_survey, "_friction", state)
    robots = [survey_robot(Path(name), tmp_path) for name in ("a", "a", "b", "c")]
    assert robots[3].problem == "its model failed: ZeroDivisionError: a plug-in"
    compared = fleet_survey._of_one_estimator(robots)
    assert [bool(np.isfinite(one.friction).any()) for one in compared] == [True, True, False, False]
    assert "its model is from estimator-b, the others are from estimator-a" in compared[2].problem


def test_a_joint_without_temperature_has_no_mean() -> None:
    mean = fleet_survey._known_mean(np.array([[1.0, np.nan], [3.0, np.nan]]))
    np.testing.assert_array_equal(mean, [2.0, np.nan])


@pytest.mark.thorough
def test_a_member_that_was_deleted_or_damaged_costs_nobody_else(
    fleet: Path, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    shutil.copytree(fleet.parents[2], runs)
    copied = runs / fleet.relative_to(fleet.parents[2])
    members = FleetGroup.open(copied).members()
    shutil.rmtree(members[0].run or "")
    registry = Registry(tmp_path / "registry")
    survey = survey_fleet(copied, registry, workers=1)
    assert [one.robot for one in survey.robots] == ["a", "b"]
    assert survey.robots[0].problem
    assert np.isfinite(survey.robots[1].friction).all()
    json = CliRunner().invoke(
        app, ["fleet", "drift", str(copied), "--registry", str(registry.root), "--json"]
    )
    assert json.exit_code == 8, json.output
    assert json.stdout.count('"error"') >= 2
