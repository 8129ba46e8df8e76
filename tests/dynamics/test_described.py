"""An arm described from its URDF is the same arm; one that cannot be described is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import hil.arms
from hil.arms import load_arm
from hil.core.errors import SpecError
from hil.dynamics.dh_from_urdf import described
from hil.dynamics.robot_model import RobotModel, load_model
from hil.planning.custom_arm import own_arm_drafts
from hil.planning.workspace import plannable_arm
from hil.spec.station import StationRobot
from tests.support.paths import FILES

URDF = FILES / "own_arm.urdf"
UR5 = (Path(hil.arms.__file__).parent / "ur5.yaml").read_text("utf-8")


@pytest.fixture
def arm(tmp_path: Path) -> str:
    (*_, draft), _ = own_arm_drafts(URDF, tmp_path / "own.yaml", robot="own", name="own")
    draft.path.write_text(draft.text)
    return str(draft.path)


def changed(folder: Path, old: str, new: str) -> Path:
    text = URDF.read_text()
    assert old in text
    path = folder / "changed.urdf"
    path.write_text(text.replace(old, new))
    return path


def test_torques_are_those_of_the_urdf(arm: str) -> None:
    states = np.random.default_rng(1).uniform(-2, 2, (3, 50, 6))
    by_urdf = RobotModel.from_urdf(URDF).inverse_dynamics(*states)
    by_description = load_model(arm).inverse_dynamics(*states)

    assert np.abs(by_description - by_urdf).max() < 1e-6
    assert np.abs(by_urdf).max() > 10


def test_the_flange_is_where_the_urdf_has_it(arm: str) -> None:
    place = np.eye(4)
    for a, alpha, d, theta in load_arm(arm).dh:
        ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
        place @= [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st],
                  [0, sa, ca, d], [0, 0, 0, 1]]  # fmt: skip
    # By hand: a turret turned by 0.4 rad, on it a forearm of 0.52 m that points 0.1 rad downwards
    # from an elbow 0.04 m high; the steps of 0.04, -0.02 and -0.02 m to the side cancel.
    out = 0.06 + 0.52 * np.cos(0.1) + 0.04 * np.sin(0.1)
    up = 0.3 + 0.1 + 0.45 - 0.52 * np.sin(0.1) + 0.04 * np.cos(0.1)
    assert np.allclose(place[:3, 3], [out * np.cos(0.4), out * np.sin(0.4), up], atol=1e-8)


def test_motions_are_planned_for_it(arm: str) -> None:
    found = plannable_arm(StationRobot(driver="mock", model=arm))
    assert found.n_joints == 6
    assert found.joint_names[0] == "A1"
    assert len(found.capsules) == 7


def test_what_the_urdf_leaves_out_is_told_and_marked(tmp_path: Path) -> None:
    (*_, draft), notes = own_arm_drafts(URDF, tmp_path / "own.yaml", robot="own", name="own")
    assert "joints: A1, A2, A3, A4, A5, A6" in notes
    assert "the URDF has no speed limit for A4, A5: guessed" in notes
    marked = [line for line in draft.text.splitlines() if "GUESS what the URDF" in line]
    assert len(marked) == 2
    draft.path.write_text(draft.text)
    assert load_arm(str(draft.path)).guessed == (
        "rate_hz", "payload_max", "excite", "qdd_max", "gear_ratio", "drive_gain", "capsules",
        "effort_max", "qd_max", "q_limits",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 -1"/>', r"turns about \(0, 0, -1\)"),
        ('xyz="0 0 0.3" rpy', 'xyz="0.1 0 0.3" rpy', r"through \(0.1, 0, 0.3\)"),
        ('<joint name="A6" type="revolute">', '<joint name="A6" type="prismatic">', "slides"),
        ('<mass value="7"/>', '<mass value="0"/>', "boom weighs nothing"),
        ('ixx="0.14"', 'ixx="-0.14"', "boom has an inertia that no body has"),
    ],
)
def test_an_arm_that_cannot_be_described_is_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    with pytest.raises(SpecError, match=message):
        described(changed(tmp_path, old, new))


ELBOW = '<limit lower="-2.2" upper="2.2" effort="120" velocity="3"/>'


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        ('lower="0" upper="0" effort="1" velocity="1"', r"joint 'A3' has no range \(0 to 0\)"),
        ('effort="1" velocity="1"', r"joint 'A3' has no range \(0 to 0\)"),
        (
            'lower="-150" upper="150" effort="1" velocity="115"',
            "joint 'A3' turns from -150 to 150 rad, 48 turns; are its limits in degrees",
        ),
    ],
)
def test_limits_of_no_arm_are_refused(tmp_path: Path, limit: str, message: str) -> None:
    with pytest.raises(SpecError, match=message) as caught:
        own_arm_drafts(
            changed(tmp_path, ELBOW, f"<limit {limit}/>"), tmp_path / "o.yaml", robot="o", name="o"
        )
    assert "continuous" in caught.value.hint


def test_a_speed_that_no_joint_has_is_told_and_guessed(tmp_path: Path) -> None:
    urdf = changed(tmp_path, ELBOW, ELBOW.replace('"3"', '"115"'))
    (*_, draft), notes = own_arm_drafts(urdf, tmp_path / "own.yaml", robot="own", name="own")
    assert notes[0] == (
        "speed limits that no arm has (are they degrees per second?): A3 115 rad/s: not taken"
    )
    assert "the URDF has no speed limit for A3, A4, A5: guessed" in notes
    draft.path.write_text(draft.text)
    arm = load_arm(str(draft.path))
    assert "qd_max" in arm.guessed
    assert np.degrees(arm.qd_max[2]) == pytest.approx(90)


@pytest.mark.parametrize(("low", "high"), [(-0.05, 0.05), (2.3, 3.5), (-6, 6)])
def test_programs_move_inside_the_limits_however_narrow(
    tmp_path: Path, low: float, high: float
) -> None:
    limits = ELBOW.replace("-2.2", str(low)).replace('"2.2"', f'"{high}"')
    urdf = changed(tmp_path, ELBOW, limits)
    (*_, draft), _ = own_arm_drafts(urdf, tmp_path / "own.yaml", robot="own", name="own")
    draft.path.write_text(draft.text)
    arm = load_arm(str(draft.path))
    assert low < arm.excite_min[2] < arm.excite_max[2] < high


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rate_hz: 250\n", "the arm lacks 'joints'"),
        ("- 1\n", "describes no arm"),
        ("a: [1\n", "cannot be read as an arm"),
        (UR5.replace("drive_gain_nm_a: 10.15", "drive_gain_nm_a: 0"), "a drive_gain_nm_a is 0"),
    ],
    ids=["no joints", "a list", "torn", "no gain"],
)
def test_a_description_that_is_none_says_why(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "arm.yaml"
    path.write_text(text)
    with pytest.raises(SpecError, match=message):
        load_arm(str(path))
