"""A run that could not be fitted or judged is refused before anything moves, with its place."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core import plugins
from hil.core.errors import FitError, SpecError
from hil.dynamics import load_model
from hil.estimators.base import needs_of
from hil.estimators.checks import Needs
from hil.estimators.rigid_linear import RigidLinear
from hil.estimators.static_model import StaticWls
from hil.planning.commissioning import Commissioning
from hil.planning.experiment import load as load_experiment
from hil.workflow.background_runs import check_start
from hil.workflow.checks import check_driver, require_within_reach

SIX = "excitation: {kind: dwell, waypoints: 6}\nfit: [{estimator: static-wls}]"
TOO_FEW = (
    "s:5:19: fit.0.estimator: static-wls: 10 dwells are too few: at least 16 are needed "
    "(held out: 1 of 6); excitation.waypoints: at least 10"
)
FOURIER = "excitation: {kind: fourier, trajectories: 4}\n"
DWELL = "excitation: {kind: dwell, waypoints: 40}\n"
LOADS = "loads: [{}, {mass_kg: 2}]\n"
GRAVITY = (0.0, 0.0, -9.81)


def written(folder: Path, rest: str, robot: str = "ur5") -> Path:
    path = folder / "s.yaml"
    path.write_text(f"hil: 1\nname: s\nrobot: {robot}\n{rest}\n", "utf-8")
    return path


def refused(folder: Path, rest: str, robot: str = "ur5") -> list[str]:
    """Lines of the error of `hil validate`, without the folder."""
    path = written(folder, rest, robot)
    error = CliRunner().invoke(app, ["validate", str(path)]).exception
    assert isinstance(error, SpecError), error
    return error.message.replace(str(path), "s").replace(str(folder), ".").splitlines()


def accepted(path: Path, *words: str) -> None:
    done = CliRunner().invoke(app, ["validate", str(path), *words])
    assert done.exit_code == 0, done.exception


@pytest.mark.parametrize("verb", ["validate", "plan", "run"])
def test_six_waypoints_are_refused_by_every_verb(
    verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, SIX)
    error = CliRunner().invoke(app, [verb, str(path)]).exception
    assert isinstance(error, SpecError)
    assert error.message.replace(str(path), "s") == TOO_FEW
    assert [file.name for file in tmp_path.iterdir()] == ["s.yaml"]


def test_the_api_refuses_them_as_well(tmp_path: Path) -> None:
    experiment = hil.load(written(tmp_path, SIX))
    with pytest.raises(SpecError, match="10 dwells are too few"):
        hil.plan(experiment)
    with pytest.raises(SpecError, match="10 dwells are too few"):
        hil.run(experiment, runs=tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


def test_a_start_from_the_dashboard_refuses_them_as_well(tmp_path: Path) -> None:
    path = written(tmp_path, SIX)
    with pytest.raises(SpecError, match="10 dwells are too few"):
        check_start(path, None)
    assert len(check_start(path, None, commissioning=Commissioning(first=2))) == 1


@pytest.mark.thorough
def test_a_commissioning_run_is_not_judged_and_may_be_small(tmp_path: Path) -> None:
    study = "\nstudy: [{study: static-separation}]\naccept: {rmse: {max: 1, unit: Nm}}"
    rest = SIX.replace("waypoints: 6", "waypoints: 3") + study
    path = written(tmp_path, f"weigh: false\nwarm_up: {{duration_s: 0}}\n{rest}")
    words = ["run", str(path), "--limit", "2", "--runs", str(tmp_path / "runs"), "--json"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.exception
    assert json.loads(done.stdout)["outcome"] == "completed"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("rest", "message"),
    [
        (DWELL.replace("40", "11") + "fit: [{estimator: static-linear, form: shared}]",
         "static-linear: 9 poses are too few: at least 17 are needed (held out: 2 of 11); "
         "excitation.waypoints: at least 21"),
        (DWELL.replace("40", "20") + "fit: [{estimator: static-hysteresis}]",
         "static-hysteresis: 32 dwells are too few: at least 36 are needed (held out: 4 of 20); "
         "excitation.waypoints: at least 22"),
        (DWELL.replace("40}", "19, approach: free}") + "fit: [{estimator: static-wls}]",
         "static-wls: 15 dwells are too few: at least 16 are needed (held out: 4 of 19); "
         "excitation.waypoints: at least 20"),
        ("excitation: {kind: fourier, trajectories: 2, fundamental_hz: 10}\n"
         "fit: [{estimator: rigid-wls}]",
         "rigid-wls: 12 samples are too few: at least 58 are needed (held out: 1 of 2); "
         "excitation.trajectories: at least 6"),
        (FOURIER.replace("4}", "2}") + "study: [{study: inverse-dynamics, methods: [wls]}]",
         "inverse-dynamics: 2 trajectories are too few: at least 3 are needed; "
         "excitation.trajectories: at least 3"),
        (DWELL.replace("40", "3") + "study: [{study: static-separation}]",
         "static-separation: 3 poses are too few: at least 4 are needed; "
         "excitation.waypoints: at least 4"),
    ],
    ids=["poses", "friction", "one side", "samples", "study of trajectories", "study of poses"],
)  # fmt: skip
def test_too_little_for_a_fit_or_a_study_is_refused_with_what_would_do(
    rest: str, message: str, tmp_path: Path
) -> None:
    (line,) = refused(tmp_path, rest)
    assert line.partition(": ")[2].partition(": ")[2] == message


@pytest.mark.parametrize(
    ("rest", "message"),
    [
        (FOURIER + "accept: {nrmse: {max: 0.1}}",
         "accept.nrmse: there is no model to evaluate: `fit` is empty"),
        (DWELL + "fit: [{estimator: static-wls, form: paper, current_term: true}]\n"
         "accept: {rmse: {max: 1, unit: A}}",
         "accept.rmse: no model of `fit` is evaluated: all of them follow the protocol of a paper"),
        (FOURIER + LOADS + "fit: [{estimator: rigid-wls}]\nvalidate: {under_loads: true}\n"
         "accept: {load_error_ratio: {max: 2, told: calibrated}}",
         "accept.load_error_ratio.told: `loads` needs a third load for the calibration of "
         "the drive gains"),
    ],
)  # fmt: skip
def test_a_criterion_that_nothing_is_held_against_is_refused(
    rest: str, message: str, tmp_path: Path
) -> None:
    (line,) = refused(tmp_path, rest)
    assert line.partition(": ")[2] == message


def test_a_fit_of_currents_is_refused_for_an_arm_that_measures_torques(tmp_path: Path) -> None:
    rest = DWELL + "fit: [{estimator: static-inverse, form: shared}]"
    experiment = load_experiment(written(tmp_path, rest))
    robot = replace(check_driver(experiment), effort_kind="torque", drive_gains=())
    with pytest.raises(SpecError, match="static-inverse needs a current, but ur5 measures a torq"):
        require_within_reach(experiment, robot)


@pytest.mark.parametrize("gains", [(), (float("nan"),) * 6, (0.0,) * 6])
def test_missing_drive_gains_are_refused_before_motion(
    gains: tuple[float, ...], tmp_path: Path
) -> None:
    experiment = load_experiment(written(tmp_path, DWELL + "fit: [{estimator: static-wls}]"))
    robot = replace(check_driver(experiment), drive_gains=gains)
    with pytest.raises(SpecError, match=r"static-wls needs torques: .*drive gains \[N·m/A\]"):
        require_within_reach(experiment, robot)


@pytest.mark.parametrize(("loads", "needed"), [("", False), (LOADS, True)])
def test_gains_are_needed_by_the_form_of_the_paper_under_loads_only(
    loads: str, needed: bool, tmp_path: Path
) -> None:
    rest = DWELL + loads + "fit: [{estimator: static-wls, form: paper}]"
    experiment = load_experiment(written(tmp_path, rest))
    robot = replace(check_driver(experiment), drive_gains=())
    if not needed:
        require_within_reach(experiment, robot)
        return
    with pytest.raises(SpecError, match="static-wls needs torques"):
        require_within_reach(experiment, robot)


def test_a_form_that_is_not_for_the_arm_is_refused_before_motion(tmp_path: Path) -> None:
    rest = DWELL + "fit: [{estimator: static-wls, form: paper}]"
    experiment = load_experiment(written(tmp_path, rest))
    on_a_wall = experiment.robot.model_copy(update={"gravity_m_s2": (9.81, 0.0, 0.0)})
    with pytest.raises(SpecError, match=r"s.yaml:5:19: .* level base, .* → use form: shared"):
        check_driver(replace(experiment, robot=on_a_wall))


class Silent(StaticWls):
    """An estimator of somebody else's that states nothing."""

    estimator = "silent"
    needs = None  # type: ignore[assignment]


