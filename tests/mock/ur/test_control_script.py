"""The emulated control script, in ticks: handshake, moves, streams, stops and what they leave."""

import numpy as np
import pytest

from hil_mock_robot.ur.control_script import HANDLERS
from hil_mock_robot.ur.kinematics import jacobian, pose_of, pose_trans
from hil_mock_robot.ur.modes import RuntimeState
from hil_mock_robot.ur.program import ANOTHER_THREAD, set_watchdog
from hil_mock_robot.ur.routes import Leg
from tests.support.ur_control_parts import (
    DONE,
    HOME,
    MOVE_PATH,
    MOVEJ,
    MOVEL,
    READY,
    SERVO_STOP,
    SERVOJ,
    SET_PAYLOAD,
    SPEED_STOP,
    SPEEDJ,
    STOP_SCRIPT,
    STOPJ,
    STOPL,
    TARGET_PAYLOAD,
    WATCHDOG,
    Client,
    beside,
)


def test_the_script_is_ready_in_its_first_tick_and_has_no_operation_under_way():
    client = Client()
    assert client.state == READY
    assert client.progress is None


def test_done_stays_until_the_command_is_cleared_and_it_is_carried_out_once():
    client = Client()
    client.write(MOVEJ, [*HOME, 3.0, 20.0], 0)
    while client.state != DONE:
        client.machine.tick()
    client.machine.write("input_double_register_0", 1.5)
    client.pass_ticks(50)
    assert client.state == DONE
    np.testing.assert_allclose(client.q, HOME, atol=1e-9)
    client.write(0)
    client.machine.tick()
    assert client.state == READY


def test_an_unknown_command_is_done_at_once():
    assert Client().call(200) == 1


def test_stop_script_ends_the_program_and_does_not_say_done():
    client = Client()
    client.write(STOP_SCRIPT)
    client.machine.tick()
    assert client.machine.runtime is RuntimeState.STOPPED
    assert client.state == READY


def test_a_synchronous_move_blocks_for_as_long_as_it_takes():
    client = Client()
    client.go()
    target = beside(0.5, 0, 0, 0, 0, 0)
    ticks = client.call(MOVEJ, [*target, 1.0, 2.0])
    # Trapezoid: 0.5 rad at 1 rad/s and 2 rad/s² take 0.5/1 + 1/2 = 1 s.
    assert ticks * client.machine.tick_s == pytest.approx(1.0, abs=0.03)
    np.testing.assert_allclose(client.q, target, atol=1e-9)


def test_a_linear_move_keeps_the_tool_on_its_line():
    client = Client()
    client.go()
    arm, tcp = client.machine.body.arm, client.machine.tcp
    start = pose_of(arm, HOME, tcp)
    target = start + np.array([0.05, -0.03, 0.1, 0, 0, 0])
    client.write(MOVEL, [*target, 0.25, 1.2], 0)
    way = (target - start)[:3] / np.linalg.norm((target - start)[:3])
    furthest = 0.0
    while client.state != DONE:
        client.machine.tick()
        away = pose_of(arm, client.q, tcp)[:3] - start[:3]
        furthest = max(furthest, np.linalg.norm(away - (away @ way) * way))
    assert furthest < 1e-5
    np.testing.assert_allclose(pose_of(arm, client.q, tcp), target, atol=1e-6)


def test_an_asynchronous_move_is_done_at_once_and_told_by_its_word():
    client = Client()
    operation = client.operation
    assert client.call(MOVEJ, [*HOME, 1.0, 2.0], 1) == 1
    assert client.progress == 0
    assert client.operation == operation + 1
    assert client.settle() > 50
    client.pass_ticks(2)
    assert client.progress is None
    np.testing.assert_allclose(client.q, HOME, atol=1e-9)


def test_a_second_asynchronous_move_replaces_the_first():
    client = Client()
    client.call(MOVEJ, [*HOME, 0.5, 1.0], 1)
    client.pass_ticks(100)
    other = HOME + 0.3
    client.call(MOVEJ, [*other, 1.0, 2.0], 1)
    client.settle()
    client.pass_ticks(2)
    np.testing.assert_allclose(client.q, other, atol=1e-9)
    assert client.errors == []


