"""The study of loads: what it fits to, what it judges on, what it says; its tables and its verb."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.arms.payload import Payload
from hil.cli.app import app
from hil.core.errors import DataError, FitError, PluginError, SpecError
from hil.data.dataset import Dataset
from hil.data.splits import assert_disjoint
from hil.estimators.payload import NAMES
from hil.estimators.payload_declaration import Declaration
from hil.estimators.rigid_linear import RigidWls
from hil.studies.base import study
from hil.studies.inverse_cases import recorded as recorded_from
from hil.studies.load_models import TOLD, LoadCase, Scored, UnderLoads, folds_of, load_cases, unseen
from hil.studies.load_tables import (
    TORQUES,
    WAYS,
    declarations,
    errors,
    figures,
    identified,
    warnings,
)
from hil.studies.result import StudyResult, Table, faults_of
from hil.studies.store import read_study, study_files
from hil.workflow import studies as campaign
from tests.support.load_parts import OFF_AXIS, ON_AXIS, recorded, sweep
from tests.support.report_runs import dwell_plan, write_run
from tests.support.study_parts import assert_figures_survive_json
from tests.support.synthetic_motion import nominal, raw

# The study of loads: what it fits to, what it judges on, what it says; and its verb


SMALL: dict[str, Any] = {
    "cutoff_hz": 20.0,
    "rate_hz": 50.0,
    "estimators": ["rigid-wls"],
    "hold_out": 2,
}


CHEAP: dict[str, Any] = SMALL | {"friction": "model", "figures": False}
"""Friction is the model's in these runs, and to choose that takes half of the time."""

LIGHT = OFF_AXIS[:2]
"""1 kg and 3 kg."""


@cache
def swept(
    mounted: tuple[Payload, ...] = OFF_AXIS, declared: tuple[Payload, ...] | None = None
) -> Dataset:
    """A run, which no test changes."""
    return sweep(mounted=mounted, declared=declared)


@cache
def found() -> StudyResult:
    return study("load-validation", **SMALL).run(swept(), nominal())


@cache
def found_of_two() -> StudyResult:
    """Of a run with two loads, by one estimator."""
    return study("load-validation", **CHEAP).run(swept(LIGHT), nominal())


JOINTS = [f"J{j}" for j in range(1, 7)]


def table(result: StudyResult, key: str) -> Table:
    (one,) = (table for part in result.parts for table in part.tables if table.key == key)
    return one


@pytest.mark.thorough
def test_told_of_the_load_a_model_errs_far_less() -> None:
    mean = {row[0]: row[-1] for row in table(found(), "table-load-errors").rows}
    for load in ("1 kg", "3 kg", "5 kg"):
        for told in ("declared", "identified"):
            assert mean[f"{load}, rigid-wls, {told}"] < 0.5 * mean[f"{load}, rigid-wls, unaware"]
    assert mean["0 kg, rigid-wls, unaware"] == mean["0 kg, rigid-wls, declared"]
    assert "0 kg, rigid-wls, identified" not in mean


@pytest.mark.thorough
def test_every_load_has_its_bars_told_and_not() -> None:
    mean, joints = found().parts[0].figures
    assert [panel.title for panel in mean.panels] == ["rigid-wls", "rigid-wls, aware of the load"]
    assert [panel.title for panel in joints.panels] == JOINTS
    told = ["unaware", "declared", "calibrated", "identified"]
    for panel, ways in (
        (mean.panels[0], told),
        (mean.panels[1], told[1:]),
        (joints.panels[0], told),
    ):
        assert [c.name for c in panel.curves] == ways
        for curve in panel.curves:
            assert curve.x == ("0 kg", "1 kg", "3 kg", "5 kg")
    assert faults_of(found()) == []
    assert_figures_survive_json(found())


BOTH = ("rigid-wls", "rigid-linear")


@cache
def found_of_both() -> StudyResult:
    asked = CHEAP | {"figures": True, "estimators": BOTH}
    return study("load-validation", **asked).run(swept(LIGHT), nominal())


@pytest.mark.thorough
def test_every_estimator_is_judged_under_every_load() -> None:
    rows = {row[0]: row[1:] for row in table(found_of_both(), "table-load-errors").rows}
    for name in BOTH:
        for load in ("1 kg", "3 kg"):
            assert (
                rows[f"{load}, {name}, declared"][-1] < 0.5 * rows[f"{load}, {name}, unaware"][-1]
            )
            assert len(rows[f"{load}, {name}, identified"]) == 7
    alone = {row[0]: row[1:] for row in table(found_of_two(), "table-load-errors").rows}
    assert {key: rows[key] for key in alone} == alone
    mean, joints = found_of_both().parts[0].figures
    assert [panel.title for panel in mean.panels[::2]] == [*BOTH]
    assert {tuple(c.name for c in panel.curves) for panel in joints.panels} == {BOTH}
    assert faults_of(found_of_both()) == []


