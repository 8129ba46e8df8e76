"""The embedded mock as a robot of the protocol, also on another day, in another room, or worn."""

from __future__ import annotations

import subprocess
import sys
import threading

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import CommandRefused, RobotConnectionError, RobotFault, SpecError
from hil.robot import Robot, Status, state_dtype
from hil_mock_robot.embedded.robot import MockRobot
from hil_mock_robot.mocks import EmbeddedMock
from tests.support.in_time import InTime, measured_again
from tests.support.mock_motions import blend, fourier, play, segment

UPRIGHT = np.radians([0.0, -90.0, 0.0, -90.0, 0.0, 0.0])
FAR = UPRIGHT + np.array([7.0, 0, 0, 0, 0, 0])
ASIDE = UPRIGHT + np.radians([30.0, 20.0, -40.0, 30.0, 25.0, -60.0])


@pytest.fixture
def robot():
    mock = MockRobot("bench", seed=3)
    mock.connect()
    yield mock
    mock.close()


def move(start=UPRIGHT, end=ASIDE, index=0, duration_s=1.6):
    return segment(blend(start, end, 125, duration_s), index, "move")


def test_is_a_robot_of_the_protocol(robot):
    assert isinstance(robot, Robot)
    assert robot.capabilities.clock == "virtual"
    assert robot.read().dtype == state_dtype(6)


def test_knows_its_joints_and_limits_before_it_is_connected():
    mock = MockRobot("bench", "lab6")
    assert len(mock.capabilities.joint_names) == 6
    assert mock.capabilities.rate_hz == 250
    assert mock.limits.payload_max_kg == 7
    with pytest.raises(RobotConnectionError, match="bench is not connected"):
        _ = mock.identity


@pytest.mark.parametrize("member", ["read", "start"])
def test_refuses_to_work_before_it_is_connected(member):
    with pytest.raises(RobotConnectionError, match="connect"):
        getattr(MockRobot("bench"), member)()


def test_connect_stop_and_close_may_be_called_again():
    mock = MockRobot("bench")
    mock.stop()
    mock.close()
    mock.connect()
    mock.connect()
    mock.stop()
    mock.stop()
    mock.close()
    mock.close()
    mock.connect()
    assert len(mock.read()) == 16


def test_every_set_point_gives_one_row_and_the_last_is_holding(robot):
    piece = move(index=7)
    rows = play(robot, piece)
    assert np.array_equal(rows["q_target"], piece.q)
    assert (rows["segment"] == 7).all()
    assert (rows["status"][:-1] == Status.MOVING).all()
    assert rows["status"][-1] == Status.HOLDING
    assert np.abs(rows["q"] - piece.q).max() < 3e-3


def test_holds_for_as_long_as_it_is_read(robot):
    play(robot, move(index=2))
    rows = np.concatenate([robot.read() for _ in range(20)])
    assert (rows["status"] == Status.HOLDING).all()
    assert (rows["segment"] == 2).all()
    assert np.array_equal(rows["q_target"], np.repeat(ASIDE[None], len(rows), axis=0))


def test_device_time_has_neither_gaps_nor_duplicates(robot):
    rows = np.concatenate([robot.read(), play(robot, move()), robot.read()])
    assert np.diff(rows["device_time"]) == pytest.approx(np.full(len(rows) - 1, 1 / 125))
    assert np.diff(rows["host_time"]) == pytest.approx(np.full(len(rows) - 1, 1 / 125), abs=1e-6)


def test_reported_velocity_is_exactly_zero_at_rest(robot):
    play(robot, move())
    for _ in range(10):
        robot.read()
    assert (robot.read()["qd"] == 0.0).all()


@pytest.mark.thorough
@pytest.mark.parametrize("profile", ["full", "ideal"])
def test_same_seed_gives_the_same_bytes_and_another_seed_others(profile):
    def record(seed):
        mock = MockRobot("bench", seed=seed, profile=profile)
        mock.connect()
        mock.set_payload(Payload(1.0, (0, 0, 0.05)))
        return np.concatenate([mock.read(), play(mock, move()), mock.read()]).tobytes()

    assert record(5) == record(5)
    assert record(5) != record(6)