@pytest.mark.parametrize("stop", [STOPJ, STOPL])
def test_a_stop_ends_an_asynchronous_move_at_rest(stop):
    client = Client()
    client.go()
    client.call(MOVEJ, [*beside(1, 0, 0, 0, 0, 0), 1.0, 2.0], 1)
    client.pass_ticks(80)
    assert np.abs(client.qd).max() > 0.5
    # 1 rad/s at 2 rad/s² takes 0.5 s.
    assert client.call(stop, [2.0]) * client.machine.tick_s < 0.7
    assert not client.qd.any()
    assert client.progress is None
    assert client.q[0] < HOME[0] + 0.95


def test_an_asynchronous_stop_makes_all_later_ones_stop_in_tool_space():
    client = Client()
    client.go()
    script = client.machine.program
    client.call(MOVEJ, [*beside(1, 0, 0, 0, 0, 0), 1.0, 2.0], 1)
    client.pass_ticks(60)
    assert not script.stop_linear
    assert client.call(STOPJ, [2.0], 1) == 1
    assert client.progress == 0
    client.settle()
    client.pass_ticks(2)
    assert client.progress is None
    assert script.stop_linear


PATH = (
    ((0,), Leg("j", HOME, 1.0, 2.0, radius=0.02)),
    ((1,), Leg("j", beside(0.4, 0, 0.2, 0, 0, 0), 1.0, 2.0, radius=0.02)),
    ((2,), Leg("j", beside(0.4, 0.3, 0.2, 0, 0, 0), 1.0, 2.0)),
)


def test_a_path_tells_which_move_it_is_at():
    client = Client(path=PATH)
    seen = []
    client.call(MOVE_PATH, flag=1)
    while client.progress is not None:
        seen.append(client.progress)
        client.machine.tick()
    assert sorted(set(seen)) == [0, 1, 2]
    assert seen == sorted(seen)
    np.testing.assert_allclose(client.q, PATH[-1][1].target, atol=1e-9)


def test_a_path_with_radii_does_not_stop_on_its_way():
    client = Client(path=PATH)
    client.write(MOVE_PATH, flag=0)
    slowest = []
    while client.state != DONE:
        client.machine.tick()
        if client.progress == 1:
            slowest.append(np.abs(client.qd).max())
    assert min(slowest) > 0.05
    np.testing.assert_allclose(client.q, PATH[-1][1].target, atol=1e-9)


def test_servoj_goes_on_until_it_is_stopped_and_is_carried_out_anew_every_tick():
    client = Client()
    client.go()
    for i in range(100):
        client.stream(SERVOJ, [*beside(0.002 * i, 0, 0, 0, 0, 0), 0, 0, 0.008, 0.1, 300])
        assert client.state == READY
    client.pass_ticks(300)
    assert client.q[0] == pytest.approx(HOME[0] + 0.198, abs=1e-3)
    client.write(0)
    client.machine.tick()
    assert client.call(SERVO_STOP, [10.0]) is not None
    assert not client.qd.any()
    assert client.call(MOVEJ, [*HOME, 1.0, 5.0]) is not None


def test_a_move_beside_a_servo_thread_is_a_runtime_error():
    client = Client()
    client.stream(SERVOJ, [*client.q, 0, 0, 0.008, 0.1, 300], 3)
    client.write(0)
    client.machine.tick()
    assert client.call(MOVEJ, [*HOME, 1.0, 2.0]) is None
    assert client.errors == [ANOTHER_THREAD]
    assert client.machine.runtime is RuntimeState.STOPPED


def test_speedj_does_not_end_after_its_time():
    client = Client()
    client.go()
    client.stream(SPEEDJ, [0.2, 0, 0, 0, 0, 0, 1.0, 0.05], 1)
    client.write(0)
    client.pass_ticks(125)
    assert client.qd[0] == pytest.approx(0.2)
    assert client.call(SPEED_STOP, [1.0]) * client.machine.tick_s == pytest.approx(0.2, abs=0.03)
    assert not client.qd.any()


