"""A model from a short program on the mock: rest poses on the command line, the arm led by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.control.hand_guiding import HandGuiding
from hil.core.errors import FitError, PlanError, SpecError
from hil.estimators import load_model_file
from hil_mock_robot.embedded.robot import MockRobot
from tests.support.recorded import model_of

START_DEG = [20, -70, 60, -40, 60, 10]
FRICTION = [5.3, 5.5, 4.4, 1.25, 1.1, 1.15]
"""Dry friction of this type of arm [N·m]; this arm's own differs."""
PUSHES = {"shoulder_pan_joint": 12.0, "shoulder_lift_joint": -14.0, "wrist_1_joint": 3.0}
PUSHED = (60, 125)
"""First and last sample of a push."""
SAMPLES = 400


@pytest.fixture(scope="module")
def folder(dwell_run: Path) -> Path:
    return model_of(dwell_run)


@pytest.fixture(scope="module")
def found(folder: Path) -> Any:
    """What is found with nothing mounted and nothing but a table around."""
    return asked(folder, "--near", "0,-45,45,0,0,0")


@pytest.fixture
def few_searches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it is not the optimum that matters."""
    monkeypatch.setattr("hil.control.rest_pose.STARTS", 6)


def asked(*arguments: Any) -> Any:
    """The JSON document of `hil rest-pose`; errors of hil are raised."""
    done = CliRunner().invoke(app, ["rest-pose", *map(str, arguments), "--json"])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return json.loads(done.stdout)


def bench(path: Path, **robot: Any) -> Path:
    described = {"driver": "mock", "model": "ur5"} | robot
    document = {"hil_station": 1, "name": "cell", "robots": {"left": described}}
    path.write_text(json.dumps(document), "utf-8")
    return path


@pytest.mark.thorough
def test_poses_of_a_fitted_model_load_the_brakes_less_than_home(found) -> None:
    efforts = [pose["effort_percent"] for pose in found["poses"]]
    home, given = found["compared"]
    assert min(efforts) < 0.1 < 5.0 < home["effort_percent"]
    assert efforts[0] < given["effort_percent"]
    assert all(pose["clear"] and pose["clearance_mm"] >= 20 - 1e-3 for pose in found["poses"])
    assert found["poses"][0]["brakes_fail"]["outcome"] == "tips"


@pytest.mark.thorough
@pytest.mark.usefixtures("few_searches")
def test_walls_of_the_station_are_kept_clear_of(folder, found, tmp_path) -> None:
    low = {"name": "hood", "point_m": [0, 0, 0.7], "normal": [0, 0, -1]}
    station = bench(tmp_path / "s.yaml", surroundings={"walls": [low]})
    document = asked(folder, "--station", station, "--robot", "left", "--clearance-mm", 35)
    assert document["poses"][0]["effort_percent"] > found["poses"][0]["effort_percent"] + 0.5
    assert all(pose["clearance_mm"] >= 35 - 1e-3 for pose in document["poses"])


@pytest.mark.thorough
@pytest.mark.usefixtures("few_searches")
def test_a_load_is_held_too(folder, found) -> None:
    loaded = asked(folder, "--near", "0,-45,45,0,0,0", "--payload", "3,0,0,0.1")
    held = [document["compared"][-1]["torque_nm"][1] for document in (found, loaded)]
    assert abs(held[1]) > abs(held[0]) + 15.0


@pytest.mark.parametrize(
    ("robot", "problem"),
    [
        ({"model": "ur10"}, "the model is for a ur5, but left is a ur10"),
        ({"gravity_m_s2": [0, 0, 9.81]}, "left is mounted under"),
    ],
)
def test_a_robot_that_is_another_is_refused(folder, tmp_path, robot, problem) -> None:
    with pytest.raises(SpecError, match=problem):
        asked(folder, "--station", bench(tmp_path / "s.yaml", **robot), "--robot", "left")


@pytest.mark.parametrize(
    ("arguments", "error", "problem"),
    [
        (("--robot", "lft"), SpecError, "no robot 'lft'"),
        (("--clearance-mm", "-5"), SpecError, "invalid clearance: -5 mm"),
        (("--clearance-mm", "2000"), PlanError, "clearance of 2000 mm"),
        (("--near", "0,0,0"), SpecError, "3 joint angles"),
        (("--near", "upright"), SpecError, "is not a pose"),
        (("--payload", "50"), SpecError, "rated"),
    ],
)
def test_what_cannot_be_is_an_error(folder, arguments, error, problem) -> None:
    with pytest.raises(error, match=problem):
        asked(folder, *arguments)


@pytest.mark.thorough
@pytest.mark.usefixtures("few_searches")
def test_in_a_terminal_of_60_columns_no_line_is_longer(folder, monkeypatch) -> None:
    monkeypatch.setattr("hil.cli.rest_pose.out_width", lambda: 60)
    monkeypatch.setattr("hil.cli.output.out_width", lambda: 60)
    done = CliRunner().invoke(app, ["rest-pose", str(folder)])
    assert done.exit_code == 0
    lines = done.stdout.splitlines()
    assert max(map(len, lines)) <= 60
    assert sum("torque [N·m]" in line for line in lines) == 4  # three poses, and home


def led(model, push_nm, joint, **settings) -> tuple[np.ndarray, np.ndarray]:
    """Positions [°] and speeds [rad/s] (N, 6) of an arm that is pushed for half a second."""
    robot = MockRobot("led", seed=0, block=1, start_q_deg=START_DEG)
    robot.connect()
    guiding = HandGuiding(model, friction=FRICTION, **settings)
    gains = np.array(robot.capabilities.drive_gains)
    row, q, qd = robot.read()[-1], [], []
    for k in range(SAMPLES):
        push = np.zeros(6)
        push[joint] = push_nm if PUSHED[0] <= k < PUSHED[1] else 0.0
        robot.push(push)
        robot.command_torque(guiding(row["q"], row["qd"]) * gains)
        row = robot.read()[-1]
        q.append(row["q"].copy())
        qd.append(row["qd"].copy())
    return np.degrees(q), np.array(qd)


@pytest.mark.thorough
@pytest.mark.parametrize("name", PUSHES)
def test_an_arm_led_by_hand_stays_yields_and_comes_to_rest(folder, name) -> None:
    model = load_model_file(folder)
    joint, push = model.joint_names_.index(name), PUSHES[name]
    q, qd = led(model, push, joint, friction_share=0.7)
    stiff, _ = led(model, push, joint, friction_share=0.0)
    alone = q[: PUSHED[0]]
    assert np.ptp(alone, axis=0).max() < 0.02  # nobody's hand: it stays put
    moved, without = (run[-1, joint] - run[PUSHED[0], joint] for run in (q, stiff))
    assert np.sign(moved) == np.sign(push)
    assert abs(moved) > 1.7 * abs(without) > 0.0
    assert not qd[-50:].any()  # let go, it comes to rest
    others = np.delete(q[-1] - q[PUSHED[0]], joint)
    assert np.abs(others).max() < 1.0


def test_without_its_gravity_the_arm_falls(folder) -> None:
    """What the test above would look like if the mock held the arm by itself."""
    robot = MockRobot("falls", seed=0, block=1, start_q_deg=START_DEG)
    robot.connect()
    robot.read()
    robot.command_torque(np.zeros(6))
    rows = [robot.read()[-1] for _ in range(30)]
    assert np.abs(np.degrees(rows[-1]["q"] - rows[0]["q"])).max() > 2.0


def test_a_static_model_has_to_be_told_the_friction(folder) -> None:
    with pytest.raises(FitError, match="dry friction"):
        HandGuiding(load_model_file(folder))
