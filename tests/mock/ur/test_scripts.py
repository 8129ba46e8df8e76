"""Uploaded programs: what they say and do, their functions, and that no text does harm."""

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hil.core.errors import CommandRefused
from hil_mock_robot.ur.client_interfaces import LARGEST_TEXT, MOST_LINES, ScriptInbox
from hil_mock_robot.ur.control_script import ControlScript
from hil_mock_robot.ur.modes import RobotMode, RuntimeState
from hil_mock_robot.ur.program import pose_at
from hil_mock_robot.ur.script_values import LONGEST_SHOWN, MOST_ELEMENTS
from hil_mock_robot.ur.scripts import play, program_of
from tests.support.fuzzing import examples
from tests.support.ur_control_parts import HOME, beside
from tests.support.ur_machine import machine_of, pass_time


class Station:
    """A controller, one connection to it, and what it told."""

    def __init__(self, arm="ur5", powered=True):
        self.machine = machine_of(arm, powered)
        self.inbox = ScriptInbox(self.machine)
        self.events = []
        self.machine.listeners.append(self.events.append)

    def send(self, text):
        self.inbox.feed(text.encode())

    def run(self, text, seconds=20.0):
        """Send a program and wait until it is over; returns how long it took [s]."""
        self.send(text)
        start = self.machine.now_s
        while self.machine.runtime is RuntimeState.PLAYING:
            self.machine.tick()
            assert self.machine.now_s < start + seconds, "it never ends"
        return self.machine.now_s - start

    def told(self, kind):
        return [event.text for event in self.events if event.kind == kind]

    @property
    def q(self):
        return self.machine.setpoint[0]


def program(*lines, name="work"):
    return "".join([f"def {name}():\n", *(f"  {line}\n" for line in lines), "end\n"])


@pytest.fixture
def station():
    return Station()


def bracketed(values):
    return "[" + ",".join(f"{value:.6g}" for value in values) + "]"


def test_a_single_line_is_a_program(station):
    station.run(f"movej({bracketed(HOME)}, a=5, v=2)\n")
    np.testing.assert_allclose(station.q, HOME, atol=1e-6)
    assert station.told("error") == []


def test_a_program_of_python_urx(station):
    """`movels`: unindented lines, an `end` at the very left."""
    station.run(f"movej({bracketed(HOME)}, a=5, v=2, r=0)\n")
    moves = (
        "movel(p[-0.5,-0.22,0.4,2.04,2.25,0.02], a=1.0, v=0.2, r=0.01)",
        "movel(p[-0.45,-0.22,0.4,2.04,2.25,0.02], a=1.0, v=0.2, r=0)",
    )
    station.run("\n".join(("def myProg():", *moves, "end\n")))
    assert station.told("error") == []
    station.send("def ask():\n textmsg(get_target_tcp_pose())\nend\n")
    station.machine.tick()
    shown = [float(each) for each in station.told("text")[0][2:-1].split(", ")]
    assert shown == pytest.approx([-0.45, -0.22, 0.4, 2.04, 2.25, 0.02], abs=1e-4)


def test_moves_with_a_radius_are_blended(station):
    station.run(f"movej({bracketed(HOME)}, a=5, v=2)\n")
    first, second = beside(0.5, 0, 0, 0, 0, 0), beside(0.5, 0.3, 0, 0, 0, 0)
    lines = "movej({}, a=2, v=1{})", "movej({}, a=2, v=1)"

    def seconds(radius):
        took = station.run(
            program(lines[0].format(bracketed(first), radius), lines[1].format(bracketed(second)))
        )
        np.testing.assert_allclose(station.q, second, atol=1e-5)
        station.run(f"movej({bracketed(HOME)}, a=5, v=2)\n")
        return took

    assert seconds(", r=0.1") < seconds("") - 0.1