def test_jogging_along_the_tool_moves_it_along_its_own_axis():
    client = Client()
    client.go()
    arm, tcp = client.machine.body.arm, client.machine.tcp
    client.call(41, [0, 0, 0.05, 0, 0, 0, 1, 0.5, *[0] * 6])
    before = pose_of(arm, client.q, tcp)
    client.pass_ticks(125)
    after = pose_of(arm, client.q, tcp)
    along = pose_trans(before, np.array([0, 0, 1, 0, 0, 0.0]))[:3] - before[:3]
    assert (after - before)[:3] @ along == pytest.approx(0.05, rel=0.2)
    assert np.linalg.norm(np.cross((after - before)[:3], along)) < 2e-3
    assert client.call(42) is not None


def test_a_moving_thread_outlives_its_client_until_the_program_ends():
    client = Client()
    client.stream(SPEEDJ, [0.2, 0, 0, 0, 0, 0, 1.0, 0.0], 60)
    client.write(STOP_SCRIPT)
    client.machine.tick()
    assert client.settle() < 60
    assert not client.qd.any()


def test_the_watchdog_stops_the_program_when_its_register_is_not_written():
    client = Client()
    client.stream(SPEEDJ, [0.2, 0, 0, 0, 0, 0, 1.0, 0.0], 1)
    client.write(0)
    client.machine.tick()
    assert client.call(WATCHDOG, [10.0]) == 1
    for _ in range(50):  # 4 s
        client.write(0)
        client.pass_ticks(10)
        assert client.playing
    client.pass_ticks(20)
    assert client.machine.runtime is RuntimeState.STOPPED
    client.settle()
    assert not client.qd.any()


def test_a_watchdog_counts_from_when_it_is_set():
    client = Client()
    client.machine.write("input_int_register_5", 1)
    client.pass_ticks(300)
    set_watchdog(client.machine, "input_int_register_5", 1.0, "STOP")
    client.pass_ticks(124)
    assert client.playing
    client.pass_ticks(3)
    assert not client.playing


@pytest.mark.parametrize("least_hz", [5e-324, 1e-320, 1e-300, 1e-12])
def test_a_watchdog_slower_than_any_life_is_set_and_stops_nothing(least_hz):
    client = Client()
    assert client.call(WATCHDOG, [least_hz]) == 1
    client.pass_ticks(100)
    assert client.playing


def test_a_paused_move_is_gone_on_with():
    client = Client()
    client.go()
    target = beside(0.8, 0, 0, 0, 0, 0)
    client.write(MOVEJ, [*target, 1.0, 2.0], 0)
    client.pass_ticks(50)
    client.machine.pause()
    client.pass_ticks(100)
    assert not client.qd.any()
    assert HOME[0] < client.q[0] < target[0] - 0.1
    client.machine.resume()
    for _ in range(500):
        client.machine.tick()
        if client.state == DONE:
            break
    np.testing.assert_allclose(client.q, target, atol=1e-9)


def test_a_paused_path_goes_on_with_the_move_it_fell_into():
    client = Client(path=PATH)
    client.write(MOVE_PATH, flag=1)
    while client.progress != 1:
        client.machine.tick()
    client.pass_ticks(20)
    client.machine.pause()
    client.pass_ticks(100)
    paused_at = client.q[0]
    client.machine.resume()
    seen = set()
    while client.progress is not None:
        seen.add(client.progress)
        assert client.q[0] > paused_at - 1e-9
        client.machine.tick()
    assert seen == {1, 2}
    np.testing.assert_allclose(client.q, PATH[-1][1].target, atol=1e-9)


def test_a_protective_stop_by_program_pauses_it():
    client = Client()
    client.write(31, flag=0)
    client.pass_ticks(2)
    assert client.machine.runtime is RuntimeState.PAUSED
    assert not client.machine.modes.running