@pytest.mark.thorough
def test_the_first_of_several_checks_the_declarations() -> None:
    assert table(found_of_both(), "table-declarations").title.endswith("checked by rigid-wls")
    for key in ("table-declarations", "table-mass", "table-centre"):
        assert table(found_of_both(), key) == table(found_of_two(), key)


def test_the_worst_load_is_said_of_every_estimator() -> None:
    rows = {row[0]: row[-1] for row in table(found_of_both(), "table-load-errors").rows}
    for name, said in zip(BOTH, found_of_both().summary[2:], strict=True):
        errors = {load: float(rows[f"{load}, {name}, declared"]) for load in ("1 kg", "3 kg")}
        worst = max(errors, key=errors.__getitem__)
        ratio = errors[worst] / float(rows[f"0 kg, {name}, declared"])
        assert said.startswith(f"{name}, mean over the joints: ")
        assert f"with {worst}, {rows[f'{worst}, {name}, unaware']:.3g} N·m unaware" in said
        assert f"declared ({ratio:.2f} times that of 0 kg, " in said
        assert "depending on the held-out motions)" in said


@pytest.mark.thorough
def test_an_estimator_that_fails_costs_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    from hil.estimators.rigid_irls import RigidIrls

    def failing(self: RigidIrls, data: Any, robot: Any) -> Any:
        raise FitError("it does not converge")

    monkeypatch.setattr(RigidIrls, "fit", failing)
    asked = CHEAP | {"estimators": ["rigid-irls", "rigid-wls"]}
    result = study("load-validation", **asked).run(swept(LIGHT), nominal())
    assert "rigid-irls: it does not converge" in result.warnings
    alone = table(found_of_two(), "table-declarations")
    assert table(result, "table-declarations").rows == alone.rows
    alone_it_fails = study("load-validation", **asked | {"estimators": ["rigid-irls"]})
    with pytest.raises(FitError, match="does not converge"):
        alone_it_fails.run(swept(LIGHT), nominal())


def test_correct_declarations_are_said_to_agree() -> None:
    assert [row[1] for row in table(found(), "table-declarations").rows] == 3 * ["agrees"]
    assert found().summary[0].startswith("All 3 declared loads agree")
    assert found().summary[1].startswith("Smaller errors of the declared mass cannot be detected")
    assert found().warnings == ()
    mass, centre = (table(found(), key) for key in ("table-mass", "table-centre"))
    assert [row[0] for row in mass.rows] == ["1 kg", "3 kg", "5 kg"]
    assert [row[0] for row in centre.rows[3:6]] == ["3 kg, x", "3 kg, y", "3 kg, z"]
    assert [row[1] for row in centre.rows[3:6]] == pytest.approx([-30.0, 55.0, 45.0])
    for _, declared, estimate, off, allowed in (*mass.rows, *centre.rows):
        assert off == pytest.approx(estimate - declared)
        assert abs(off) < allowed
    assert abs(mass.rows[1][3]) < 0.05


@pytest.mark.thorough
def test_a_tool_mounted_the_wrong_way_round_is_named() -> None:
    x, y, z = OFF_AXIS[1].com
    declared = (LIGHT[0], replace(LIGHT[1], com=(-x, -y, z)))
    result = study("load-validation", **CHEAP).run(swept(LIGHT, declared), nominal())
    rows = table(result, "table-declarations").rows
    assert [row[1] for row in rows] == ["agrees", "CONTRADICTED"]
    assert "turned by" in str(rows[1][2])
    assert result.summary[0].startswith("3 kg: turned by")


@pytest.mark.thorough
def test_loads_on_the_axis_are_said_to_hide_their_angle() -> None:
    result = study("load-validation", **CHEAP).run(swept(ON_AXIS[:2]), nominal())
    for load in ("1 kg", "3 kg"):
        told = f"{load}: the centre of mass cannot be distinguished from the axis of the flange (±"
        assert any(
            note.startswith(told) and "cannot be checked" in note for note in result.warnings
        )
    assert {row[3] for row in table(result, "table-declarations").rows} == {"no"}
    assert result.parts[0].figures == ()


