"""Functions that uploaded programs call, against numpy, scipy's rotations and the manual."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hil_mock_robot.ur.program import pose_at
from tests.mock.ur.test_scripts import Station, bracketed, program
from tests.support.ur_control_parts import HOME

A, B = [0.4, -0.2, 0.4, -1.1, 0.8, -0.3], [-0.01, -0.5, 0.002, -0.5, 1.5, -0.3]


@pytest.fixture(scope="module")
def at_home():
    station = Station("ur5e")
    station.run(f"movej({bracketed(HOME)}, a=5, v=2)\n")
    return station


def asked(station, expression, *before):
    """What an expression is, read off a register or, for lists, element by element."""
    station.events.clear()
    lines = [f"x = {expression}", "write_output_float_register(0, x)"]
    station.run(program(*before, *lines))
    assert station.told("error") == []
    return station.machine.outputs["output_double_register_0"]


def numbers(station, expression, count=6):
    station.events.clear()
    writes = [f"write_output_float_register({i}, x[{i}])" for i in range(count)]
    station.run(program(f"x = {expression}", *writes))
    assert station.told("error") == []
    return np.array([station.machine.outputs[f"output_double_register_{i}"] for i in range(count)])


def truth(station, expression):
    station.events.clear()
    lines = [f"write_output_boolean_register(1, {expression})"]
    station.run(program(*lines))
    assert station.told("error") == []
    return bool(station.machine.outputs["output_bit_registers0_to_31"] & 2)


def turn(pose):
    return Rotation.from_rotvec(pose[3:])


def pose(values):
    return "p" + bracketed(values)


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("atan2(1, -1)", np.arctan2(1, -1)),
        ("pow(2, 10)", 1024),
        ("log(10, 1000)", 3),
        ("length([1, 2, 3])", 3),
        ('length("four")', 4),
        ("get_list_length([])", 0),
        ('str_len("four")', 4),
        (f"point_dist({pose(A)}, {pose(B)})", np.linalg.norm(np.subtract(A, B)[:3])),
        (
            f"pose_dist({pose(A)}, {pose(B)})",
            np.hypot(np.linalg.norm(np.subtract(A, B)[:3]), (turn(A).inv() * turn(B)).magnitude()),
        ),
    ],
)
def test_numbers(at_home, expression, expected):
    assert asked(at_home, expression) == pytest.approx(expected, rel=1e-5)


def test_random_numbers_are_numbers_from_0_to_1_and_the_same_in_every_run(at_home):
    first, again = (asked(at_home, "random()") for _ in range(2))
    assert first == again
    assert 0 <= first < 1


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        (f"pose_add({pose(A)}, {pose(B)})", [*np.add(A, B)[:3], *(turn(A) * turn(B)).as_rotvec()]),
        (
            f"pose_sub({pose(A)}, {pose(B)})",
            [*np.subtract(A, B)[:3], *(turn(B).inv() * turn(A)).as_rotvec()],
        ),
        (
            f"interpolate_pose({pose(A)}, {pose(B)}, 0.3)",
            [
                *(0.7 * np.array(A) + 0.3 * np.array(B))[:3],
                *(turn(A) * (turn(A).inv() * turn(B)) ** 0.3).as_rotvec(),
            ],
        ),
        # the manual's own examples
        ("pose_add(p[.2,.5,.1,1.57,0,0], p[.2,.5,.6,1.57,0,0])", [0.4, 1.0, 0.7, 3.14, 0, 0]),
        ("pose_sub(p[.2,.5,.1,1.57,0,0], p[.2,.5,.6,1.57,0,0])", [0, 0, -0.5, 0, 0, 0]),
    ],
)
def test_poses(at_home, expression, expected):
    np.testing.assert_allclose(numbers(at_home, expression), expected, atol=1e-5)


@pytest.mark.parametrize("angles", [[0.3, -0.4, 2.0], [-3.0, 1.5, 0.1], [0, 0, 0]])
def test_roll_pitch_and_yaw_turn_about_fixed_axes(at_home, angles):
    vector = numbers(at_home, f"rpy2rotvec({angles})", 3)
    np.testing.assert_allclose(vector, Rotation.from_euler("xyz", angles).as_rotvec(), atol=1e-6)
    back = numbers(at_home, f"rotvec2rpy(rpy2rotvec({angles}))", 3)
    np.testing.assert_allclose(back, angles, atol=1e-9)


def test_straight_down_has_some_roll_and_yaw(at_home):
    vector = numbers(at_home, "rpy2rotvec([0.4, 1.5707963, 0.1])", 3)
    again = numbers(at_home, "rpy2rotvec(rotvec2rpy(rpy2rotvec([0.4, 1.5707963, 0.1])))", 3)
    np.testing.assert_allclose(again, vector, atol=1e-5)


@pytest.mark.parametrize(
    ("expression", "variable"),
    [
        ("get_actual_tcp_speed()", "actual_TCP_speed"),
        ("get_target_tcp_speed()", "target_TCP_speed"),
        ("get_tcp_force()", "actual_TCP_force"),
        ("get_actual_joint_positions()", "actual_q"),
    ],
)
def test_state_is_that_of_rtde(at_home, expression, variable):
    writes = [f" write_output_float_register({i}, x[{i}])\n" for i in range(6)]
    at_home.send(f"sec f():\n x = {expression}\n{''.join(writes)}end\n")  # within this tick
    outputs = at_home.machine.outputs
    found = [outputs[f"output_double_register_{i}"] for i in range(6)]
    np.testing.assert_allclose(found, outputs[variable], rtol=1e-12)


def test_more_state(at_home):
    outputs = at_home.machine.outputs
    at_home.send("sec f():\n write_output_float_register(0, force())\nend\n")
    force = np.linalg.norm(outputs["actual_TCP_force"][:3])
    assert outputs["output_double_register_0"] == pytest.approx(force)
    warm = pytest.approx(outputs["joint_temperatures"][3], abs=0.2)
    assert asked(at_home, "get_joint_temp(3)") == warm
    assert np.isfinite(numbers(at_home, "get_joint_torques()")).all()
    standing = pose_at(at_home.machine, at_home.machine.reading.q)
    np.testing.assert_allclose(
        numbers(at_home, "get_actual_tool_flange_pose()"), standing, atol=1e-4
    )
    assert asked(at_home, "get_standard_analog_in(0)") == outputs["standard_analog_input0"]
    outputs["standard_analog_output1"] = 4.0
    assert asked(at_home, "get_standard_analog_out(1)") == 4.0


def test_registers_are_read_back(at_home):
    machine = at_home.machine
    lines = ["write_output_integer_register(5, -7)", "write_output_float_register(6, 1.5)",
             "write_output_boolean_register(70, True)"]  # fmt: skip
    at_home.run(program(*lines))
    assert asked(at_home, "read_output_integer_register(5)") == -7
    assert asked(at_home, "read_output_float_register(6)") == 1.5
    assert truth(at_home, "read_output_boolean_register(70)")
    machine.write("input_bit_registers32_to_63", 1 << 3)
    assert truth(at_home, "read_input_boolean_register(35)")
    assert not truth(at_home, "read_input_boolean_register(36)")


@pytest.mark.parametrize(
    ("expression", "holds"),
    [
        ("True xor False", True),
        ("(1 < 2) xor (2 < 3)", False),
        ('str_len("a xor b") == 7', True),
        ("get_inverse_kin_has_solution(get_actual_tcp_pose())", True),
        ("get_inverse_kin_has_solution(p[3, 0, 0, 0, 0, 0])", False),
        ("is_within_safety_limits(p[3, 0, 0, 0, 0, 0])", False),
        ("is_within_safety_limits(get_actual_tcp_pose())", True),
        ("is_within_safety_limits([0, 0, 0, 0, 0, 0])", True),
        ("is_within_safety_limits([9, 0, 0, 0, 0, 0])", False),
    ],
)
def test_conditions(at_home, expression, holds):
    assert truth(at_home, expression) is holds


def test_functions_that_this_software_lacks_are_names_it_does_not_know():
    station = Station("ur5")
    station.run(program("set_target_payload(1, [0, 0, 0])"))
    (event,) = (event for event in station.events if event.kind == "error")
    assert event.place.token == "compile_error_name_not_found:set_target_payload:"


@pytest.mark.thorough
@pytest.mark.parametrize("mode", [0, 1])
def test_movec_keeps_to_the_circle_at_its_speed(mode):
    station = Station("ur5e")
    station.run(f"movej({bracketed(HOME)}, a=5, v=2)\n")
    machine = station.machine
    start = pose_at(machine, machine.setpoint[0])
    # A half circle, 0.05 m in radius, in a horizontal plane.
    centre = np.add(start[:3], [0.0, 0.05, 0.0])
    via, to = start.copy(), start.copy()
    via[:3], to[:3] = np.add(centre, [0.05, 0.0, 0.0]), np.add(centre, [0.0, 0.05, 0.0])
    began = machine.now_s
    station.send(f"movec({pose(via)}, {pose(to)}, a=1.2, v=0.1, mode={mode})\n")
    farthest, seen = 0.0, []
    while machine.program is not None:
        machine.tick()
        place = pose_at(machine, machine.setpoint[0])[:3]
        farthest = max(farthest, abs(np.linalg.norm(place - centre) - 0.05))
        seen.append(place)
    assert station.told("error") == []
    assert farthest < 0.0015 * 0.05 + 1e-6
    assert np.min(np.linalg.norm(np.array(seen) - via[:3], axis=1)) < 0.001
    end = pose_at(machine, machine.setpoint[0])
    np.testing.assert_allclose(end[:3], to[:3], atol=1e-5)
    turned = (turn(start).inv() * turn(end)).magnitude()
    assert turned == pytest.approx(np.pi if mode else 0.0, abs=1e-4)
    # A tool turns with four times as many rad/s as it moves with m/s.
    lasts = np.pi / 0.4 if mode else np.pi * 0.05 / 0.1
    assert machine.now_s - began == pytest.approx(lasts + 0.1 / 1.2, abs=0.15)


@pytest.mark.thorough
def test_movec_on_a_straight_line_is_one():
    station = Station("ur5e")
    station.run(f"movej({bracketed(HOME)}, a=5, v=2)\n")
    start = pose_at(station.machine, station.machine.setpoint[0])
    via, to = start.copy(), start.copy()
    via[1], to[1] = start[1] + 0.02, start[1] + 0.05
    station.run(f"movec({pose(via)}, {pose(to)}, a=1.2, v=0.1)\n")
    assert station.told("error") == []
    np.testing.assert_allclose(pose_at(station.machine, station.q), to, atol=1e-5)