@pytest.mark.parametrize(
    ("arm", "expected"), [("ur5", (0.0, 0.0, 0.0)), ("ur5e", (0.01, 0.02, 0.05))]
)
def test_a_payload_with_a_centre_of_zeros_keeps_the_old_one_on_e_series_only(arm, expected):
    client = Client(arm)
    client.call(SET_PAYLOAD, [1.5, 0.01, 0.02, 0.05])
    assert client.machine.outputs["payload_cog"] == pytest.approx([0.01, 0.02, 0.05])
    client.call(SET_PAYLOAD, [2.0, 0, 0, 0])
    assert client.machine.body.declared.mass == 2.0
    assert client.machine.body.declared.com == pytest.approx(expected)


@pytest.mark.parametrize(("arm", "mass"), [("ur5", 0.0), ("ur5e", 1.5)])
def test_a_target_payload_is_nothing_on_cb3_and_done_nevertheless(arm, mass):
    client = Client(arm)
    inertia = [0.01, 0.02, 0.02, 0.001, 0, 0]
    assert client.call(TARGET_PAYLOAD, [1.5, 0, 0, 0.05, *inertia]) == 1
    assert client.machine.body.declared.mass == mass
    if mass:
        assert client.machine.body.declared.inertia == pytest.approx(inertia)


@pytest.mark.parametrize(
    "doubles",
    [[-1.0, 0, 0, 0], [1e6, 0, 0, 0], [1.0, 99, 0, 0], [float("nan"), 0, 0, 0]],
)
def test_a_payload_that_cannot_be_is_a_runtime_error(doubles):
    client = Client()
    assert client.call(SET_PAYLOAD, doubles) is None
    assert len(client.errors) == 1
    assert client.machine.body.declared.mass == 0.0


def test_an_inertia_that_no_body_has_is_a_runtime_error():
    client = Client("ur5e")
    assert client.call(TARGET_PAYLOAD, [1.0, 0, 0, 0, 1.0, 0.1, 0.1, 0, 0, 0]) is None
    assert len(client.errors) == 1


def test_a_pose_out_of_reach_ends_the_program():
    client = Client()
    assert client.call(46, [3.0, 0, 0, 0, 0, 0]) is None
    assert "inverse kinematics" in client.errors[0]
    assert not client.playing


def test_a_move_out_of_reach_ends_the_program():
    client = Client()
    assert client.call(MOVEL, [3.0, 0, 0, 0, 0, 0, 0.2, 1.0]) is None
    assert not client.playing


def test_a_move_beyond_the_joint_limits_is_a_protective_stop():
    client = Client()
    client.write(MOVEJ, [9.0, 0, 0, 0, 0, 0, 1.0, 1.0], 0)
    client.pass_ticks(3)
    assert not client.machine.modes.running


def test_kinematics_answers():
    client = Client()
    client.go()
    machine = client.machine
    tool = np.array([0.01, 0.02, 0.1, 0.1, 0.2, 0.3])
    client.call(29, tool)
    np.testing.assert_allclose(machine.tcp, tool)
    client.call(40)
    np.testing.assert_allclose(client.out(), tool)
    pose = pose_of(machine.body.arm, HOME, tool)
    client.call(46, pose)
    np.testing.assert_allclose(client.out(), HOME, atol=1e-6)
    client.call(44, [*HOME, *np.zeros(6)])
    np.testing.assert_allclose(client.out(), pose_of(machine.body.arm, HOME, np.zeros(6)))
    client.call(43)
    np.testing.assert_allclose(client.out()[:3], pose[:3], atol=2e-3)
    client.call(39, [*pose, *tool])
    np.testing.assert_allclose(client.out(), pose_trans(pose, tool))