def test_registers_and_outputs(station):
    station.run(
        program(
            "write_output_integer_register(0 +0, 7)",
            "write_output_float_register(3, -1.5 / 2)",
            "write_output_boolean_register(33, True)",
            "set_digital_out(2, True)",
            "set_tool_digital_out(1, True)",
            "digital_out[3] = True",
            "set_standard_digital_out(2, False)",
        )
    )
    outputs = station.machine.outputs
    assert outputs["output_int_register_0"] == 7
    assert outputs["output_double_register_3"] == -0.75
    assert outputs["output_bit_registers32_to_63"] == 2
    assert outputs["actual_digital_output_bits"] == 1 << 3 | 1 << 17
    assert station.told("error") == []


def test_settings(station):
    station.run(
        program(
            "set_payload(1.5, [0.01, 0.02, 0.03])",
            "set_tcp(p[0, 0, 0.1, 0, 0, 0])",
            'rtde_set_watchdog("input_int_register_0", 10, "stop")',
            "sync()",
        )
    )
    machine = station.machine
    assert machine.body.declared.mass == 1.5
    assert machine.body.declared.com == (0.01, 0.02, 0.03)
    assert machine.tcp[2] == 0.1
    assert machine.watchdog is None  # it ended with its program


def test_variables_conditions_loops_and_functions(station):
    station.run(
        program(
            "global total = 0",
            "def add(x, y):",
            "  if x > 2 and not (y == 0):",
            "    return x + y",
            "  elif x == 1:",
            "    return 100",
            "  else:",
            "    return 0",
            "  end",
            "end",
            "i = 0",
            "while True:",
            "  i = i + 1",
            "  if i == 2:",
            "    continue",
            "  end",
            "  if i > 4:",
            "    break",
            "  end",
            "  total = total + add(i, y=1)",
            "end",
            "list = [1, 2, 3]",
            "copy = list",
            "copy[1] = 20",
            'textmsg(total, str_cat(" ", to_str(list[1])))  # a comment',
        )
    )
    assert station.told("error") == []
    assert station.told("text") == ["109 2"]  # 100 + 4 + 5


def test_a_program_takes_the_time_it_says(station):
    took = station.run(
        program("sleep(0.4)", "i = 0", "while i < 25:", " sync()", " i = i + 1", "end")
    )
    assert took == pytest.approx(0.6, abs=0.03)


def test_halt_ends_a_program(station):
    station.run(program("halt", "write_output_integer_register(0, 7)"))
    assert station.machine.outputs["output_int_register_0"] == 0


def test_servoj_and_speedj_in_a_program(station):
    station.run(f"movej({bracketed(HOME)}, a=5, v=2)\n")
    station.run(
        program(
            f"q = {bracketed(HOME)}",
            "i = 0",
            "while i < 100:",
            " q[0] = q[0] + 0.002",
            " servoj(q, t=0.008, lookahead_time=0.05, gain=500)",
            " i = i + 1",
            "end",
            "stopj(10)",
        )
    )
    assert station.q[0] == pytest.approx(HOME[0] + 0.2, abs=0.02)
    before = station.q[0]
    station.run("speedj([0.2,0,0,0,0,0], a=2, t_min=0.5)\n")
    # It speeds up for 0.1 s and goes on at 0.2 rad/s.
    assert station.q[0] - before == pytest.approx(0.09, abs=0.01)
    assert station.told("error") == []


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (["sync()", "fly_away()"], "line 3: there is no function 'fly_away'"),
        (["x = nothing + 1"], "line 2: there is no variable 'nothing'"),
        (["if 1:", " sync()", "end"], "line 2: True or False is needed"),
        (["movej([1,2,3], a=1, v=1)"], "line 2: six numbers are needed"),
        (["movej(1, 2, 3, 4, 5, 6, 7, 8)"], "movej takes"),
        (["x = [1,2][5]"], "whole number from 0 to 1"),
        (["x = 1 / 0"], "division"),
        (["x = 9 ** 9"], "unknown operator Pow"),
        (["x = (lambda: 1)()"], "there is no function"),
        (["x = ().__class__"], "does not support this URScript"),
        (['__import__("os")'], "there is no function"),
        (["while True:"], "no end"),
        (["movej(, a=1)"], "line 2: syntax error"),
        (["set_payload(-3)"], "out of range"),
        (["x = " + "-" * 500 + "1"], "nested too deeply"),
        (["x = " + "1+" * 500 + "1"], "nested too deeply"),
        (["def f():", " f()", "end", "f()"], "too deeply"),
        (["write_output_integer_register(99, 1)"], "whole number"),
        (["movec(1, 2)"], "six numbers are needed"),
        (["servoc(1, 2)"], "does not support this motion"),
        (["x = sqrt(-1)"], "line 2: sqrt(-1)"),
        (["x = pow(-8, 0.5)"], "line 2: pow(-8, 0.5)"),
        (["x = 1 xor 2"], "line 2: True or False is needed"),
        (["socket_open(1)"], "line 2: there is no function 'socket_open'"),
    ],
)
def test_what_cannot_be_ends_the_program_with_its_line(station, lines, said):
    station.run(program(*lines))
    (text,) = station.told("error")
    assert said in text