def test_block_size_leaves_no_trace():
    def record(block):
        mock = MockRobot("bench", seed=5, block=block)
        mock.connect()
        return play(mock, move())

    assert record(16).tobytes() == record(5).tobytes()


BAD = {
    "starts 5.730° away": lambda: move(UPRIGHT + 0.1, ASIDE),
    "leaves its position range": lambda: move(UPRIGHT, FAR, duration_s=9),
    "exceeds its speed limit": lambda: move(duration_s=0.3),
    "exceeds its acceleration limit": lambda: move(duration_s=0.3),
    "must start and end at standstill": lambda: segment(blend(UPRIGHT, ASIDE, 125, 2.0)[:100]),
    "not a finite number": lambda: segment(np.full((3, 3, 6), np.nan)),
    "must all be": lambda: segment(np.zeros((3, 3, 5))),
    "position steps above": lambda: segment(np.array([[UPRIGHT, 0 * ASIDE, 0 * ASIDE],
                                              [ASIDE, 0 * ASIDE, 0 * ASIDE]])),
    "a hold must have one": lambda: segment(np.repeat(blend(UPRIGHT, ASIDE, 125, 2)[:1], 2, 0), 0,
                                      "hold"),
}  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("reason", BAD)
def test_refuses_segments_it_must_not_run(robot, reason):
    with pytest.raises(CommandRefused, match=reason):
        robot.prepare(BAD[reason]())


def test_refuses_to_start_unprepared_or_over_a_running_segment(robot):
    with pytest.raises(CommandRefused, match="without a prepared"):
        robot.start()
    robot.prepare(move())
    robot.start()
    robot.read()
    robot.prepare(move(ASIDE, UPRIGHT, 1))
    with pytest.raises(CommandRefused, match="still running"):
        robot.start()


def test_stop_decelerates_on_the_planned_path_and_comes_to_rest(robot):
    path = fourier(UPRIGHT, 125, seed=1, peak_rad_s=2.0)
    start = blend(UPRIGHT, UPRIGHT, 125, 0.1)
    piece = segment(np.concatenate((start, path)))
    robot.prepare(piece)
    robot.start()
    before = np.concatenate([robot.read() for _ in range(20)])
    robot.stop()
    after = np.concatenate([robot.read() for _ in range(10)])
    moving = after[after["status"] == Status.MOVING]
    assert np.abs(before["qd_target"][-1]).max() > 0.3
    assert len(moving) * 8e-3 < 0.6
    assert np.abs(np.diff(after["qd_target"], axis=0)).max() * 125 < robot.limits.qdd_max.min()
    distance = [np.abs(piece.q - q).max(axis=1).min() for q in moving["q_target"]]
    assert max(distance) < 0.01
    assert (after["qd_target"][-1] == 0).all()
    assert (robot.read()["status"] == Status.HOLDING).all()


def test_runs_on_after_a_stop_from_where_it_stands(robot):
    robot.prepare(move())
    robot.start()
    for _ in range(5):
        robot.read()
    robot.stop()
    for _ in range(5):
        stands = robot.read()["q_target"][-1]
    rows = play(robot, move(stands, UPRIGHT, 4))
    assert np.abs(rows["q"][-1] - UPRIGHT).max() < 2e-3


def test_too_heavy_a_payload_and_one_in_motion_are_refused(robot):
    with pytest.raises(CommandRefused, match="6 kg"):
        robot.set_payload(Payload(6.0))
    assert robot.set_payload(Payload(3.0, (0, 0, 0.05))) == Payload(3.0, (0, 0, 0.05))
    robot.prepare(move())
    robot.start()
    robot.read()
    with pytest.raises(CommandRefused, match="motion"):
        robot.set_payload(Payload(1.0))