def test_no_motion_is_identified_from_and_judged() -> None:
    of = recorded_from(swept(), nominal(), 20.0, 50.0)
    cases = load_cases(of, frozenset([("run2", 2)]))
    assert [case.name for case in cases] == ["0 kg", "1 kg", "3 kg", "5 kg"]
    for case in cases[1:]:
        assert case.told is not None
        assert_disjoint(case.told, case.judged)
        assert len(case.judged.conditions) == 1


@pytest.mark.thorough
def test_a_stored_model_is_judged_on_what_it_has_not_seen(tmp_path: Path) -> None:
    run = swept(LIGHT)
    seen = run.select(lambda c: c.load == 0 and c.trajectory not in (2, 3))
    saved = RigidWls().fit(seen, nominal()).save(tmp_path)
    _, held = unseen([saved], recorded_from(run, nominal(), 20.0, 50.0))
    assert sorted(number for _, number in held) == [2, 3]
    result = study("load-validation", **CHEAP | {"estimators": ["none"], "models": [str(saved)]})
    assert result.run(run, nominal()).summary[0].startswith("All 2 declared loads agree")


def test_of_several_stored_models_only_what_none_has_seen_is_judged(tmp_path: Path) -> None:
    of = recorded_from(swept(), nominal(), 20.0, 50.0)

    def saved(name: str, *numbers: int) -> Path:
        seen = swept().select(lambda c: c.load == 0 and c.trajectory in numbers)
        return RigidWls().fit(seen, nominal()).save(tmp_path / name)

    first, second = saved("a", 1, 2), saved("b", 1, 3)
    models, held = unseen([first, second], of)
    assert {number for _, number in held} == {4}
    assert [name for name, _ in models] == [first.name, second.name]


@pytest.mark.thorough
def test_a_model_that_has_seen_everything_is_refused(tmp_path: Path) -> None:
    of = recorded_from(swept(), nominal(), 20.0, 50.0)
    saved = RigidWls().fit(swept().select(lambda c: c.load == 0), nominal()).save(tmp_path / "a")
    with pytest.raises(DataError, match="no motion of this run remains"):
        unseen([saved], of)
    saved = RigidWls().fit(swept(), nominal()).save(tmp_path / "b")
    with pytest.raises(DataError, match="with a load"):
        unseen([saved], of)


def test_a_run_with_one_load_is_refused() -> None:
    bare = swept().select(lambda c: c.load == 0)
    with pytest.raises(FitError, match="the run has only one load"):
        study("load-validation", **SMALL).run(bare, nominal())


@pytest.mark.thorough
def test_a_load_that_cannot_be_identified_is_told_and_the_others_are_judged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from hil.studies import load_models

    real = load_models.estimate_payload

    def failing(model: Any, data: Any, **options: Any) -> Any:
        if data.conditions[0].load == 1:
            raise FitError("the payload estimate did not converge")
        return real(model, data, **options)

    monkeypatch.setattr(load_models, "estimate_payload", failing)
    result = study("load-validation", **CHEAP).run(swept(LIGHT), nominal())
    assert (
        "1 kg, rigid-wls: not identified: the payload estimate did not converge" in result.warnings
    )
    verdicts = [row[1] for row in table(result, "table-declarations").rows]
    assert verdicts == ["not checked", "agrees"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"false_alarm": 0.0},
        {"friction": "free"},
        {"models": 3},
        {"hold_out": 0},
        {"estimators": []},
        {"estimators": "rigid-wls"},
        {"estimators": ["rigid-wls", "rigid-wls"]},
    ],
)
def test_parameters_that_cannot_be_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match=next(iter(wrong))):
        study("load-validation", **wrong)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(campaign, "load_source", lambda run: raw(swept(LIGHT[1:])))
    monkeypatch.setattr(campaign, "load_model", lambda robot, gravity: nominal())
    path = write_run(tmp_path, dwell_plan(poses=2)).path
    entry = "study: [{study: load-validation, cutoff_hz: 20, rate_hz: 50, friction: model}]\n"
    with (path / "spec.yaml").open("a", encoding="utf-8") as spec:
        spec.write(entry)
    return path


@pytest.mark.thorough
def test_the_verb_takes_several_estimators_prints_verdicts_and_makes_the_page(run: Path) -> None:
    asked = ["validate-loads", str(run), "-e", "rigid-wls", "-e", "rigid-linear"]
    done = CliRunner().invoke(app, asked)
    assert done.exit_code == 0, done.output
    assert "declared load agrees" in done.stdout
    assert f"report: {run / 'report.html'}" in done.stdout
    assert (run / "report.html").exists()
    (file,) = study_files(run)
    assert list(read_study(file).parameters["estimators"]) == ["rigid-wls", "rigid-linear"]