def test_a_plug_in_that_states_no_needs_is_not_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = [EntryPoint("silent", "tests.workflow.test_needs:Silent", "hil.estimators")]
    known = plugins.entry_points

    def found(*, group: str) -> Any:
        return points if group == "hil.estimators" else known(group=group)

    monkeypatch.setattr(plugins, "entry_points", found)
    accepted(written(tmp_path, SIX.replace("static-wls", "silent")))
    assert needs_of(object(), load_model("ur5", gravity=GRAVITY)) == Needs()


def test_a_fit_refuses_just_what_its_needs_state() -> None:
    needs = Needs({"dwells": 4, "poses": 2})
    needs.require(dwells=4)
    with pytest.raises(FitError, match="3 dwells are too few: at least 4 are needed"):
        needs.require(dwells=3, poses=2)


def test_needs_of_a_correction_are_those_of_its_physics_as_well() -> None:
    both = Needs({"samples": 9}, gains=True).also(Needs({"samples": 4, "poses": 2}))
    assert both == Needs({"samples": 9, "poses": 2}, gains=True)


@pytest.mark.parametrize("name", ["rigid-wls", "rigid-diffnea", "static-wls"])
def test_as_many_rows_as_parameters_are_stated(name: str) -> None:
    """The fit counts its parameters itself, by names."""
    from hil.estimators.base import estimator

    robot = load_model("ur5", gravity=GRAVITY)
    model: Any = estimator(name)
    model.robot_, model.joint_names_ = robot, robot.joint_names
    model._open()
    what = "samples" if isinstance(model, RigidLinear) else "dwells"
    assert model.needs(robot).least == {what: len(model.parameter_names_)}