def test_a_program_that_never_waits_lets_time_pass(station):
    station.send(program("i = 0", "while True:", " i = i + 1", "end"))
    for _ in range(20):
        station.machine.tick()
    assert station.machine.runtime is RuntimeState.PLAYING


def test_a_new_program_stops_the_one_that_plays(station):
    station.send(program("sleep(100)", name="first"))
    station.machine.tick()
    station.send(program("sleep(100)", name="second"))
    kinds = [(event.kind, event.name) for event in station.events]
    assert kinds == [
        ("program_started", "first"),
        ("program_stopped", "first"),
        ("program_started", "second"),
    ]


def test_a_secondary_program_runs_beside_the_one_that_plays(station):
    station.send(program("sleep(100)", name="first"))
    station.machine.tick()
    station.send("sec beside():\n set_digital_out(1, True)\nend\n")
    assert station.machine.outputs["actual_digital_output_bits"] == 2
    assert station.machine.program.name == "first"


@pytest.mark.parametrize(
    "line", ["sleep(1)", "movej([0,0,0,0,0,0])", "stopj(1)", "while True:\n end"]
)
def test_a_secondary_program_cannot_take_time(station, line):
    station.send(program("sleep(100)", name="first"))
    before = station.machine.setpoint.copy()
    station.send(f"sec beside():\n {line}\nend\n")
    assert len(station.told("error")) == 1
    station.machine.tick()
    assert station.machine.program.name == "first"
    np.testing.assert_array_equal(station.machine.setpoint, before)


@pytest.mark.parametrize("size", [1, 3, 7, 1000])
def test_programs_may_come_in_pieces_and_several_at_once(station, size):
    text = program("if True:", "  sync()", "end", name="a").replace("\n", "\r\n")
    data = (text + "\n\n" + program("sleep(1)", name="b") + "textmsg(1)\n").encode()
    for at in range(0, len(data), size):
        station.inbox.feed(data[at : at + size])
    started = [event.name for event in station.events if event.kind == "program_started"]
    assert started == ["a", "b", "unnamed"]


def test_an_end_at_the_very_left_ends_an_indented_program(station):
    station.send("def odd():\n  if True:\n  sync()\nend\n")
    station.machine.tick()
    assert "no end" in station.told("error")[0]