def test_mounted_payload_option_overrides_what_is_declared():
    held = {}
    for mounted in (None, {"mass_kg": 4.0, "com_m": [0, 0, 0.05]}):
        mock = MockRobot("b", profile="ideal", mounted_payload=mounted, start_q_deg=[0, 0] * 3)
        mock.connect()
        mock.set_payload(Payload(0.0))
        held[mounted is None] = np.concatenate([mock.read() for _ in range(20)])["effort"][-50:]
    assert held[False].mean(axis=0)[1] < held[True].mean(axis=0)[1] - 2.0


def test_push_beyond_the_torque_limit_is_a_protective_stop_until_reconnected(robot):
    robot.push([-200.0, 0, 0, 0, 0, 0])
    last = robot.read()
    while not last["status"][-1] & Status.FAULT:
        last = robot.read()
    assert last["fault_code"][-1] != 0
    with pytest.raises(RobotFault, match="protective stop"):
        robot.read()
    robot.stop()
    robot.push(np.zeros(6))
    robot.connect()
    assert np.concatenate([robot.read() for _ in range(30)])["status"][-1] == Status.HOLDING


def test_small_push_shows_in_the_current(robot):
    before = np.concatenate([robot.read() for _ in range(20)])["effort"][-100:].mean(axis=0)
    robot.push([40.0, 0, 0, 0, 0, 0])
    after = np.concatenate([robot.read() for _ in range(20)])["effort"][-100:].mean(axis=0)
    assert before[0] - after[0] > 2.0


def test_worn_joints_need_more_current(robot):
    def mean_current(start, end):
        rows = play(robot, move(start, end))
        return np.abs(rows["effort"][50:150]).mean(axis=0)

    fresh = mean_current(UPRIGHT, ASIDE)
    play(robot, move(ASIDE, UPRIGHT))
    robot.wear([2.0] * 6)
    assert (mean_current(UPRIGHT, ASIDE)[[0, 3, 4, 5]] > 1.4 * fresh[[0, 3, 4, 5]]).all()


def test_torque_command_moves_the_arm_and_ends_in_a_hold(robot):
    robot.command_torque([12.0, 0, 0, 0, 0, 0])
    rows = np.concatenate([robot.read() for _ in range(2)])
    assert rows["q"][-1, 0] > 0.001
    assert (rows["mode"] == 1).all()
    assert np.isnan(rows["q_target"]).all()
    robot.stop()
    rows = np.concatenate([robot.read() for _ in range(10)])
    assert rows["status"][-1] == Status.HOLDING
    assert np.abs(rows["q"][-1] - rows["q_target"][-1]).max() < 2e-3


def test_truth_file_makes_the_same_robot_as_its_seed(tmp_path):
    path = EmbeddedMock().write_truth(tmp_path / "truth.json", "ur5", 9)
    robots = [MockRobot("b", seed=9), MockRobot("b", truth_file=str(path))]
    for mock in robots:
        mock.connect()
    assert robots[0].read().tobytes() == robots[1].read().tobytes()
    with pytest.raises(SpecError, match="the station names lab6"):
        MockRobot("b", "lab6", truth_file=str(path))


@pytest.mark.parametrize(
    "options",
    [
        {"sead": 1},
        {"seed": "one"},
        {"seed": True},
        {"block": 0},
        {"substep_hz": 1500},
        {"substep_hz": 1e6},
        {"rate_hz": 0},
        {"rate_hz": "fast"},
        {"temperature_c": float("nan")},
        {"truth_file": 5},
        {"mount": 5},
        {"mount": ["down", 0, 0]},
        {"profile": "fast"},
        {"mounted_payload": {"mass": 1}},
        {"mounted_payload": {"mass_kg": "heavy"}},
        {"mounted_payload": {"mass_kg": -1}},
        {"mounted_payload": {"mass_kg": 1, "com_m": 5}},
        {"mounted_payload": {"mass_kg": 1, "inertia_kgm2": [1, 2]}},
        {"mounted_payload": [1, 2]},
        {"start_q_deg": "upright"},
        {"start_q_deg": [0, 0]},
        {"start_q_deg": [400, 0, 0, 0, 0, 0]},
    ],
)
def test_options_that_cannot_be_are_refused(options):
    with pytest.raises(SpecError):
        MockRobot("bench", **options)