@pytest.mark.thorough
def test_the_verb_prints_one_document_with_a_stored_model(run: Path, tmp_path: Path) -> None:
    saved = RigidWls().fit(recorded(1, 21, 22, 23), nominal()).save(tmp_path / "model")
    done = CliRunner().invoke(app, ["validate-loads", str(run), "--model", str(saved), "--json"])
    assert done.exit_code == 0, done.output
    (told,) = json.loads(done.stdout)["studies"]
    assert told["study"] == "load-validation"
    assert told["parameters"]["models"] == [str(saved)]


def test_a_misspelt_estimator_is_refused_before_anything_is_judged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def judged(*_: Any) -> None:
        raise AssertionError("something was judged")

    monkeypatch.setattr("hil.studies.load_validation.judged", judged)
    asked = SMALL | {"estimators": ["rigid-wls", "rigid-wsl"]}
    with pytest.raises(PluginError, match="rigid-wsl"):
        study("load-validation", **asked).run(swept(), nominal())


def test_every_motion_is_judged_once_from_the_last_to_the_first() -> None:
    every = [("run", i) for i in range(7)]
    folds = folds_of(every, None, 2)
    assert [sorted(i for _, i in fold) for fold in folds] == [[5, 6], [3, 4], [1, 2], [0]]
    first = frozenset(every[:3])
    assert [len(fold) for fold in folds_of(every, first, 2)] == [3, 3, 1]
    with pytest.raises(FitError, match="cannot be held out"):
        folds_of(every, None, 7)


@pytest.mark.thorough
def test_a_stored_model_and_a_fresh_fit_of_it_are_worth_the_same(tmp_path: Path) -> None:
    conditions = tuple(replace(c, source="run") for c in swept(LIGHT).conditions)
    run = replace(swept(LIGHT), conditions=conditions)
    seen = run.select(lambda c: c.load == 0 and c.trajectory not in (3, 4))
    saved = RigidWls().fit(seen, nominal()).save(tmp_path)
    asked = CHEAP | {"estimators": [], "models": [str(saved)], "hold_out": None}
    again = study("load-validation", **asked).run(run, nominal())
    pair = [table(result, "table-load-errors").rows for result in (again, found_of_two())]
    for one, other in zip(*pair, strict=True):
        assert one[:1] == other[:1]
        assert one[1:] == pytest.approx(other[1:], rel=1e-6)
    assert str(saved) in again.title
    assert "fitted for this study" in found_of_two().title


def test_gains_that_the_other_loads_tell_make_a_declared_load_err_less() -> None:
    mean = {row[0]: row[-1] for row in table(found(), "table-load-errors").rows}
    told = [float(mean[f"5 kg, rigid-wls, {what}"]) for what in ("declared", "calibrated")]
    assert told[1] < 0.97 * told[0]
    assert "0 kg, rigid-wls, calibrated" not in mean


def told_of(*loads: tuple[float, float, float]) -> list[str]:
    """Warnings of loads of a mass, found so much heavier, and how far off they may be."""
    scored = []
    for mass, off, limit in loads:
        declared = Payload(mass, (0.0, 0.0, 0.05) if mass else (0.0, 0.0, 0.0))
        values, limits = np.zeros(10), np.full(10, limit)
        values[0] = mass + off
        check = Declaration(declared, values, limits, (), True, mass == 1.0, np.zeros(6))
        case = LoadCase(f"{mass:g} kg", declared, swept(), swept())
        scored.append(Scored(case, {"declared": np.ones(6)}, check=check))
    bare = Scored(LoadCase("bare", Payload(), None, swept()), {"declared": np.ones(6)})
    return list(warnings([UnderLoads("a", "honest", (bare, *scored), ())], ()))


@pytest.mark.thorough
def test_what_could_not_be_seen_is_said() -> None:
    assert told_of((1.0, 0.02, 0.05), (1.0, -0.02, 0.05)) == []
    assert any(note.startswith("a single load") for note in told_of((1.0, 0.0, 0.1)))
    (shared,) = told_of((1.0, 0.04, 0.05), (1.0, 0.05, 0.06))
    assert "0.04 to 0.05 kg heavier" in shared
    assert told_of((1.0, 0.01, 0.05), (1.0, 0.05, 0.06)) == []  # as gains would have it
    (axis,) = told_of((3.0, 0.0, 0.03), (1.0, 0.0, 0.03))
    assert "cannot be distinguished from the axis of the flange (±30 mm)" in axis
    assert told_of((0.0, 0.0, 0.03), (1.0, 0.0, 0.03)) == []