@pytest.mark.parametrize(("command", "near"), [(60, False), (61, True)])
def test_whether_a_pose_can_be_reached(command, near):
    client = Client()
    client.go()
    more = [*HOME, 1e-6, 1e-6] if near else []
    client.call(command, [*pose_of(client.machine.body.arm, HOME, np.zeros(6)), *more])
    assert client.out_int(1) == 1
    client.call(command, [5, 5, 5, 0, 0, 0, *more])
    assert client.out_int(1) == 0
    assert client.playing


def test_safety_limits():
    client = Client()
    client.call(37, HOME)
    assert client.out_int(1) == 1
    client.call(37, [7.0, 0, 0, 0, 0, 0])
    assert client.out_int(1) == 0
    client.call(36, [0.4, 0.1, 9.0, 0, 3.1, 0])
    assert client.out_int(1) == 0


def test_is_steady_tells_a_moving_arm_from_one_at_rest():
    client = Client()
    client.go()
    client.pass_ticks(60)
    client.call(47)
    assert client.out_int(1) == 1
    client.stream(SPEEDJ, [0.3, 0, 0, 0, 0, 0, 2.0, 0.0], 30)
    client.write(0)
    client.machine.tick()
    client.call(47)
    assert client.out_int(1) == 0


def test_torques_on_the_joints_are_those_of_a_push():
    client = Client()
    client.go()
    push = np.array([12.0, -9.0, 6.0, 3.0, 2.0, 1.0])
    client.stream(38, [], 125)
    before = client.out()
    client.machine.body.push(push)
    client.pass_ticks(250)
    gains = client.machine.body.arm.drive_gains
    assert np.abs(before).max() < 25
    np.testing.assert_allclose(client.out() - before, -push, atol=0.05 * gains.max() + 0.3)


@pytest.mark.thorough
@pytest.mark.parametrize("command", [25, 26, 27, 28, 54, 67, 68, 69, 70, 71])
def test_what_the_script_for_cb3_lacks_leaves_the_registers_alone(command):
    client = Client("ur5")
    client.call(37, HOME)
    client.call(40)
    client.machine.outputs["output_double_register_0"] = 0.123
    client.write(command, np.zeros(18), 0)
    client.pass_ticks(3)
    assert client.out_int(1) == 1
    assert client.out(1)[0] == 0.123
    assert client.playing


def test_step_time_and_history_on_e_series():
    client = Client("ur5e")
    client.stream(26, [], 2)
    assert client.out(1)[0] == pytest.approx(0.002)
    client.write(0)
    client.machine.tick()
    client.stream(SPEEDJ, [0.5, 0, 0, 0, 0, 0, 5.0, 0.0], 200)
    client.write(27, flag=100)
    client.machine.tick()
    moved = client.machine.reading.q[0] - client.out(1)[0]
    assert moved == pytest.approx(0.5 * 0.2, abs=0.01)


def test_matrices_come_column_by_column_in_two_ranges():
    client = Client("ur5e", version=(5, 23, 0, 0))
    client.go()
    machine = client.machine
    client.stream(70, [], 2)
    outputs = machine.outputs
    numbers = [outputs[f"output_double_register_{i}"] for i in (*range(24), *range(36, 48))]
    expected = jacobian(machine.body.arm, machine.reading.q, machine.tcp)
    np.testing.assert_allclose(np.reshape(numbers, (6, 6)).T, expected, atol=1e-3)
    client.stream(67, [], 2)
    numbers = [outputs[f"output_double_register_{i}"] for i in (*range(24), *range(36, 48))]
    mass = np.reshape(numbers, (6, 6))
    np.testing.assert_allclose(mass, mass.T, atol=1e-9)
    assert (np.linalg.eigvalsh(mass) > 0).all()


def test_the_jacobians_rate_times_the_speed_is_the_tools_acceleration():
    client = Client("ur5e", version=(5, 23, 0, 0))
    client.go()
    speed = np.array([0.2, -0.1, 0.3, 0.1, 0.2, -0.2])
    client.stream(SPEEDJ, [*speed, 5.0, 0.0], 200)
    client.stream(71, [], 1)
    outputs, machine = client.machine.outputs, client.machine
    numbers = [outputs[f"output_double_register_{i}"] for i in (*range(24), *range(36, 48))]
    rate = np.reshape(numbers, (6, 6)).T
    arm, q, h = machine.body.arm, machine.reading.q, 1e-4
    twist = [jacobian(arm, q + s * h * speed, machine.tcp) @ speed for s in (1, -1)]
    np.testing.assert_allclose(rate @ speed, (twist[0] - twist[1]) / (2 * h), atol=0.02)