POSES = "0, -90, 90, -90, -90, 0\n10, -80, 80, -90, -90, 0\n"
OF_FILE = "excitation: {kind: dwell, file: poses.csv}"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0, -90, 90\n", "./poses.csv:1: 3 columns, but the robot has 6 joints"),
        (POSES + "0, up, 90, -90, -90, 0\n", "./poses.csv:3: column 2 is 'up', not a number"),
        (POSES + "0, -90, 900, -90, -90, 0\n",
         "./poses.csv:3: elbow_joint at 900.0° is beyond its range of -360.0° to 360.0°"),
        ("a,b,c,d,e,f\n" + POSES,
         "./poses.csv:1: the first line is neither a pose nor the joints' names: a, b, c, d, e, f"),
        ("# none\n", "./poses.csv: there is no pose in this file"),
        ("0.1, -1.5, 1.5, -1.5, -1.5, 0\n", "./poses.csv: no angle is beyond 2π, so these may be"),
    ],
)  # fmt: skip
def test_validate_reads_the_poses_of_a_file(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text(text, "utf-8")
    (line,) = refused(tmp_path, OF_FILE)
    assert line.startswith(f"s:4:33: excitation.file: {message}")


def test_a_file_of_poses_that_is_missing_or_no_text_is_reported_at_its_key(tmp_path: Path) -> None:
    (line,) = refused(tmp_path, OF_FILE)
    assert line.startswith("s:4:33: excitation.file: there is no file ./poses.csv")
    (tmp_path / "poses.csv").write_bytes(b"\xff\xfe\x00")
    (line,) = refused(tmp_path, OF_FILE)
    assert line.startswith("s:4:33: excitation.file: ./poses.csv cannot be read")


def test_degrees_stated_as_radians_are_suspected_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text(POSES, "utf-8")
    (line,) = refused(tmp_path, "excitation: {kind: dwell, file: poses.csv, file_unit: rad}")
    assert "2 of 2 poses are beyond the range of a joint: if these numbers are degrees" in line


def test_the_poses_of_a_file_are_counted_for_the_fits(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text(POSES * 3, "utf-8")
    (line,) = refused(tmp_path, OF_FILE + "\nfit: [{estimator: static-wls}]")
    assert line.endswith("(held out: 1 of 6); poses in excitation.file: at least 10")
    (tmp_path / "poses.csv").write_text(POSES * 5, "utf-8")
    accepted(tmp_path / "s.yaml")


def test_the_only_pose_of_a_file_cannot_be_held_out(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text(POSES.partition("\n")[0], "utf-8")
    (line,) = refused(tmp_path, OF_FILE + "\nfit: [{estimator: static-wls}]")
    assert line.endswith("validate.hold_out: holds out all 1 poses of excitation.file and leaves "
                         "none for the fit")  # fmt: skip


@pytest.mark.thorough
def test_a_plan_warns_of_extras_without_which_the_run_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plugins, "find_spec", lambda _: None)
    path = written(tmp_path, "weigh: false\n" + FOURIER + "fit: [{estimator: lagrangian}]")
    done = CliRunner().invoke(app, ["plan", str(path), "--json"])
    assert any("lagrangian needs torch" in text for text in json.loads(done.stdout)["warnings"])