def test_the_verb_takes_a_model_or_an_estimator(run: Path) -> None:
    done = CliRunner().invoke(app, ["validate-loads", str(run), "--model", "m", "-e", "rigid-wls"])
    assert isinstance(done.exception, SpecError)
    assert "exclude each other" in done.exception.message


# Tables and figures of a study of loads, from numbers made up for them


LOADS = (0.0, 1.0, 3.0)
WORST = 11.0


def load(mass: float, inertia_known: bool) -> Any:
    """One load, identified 10 g too heavy and 1 mm and 0.001 kg·m² off."""
    error = {told: np.full(2, WORST if told == "unaware" else 0.5) for told in TOLD}
    declared = Payload(mass, (0.05, -0.01, 0.03)) if mass else Payload()
    case = SimpleNamespace(name=f"{mass:g} kg", declared=declared, told=mass or None)
    if not mass:
        bare = {told: error[told] for told in ("unaware", "declared")}
        return SimpleNamespace(case=case, errors=bare, check=None, estimate=None, failed="")
    off = np.array([0.01, *3 * [0.001], *6 * [0.001]])
    found = np.array([mass, *declared.com, *6 * [0.0]]) + off
    check = SimpleNamespace(
        found=found, limit=np.full(10, 0.1), findings=(), agrees=True, mount_observable=False,
        trusted=True,
    )  # fmt: skip
    determined = dict.fromkeys(NAMES, True) | dict.fromkeys(NAMES[4:], inertia_known)
    estimate = SimpleNamespace(determined=determined, values=found + 5.0)
    return SimpleNamespace(case=case, errors=error, check=check, estimate=estimate, failed="")


def model(name: str = "rigid-wls", inertia_known: bool = False) -> Any:
    """As if it had been judged."""
    return SimpleNamespace(name=name, loads=tuple(load(mass, inertia_known) for mass in LOADS))


def test_mass_and_centre_have_a_table_each_in_units_of_their_own() -> None:
    mass, centre = identified(model())
    assert mass.columns == centre.columns == (
        "load", "declared", "identified", "difference", "allowed ±",
    )  # fmt: skip
    assert [row[0] for row in mass.rows] == ["1 kg", "3 kg"]
    assert mass.rows[1][1:] == pytest.approx((3.0, 3.01, 0.01, 0.1))
    assert centre.rows[1][0] == "1 kg, y"
    assert centre.rows[1][1:] == pytest.approx((-10.0, -9.0, 1.0, 100.0))
    assert (mass.decimals, centre.decimals) == (3, 1)


def test_an_inertia_is_shown_only_where_it_is_determined() -> None:
    assert [table.key for table in identified(model())] == ["table-mass", "table-centre"]
    *_, inertia = identified(model(inertia_known=True))
    assert (inertia.key, len(inertia.rows)) == ("table-inertia", 12)
    assert inertia.rows[0][0] == "1 kg, xx"
    assert inertia.rows[0][2] == pytest.approx(1.0)


def test_the_note_says_how_a_weighing_relates() -> None:
    (note,) = (table.note for table in identified(model()) if table.note)
    assert "weighing before the motions" in note
    assert "one standard deviation" in note


def test_what_sets_the_scale_is_left_out_of_a_panel_beside() -> None:
    mean, _ = figures([model("a"), model("b")])
    assert [panel.title for panel in mean.panels] == [
        "a", "a, aware of the load", "b", "b, aware of the load",
    ]  # fmt: skip
    assert mean.per_row == 2
    for whole, aware in zip(mean.panels[::2], mean.panels[1::2], strict=True):
        assert [curve.name for curve in whole.curves] == list(TOLD)
        assert max(y for curve in aware.curves for y in curve.y if np.isfinite(y)) < WORST


def test_every_way_is_explained_where_it_is_drawn_and_listed() -> None:
    mean, _ = figures([model()])
    for told in TOLD:
        assert f"{told.capitalize()}: " in WAYS
    for text in (mean.caption, errors([model()]).note):
        assert WAYS in text
        assert TORQUES in text


def test_declarations_are_told_in_words_of_the_floor() -> None:
    assert declarations(model()).rows == tuple(
        (name, "agrees", "–", "no", "yes") for name in ("1 kg", "3 kg")
    )