def test_a_program_without_end_is_not_kept_for_ever(station):
    station.send("def big():\n")
    line = "  textmsg(1)\n" * 1000
    for _ in range(LARGEST_TEXT // len(line) + 2):
        station.send(line)
    assert len(station.told("error")) == 1
    station.send("end\nset_digital_out(1, True)\n")
    station.machine.tick()
    assert station.machine.outputs["actual_digital_output_bits"] == 0


def test_a_program_of_too_many_lines_is_not_read(station):
    station.send(program(*["x = 1"] * (MOST_LINES + 1)))
    assert station.told("error") == [
        f"a program is longer than {LARGEST_TEXT} bytes or {MOST_LINES} lines"
    ]
    assert station.machine.runtime is RuntimeState.STOPPED


def test_lists_in_lists_in_lists_are_refused_before_they_fill_the_memory(station):
    """Seven such lines would be two million elements."""
    lines = ["a = [1, 2, 3, 4, 5, 6, 7, 8]", *["a = [a, a, a, a, a, a, a, a]"] * 7, "textmsg(a)"]
    station.run(program(*lines))
    assert station.told("error") == ["line 4: lists are nested too deeply"]


@pytest.mark.parametrize(
    "lines",
    [
        ["v = [0]", "m = [v]", "v[0] = m"],
        ["v = [0]", "v[0] = [1]", "v[0] = [v]"],
        ["def f(x):", " x[0] = [x]", "end", "f([[1]])"],
    ],
)
def test_no_assignment_makes_lists_deeper(station, lines):
    station.run(program(*lines))
    assert "lists are nested too deeply" in station.told("error")[0]


def test_lists_are_passed_on_by_value(station):
    station.run(
        program(
            "def f(x):",
            "  x[0] = 9",
            "  return x",
            "end",
            "v = [1]",
            "m = [v, v]",
            "w = f(v)",
            "v[0] = 7",
            "textmsg(to_str(m), to_str(v), to_str(w))",
        )
    )
    assert station.told("text") == ["[[1], [1]][7][9]"]


def test_a_list_of_too_many_elements_is_refused(station):
    lines = ["a = [" + "1," * 1500 + "1]", "b = [a, a]"]
    station.run(program(*lines))
    assert f"more than {MOST_ELEMENTS} elements" in station.told("error")[0]


def test_what_is_shown_of_a_list_has_an_end(station):
    text = '"' + "x" * 190 + '"'
    station.run(program(f"a = [{', '.join([text] * 12)}]", "b = [a, a, a]", "textmsg(b)"))
    assert len(station.told("text")[0]) <= LONGEST_SHOWN + 2


@pytest.mark.thorough
def test_long_lists_take_time_of_the_program_not_of_the_controller(station):
    """Steps without waiting cost a tick; going through a list counts as many."""
    add = "+".join(["a"] * 20)
    station.run(program("a = [" + "1," * 1900 + "1]", "i = 0", "while i < 8:",
                        f" b = {add}", " i = i + 1", "end"))  # fmt: skip
    # 8 × 20 additions of 1901 elements, ten of which are a step, 2000 steps to a tick
    assert station.machine.ticks >= 8 * 19 * 190 // 2000


@pytest.mark.parametrize(("arm", "plays"), [("ur5", True), ("ur5e", False)])
def test_local_control_ignores_programs_on_e_series(arm, plays):
    station = Station(arm)
    station.machine.modes.remote = False
    station.send(program("sleep(1)"))
    assert (station.machine.runtime is RuntimeState.PLAYING) is plays
    assert plays or station.events == []


def test_a_controller_that_does_not_run_refuses_programs(station):
    station.machine.emergency_stop()
    station.send(program("sleep(1)"))
    assert station.machine.runtime is RuntimeState.STOPPED


def comes_to(station, mode, seconds=3.0):
    """Let device time pass until the robot is in a mode, and a bit more, in which it stays."""
    for _ in range(round(seconds / station.machine.tick_s)):
        if station.machine.modes.robot is mode:
            break
        station.machine.tick()
    for _ in range(20):
        station.machine.tick()
    return station.machine.modes.robot is mode


@pytest.mark.thorough
@pytest.mark.parametrize("arm", ["ur5", "ur5e"])
@pytest.mark.parametrize("powered", [True, False])
def test_power_lines_are_obeyed_and_are_no_programs(arm, powered):
    """The dialogue of UR's client library in its test of power cycles."""
    station = Station(arm, powered)
    for line, mode in (
        ("set robotmode run", RobotMode.RUNNING),
        ("set robotmode run", RobotMode.RUNNING),
        ("power off", RobotMode.POWER_OFF),
        ("power on", RobotMode.IDLE),
        ("set robotmode run", RobotMode.RUNNING),
        ("power off", RobotMode.POWER_OFF),
        ("set robotmode run", RobotMode.RUNNING),
    ):
        station.send(line + "\n")
        assert comes_to(station, mode)
    assert station.events == []


@pytest.mark.thorough
@pytest.mark.parametrize(
    "line",
    ["set robotmode run", "set robotmode freedrive", "set sim", "set real", "power on",
     "set unlock protective stop", "  set   sim  # urx"],
)  # fmt: skip
def test_lines_that_are_no_program_leave_the_one_that_plays_alone(station, line):
    station.send(program("sleep(100)", name="first"))
    station.events.clear()
    station.send(line + "\n")
    station.machine.tick()
    assert station.machine.program.name == "first"
    assert station.events == []


def test_stop_pause_and_resume_program(station):
    station.send(program("sleep(100)", name="first"))
    for line, state in (
        ("pause program", RuntimeState.PAUSED),
        ("resume program", RuntimeState.PLAYING),
        ("stop program", RuntimeState.STOPPED),
        ("stop program", RuntimeState.STOPPED),
    ):
        station.send(line + "\n")
        assert station.machine.runtime is state
    assert [event.kind for event in station.events] == ["program_started", "program_stopped"]


def test_a_protective_stop_is_unlocked_by_a_line_after_five_seconds(station):
    station.send("protective_stop()\n")
    station.machine.tick()
    station.send("set unlock protective stop\n")
    assert not station.machine.modes.running
    pass_time(station.machine, 5.1)
    station.send("set unlock protective stop\n")
    assert station.machine.modes.running


def test_the_speed_slider_has_a_line_of_its_own(station):
    station.send("set speed 0.80\n")
    assert station.machine.speed_fraction == 0.8
    station.send("set speed 7\nset speed nan\n")
    assert station.machine.speed_fraction == 1.0
    assert station.events == []


@pytest.mark.thorough
def test_local_control_ignores_these_lines_too():
    station = Station("ur5e")
    station.machine.modes.remote = False
    station.send("power off\n")
    pass_time(station.machine, 1.0)
    assert station.machine.modes.robot is RobotMode.RUNNING


def test_such_a_line_inside_a_program_is_a_statement_of_it(station):
    station.run(program("power off"))
    pass_time(station.machine, 1.0)
    assert station.machine.modes.robot is RobotMode.RUNNING
    assert len(station.told("error")) == 1


CONTROL = """def rtde_control():
    global reg_offset_float = # float register offset
{offset}    global reg_offset_int = # int register offset
{offset}    global x = 0
    def exec_move_path():
        textmsg("exec_move_path")
        # inject move path
{path}    end
    while keep_running:
        $ no URScript at all
    end
end
"""
INJECTED = (
    "\tsignal_async_progress(0)\n\tmovej([0.1,-1.5,0.5,-1.5,0,0],a=1.4,v=1,r=0.1)\n"
    "\tsignal_async_progress(1)\n\tmovel(p[-0.5,-0.22,0.4,2.04,2.25,1e-05],a=1.2,v=0.25,r=0)\n"
)


@pytest.mark.parametrize("offset", [0, 24])
def test_the_control_script_is_known_by_its_registers(offset):
    machine = machine_of("ur5e")
    found = program_of(CONTROL.format(offset=offset, path=""), machine)
    assert isinstance(found, ControlScript)
    assert machine.play(found)
    machine.tick()
    assert machine.outputs[f"output_int_register_{offset}"] == 1


def test_the_injected_path_is_read(station):
    found = program_of(CONTROL.format(offset=0, path=INJECTED), station.machine)
    (marks, first), (_, second) = found.path
    assert marks == (0,)
    assert (first.kind, first.v, first.a, first.radius, first.is_pose) == ("j", 1, 1.4, 0.1, False)
    assert (second.kind, second.is_pose) == ("l", True)
    assert second.target[5] == 1e-5


@pytest.mark.thorough
@pytest.mark.parametrize(
    "path",
    [
        "\tfly()\n",
        "\tmovej(1)\n",
        "\tmovej([x,0,0,0,0,0])\n",
        "\t)(\n",
        "\tsignal_async_progress([])\n",
    ],
)
def test_an_injected_path_that_cannot_be_is_a_runtime_error(station, path):
    play(CONTROL.format(offset=0, path=path), station.machine)
    assert len(station.told("error")) == 1
    assert station.machine.program is None


WORDS = [
    *("def f():", "sec f():", "if True:", "while x < 3:", "elif True:", "else:", "end", "return 1"),
    *("movej([0,0,0,0,0,0], a=1, v=1)", "x = x + 1", "x = [1,[2]]", "x[0] = x", "sync()", "p[1,2]"),
    *(
        "stopl(1)",
        "halt",
        "break",
        "speedl([0,0,0.1,0,0,0], 1, 0.01)",
        "f()",
        "x = f()",
        "set_tcp(x)",
    ),
    *("servoj([0,0,0,0,0,0], 0, 0, 0.008)", "x = get_inverse_kin(p[9,9,9,9,9,9])", "x = 1e308*10"),
    *("# inject move path", "def rtde_control():", "0    # int register offset\n0", "x = sqrt(-1)"),
]
ONE = machine_of("ur5e")


@pytest.mark.thorough
@examples(200)
@given(
    st.one_of(
        st.text(max_size=200),
        st.lists(st.sampled_from(WORDS), max_size=25).map("\n".join),
        st.lists(st.sampled_from(WORDS), max_size=25).map(
            lambda lines: "def f():\n " + "\n ".join(lines) + "\nend"
        ),
    )
)
def test_no_text_crashes_the_controller(text):
    global ONE
    if not ONE.modes.running:
        ONE = machine_of("ur5e")
    with contextlib.suppress(CommandRefused):
        program_of(text, ONE)
    ScriptInbox(ONE).feed((text + "\n").encode("utf-8", "replace"))
    for _ in range(5):
        ONE.tick()
    assert np.isfinite(ONE.setpoint).all()


@examples(50)
@given(st.binary(max_size=300))
def test_no_bytes_crash_the_inbox(data):
    ScriptInbox(ONE).feed(data + b"\n")


@pytest.mark.thorough
@pytest.mark.parametrize("arm", ["ur5", "ur5e"])
def test_a_program_answers_inputs_by_outputs_tick_by_tick(arm):
    """`rtde_roundtrip` of UR's client library: bit inverted, integer plus one, double negated."""
    station = Station(arm)
    lines = (
        "while (True):",
        "  write_output_boolean_register(64, not read_input_boolean_register(64))",
        "  write_output_integer_register(24, read_input_integer_register(24) + 1)",
        "  write_output_float_register(24, -1.0 * read_input_float_register(24))",
        "  sync()",
        "end",
    )
    station.send(program(*lines, name="rtde_register_mirror"))
    inputs, outputs = station.machine.inputs, station.machine.outputs
    for count in range(1, 200):
        value = float(np.sin(count * 0.01))
        inputs["input_bit_register_64"] = count % 2 == 0
        inputs["input_int_register_24"], inputs["input_double_register_24"] = count, value
        station.machine.tick()
        assert bool(outputs["output_bit_register_64"]) is (count % 2 == 1)
        assert outputs["output_int_register_24"] == count + 1
        assert outputs["output_double_register_24"] == -value
    station.send("stop program\n")
    assert station.machine.runtime is RuntimeState.STOPPED


# Functions that uploaded programs call, against numpy, scipy's rotations and the manual.


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