def test_an_option_that_cannot_be_is_named_with_what_would_be():
    with pytest.raises(SpecError, match=r"mounted_payload\.com_m is 5") as error:
        MockRobot("bench", mounted_payload={"mass_kg": 1, "com_m": 5})
    assert "com_m (3)" in error.value.hint


@measured_again
def test_no_block_is_so_long_that_stop_would_wait_for_it():
    with pytest.raises(SpecError, match="block is 400000") as error:
        MockRobot("bench", block=400_000)
    assert "at most 125" in error.value.hint
    mock = MockRobot("bench", block=125)
    mock.connect()
    mock.read()
    reading = threading.Thread(target=lambda: [mock.read() for _ in range(3)])
    reading.start()
    asked = InTime()
    mock.stop()
    taken = asked.taken()
    reading.join()
    taken.require(0.5)


def in_a_fresh_process(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


@pytest.mark.thorough
def test_mujoco_and_numba_load_on_connect_only():
    code = (
        "import sys, hil.arms, hil.robot; from hil_mock_robot.embedded.robot import MockRobot;"
        "MockRobot('b').limits; print(sorted({'mujoco', 'numba'} & set(sys.modules)))"
    )
    assert in_a_fresh_process(code).stdout.strip() == "[]"


@pytest.mark.thorough
def test_missing_libraries_are_a_plugin_error_that_says_what_to_install():
    code = (
        "import importlib.util as u; find = u.find_spec;"
        "u.find_spec = lambda n, *a: None if n in ('mujoco', 'numba') else find(n, *a);"
        "from hil_mock_robot.embedded.robot import MockRobot\n"
        "from hil.core.errors import PluginError\n"
        "try: MockRobot('b')\n"
        "except PluginError as e: print(e)"
    )
    result = in_a_fresh_process(code)
    assert "mujoco and numba" in result.stdout, result.stderr
    assert 'pip install "hil[mock]"' in result.stdout


# The same robot on another day, in another room, or worn.


SHOULDER = 1


def rows(**options):
    robot = MockRobot("aged", "ur5", seed=1, **options)
    robot.connect()
    found = np.concatenate([robot.read() for _ in range(8)])
    robot.close()
    return found


def moved(**options):
    """Effort at the pan's steady speed, where nothing but friction takes it."""
    robot = MockRobot("aged", "ur5", seed=1, profile="ideal", rate_hz=125, **options)
    robot.connect()
    robot.command_torque(None)
    friction = []
    arm = robot._arm.on
    for k in range(200):
        q = arm.setpoint[0].copy()
        q[0] += 0.5 / 125
        arm.advance(np.array([[q, [0.5, 0, 0, 0, 0, 0], np.zeros(6)]]))
        friction += [arm.friction[0]] if k > 150 else []
    robot.close()
    return abs(np.mean(friction))


def test_another_day_has_other_noise_of_the_same_size() -> None:
    first, again, other = rows(), rows(day=0), rows(day=1)
    assert np.array_equal(first["effort"], again["effort"])
    assert not np.array_equal(first["effort"], other["effort"])
    assert np.std(other["effort"]) == pytest.approx(np.std(first["effort"]), rel=0.1)


def test_a_warm_room_warms_the_joints() -> None:
    assert rows(room_c=31.0)["temperature"][0] == pytest.approx(31.0, abs=1.0)


def test_wear_is_more_friction_in_its_joint() -> None:
    worn = moved(wear=[1.15, 1, 1, 1, 1, 1])
    assert worn / moved() == pytest.approx(1.15, rel=0.01)
    assert moved(wear=[1, 1.15, 1, 1, 1, 1]) == pytest.approx(moved(), rel=0.01)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"wear": [1, 2]}, "wear"),
        ({"wear": [1, 1, 1, 1, 1, 0]}, "wear"),
        ({"wear": "much"}, "wear"),
        ({"day": -1}, "day"),
        ({"day": True}, "day"),
        ({"room_c": 99}, "room_c"),
    ],
)
def test_slips_are_told(given, words) -> None:
    with pytest.raises(SpecError, match=f"mock option {words} is"):
        MockRobot("aged", "ur5", **given)