def test_the_upper_range_of_registers():
    client = Client("ur5e", offset=24)
    assert client.state == READY
    client.go()
    assert client.machine.outputs["output_int_register_0"] == 0
    client.call(WATCHDOG, [10.0])
    assert client.machine.watchdog.variable == "input_int_register_24"


def test_hand_guiding_keeps_the_arm_from_moving_itself():
    client = Client()
    client.call(18)
    client.call(19)
    assert client.call(MOVEJ, [*HOME, 3.0, 20.0]) is not None
    client.call(18)
    assert client.call(MOVEJ, [*client.q, 3.0, 20.0]) is None
    assert "by hand" in client.errors[0]


def test_force_mode_is_accepted_beside_a_move():
    client = Client()
    client.stream(6, np.zeros(18), 3)
    assert client.state == READY
    client.write(0)
    client.machine.tick()
    assert client.call(MOVEJ, [*HOME, 3.0, 20.0]) is not None
    assert client.call(7) is not None


def push_down(client, newtons):
    machine = client.machine
    columns = jacobian(machine.body.arm, machine.reading.q, machine.tcp)
    machine.body.push(columns.T @ np.array([0, 0, newtons, 0, 0, 0.0]))


def test_moving_until_contact_stops_and_goes_back_to_where_it_was():
    client = Client("ur5e")
    client.go()
    client.write(51, [0, 0, -0.05, 0, 0, 0, 0, 0, -1, 0, 0, 0, 0.5], 0)
    client.pass_ticks(300)
    height = pose_of(client.machine.body.arm, client.q, client.machine.tcp)[2]
    push_down(client, 30.0)
    for _ in range(2000):
        client.machine.tick()
        if client.state == DONE:
            break
    assert client.state == DONE
    found = pose_of(client.machine.body.arm, client.q, client.machine.tcp)[2]
    assert found == pytest.approx(height, abs=2e-3)


@pytest.mark.thorough
def test_a_contact_that_is_watched_for_ends_the_move():
    client = Client("ur5e")
    client.go()
    target = beside(0.8, 0, 0, 0, 0, 0)
    client.call(62, [0, 0, -1.0, 0, 0, 0])
    client.call(MOVEJ, [*target, 0.3, 1.0], 1)
    client.call(64)
    assert client.out_int(1) == 0
    client.pass_ticks(200)
    push_down(client, 30.0)
    client.pass_ticks(1500)
    assert client.q[0] < target[0] - 0.3
    assert not client.qd.any()
    client.call(63)
    assert client.out_int(1) != 0


@pytest.mark.thorough
@pytest.mark.parametrize("arm", ["ur5", "ur5e"])
@pytest.mark.parametrize("scale", [1e-300, 1.0, 1e3, 1e30, 1e307])
def test_no_command_crashes_whatever_its_registers_hold(arm, scale):
    client = Client(arm, version=(5, 26, 0, 0) if arm == "ur5e" else None)
    rng = np.random.default_rng(1)
    for command in (*HANDLERS, 5, 100, -1, 2**31 - 1):
        if not client.machine.modes.running:
            client = Client(arm)
        client.start(PATH)
        for i in range(2, 8):
            client.machine.write(f"input_int_register_{i}", int(rng.integers(-(2**31), 2**31)))
        client.write(
            command, scale * rng.uniform(-9, 9, 18), int(rng.choice([-1, 0, 1, 2**31 - 1]))
        )
        client.pass_ticks(4)
        assert np.isfinite(client.machine.setpoint).all(), command
        assert np.isfinite(client.out()).all(), command
