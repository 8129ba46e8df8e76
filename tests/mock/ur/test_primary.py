"""Primary, secondary and real-time interface of the mock UR controller, decoded independently."""

import struct
from dataclasses import dataclass

import numpy as np
import pytest

from hil_mock_robot.ur.client_interfaces import MOST_PENDING, PrimaryService, RealtimeService
from hil_mock_robot.ur.dashboard import IdleProgram
from hil_mock_robot.ur.modes import RobotMode, SafetyMode
from tests.support.ur_machine import Wire, machine_of, pass_time

# Sub-package → its size. e-Series: as in a state packet of URSim 5.8, 1386 bytes in all.
SIZES_E = {
    **{0: 47, 1: 251, 2: 37, 3: 75, 4: 101, 5: 225, 6: 445},
    **{7: 61, 8: 9, 9: 53, 10: 43, 11: 26, 12: 8},
}
# CB3: 1350 bytes from a UR10 of 3.5.3, and the last byte of the master board, see primary_state.py.
SIZES_CB3 = {0: 47, 1: 251, 2: 37, 3: 75, 4: 101, 5: 225, 6: 445, 7: 61, 8: 8, 9: 53, 10: 43}


@dataclass
class Message:
    """A robot message as the documentation lays it out."""

    time_us: int
    source: int
    kind: int
    body: bytes


def packets_of(data):
    """(type, content) of each packet in a stream; nothing may be left over."""
    found = []
    while data:
        size, kind = struct.unpack_from(">iB", data)
        assert len(data) >= size
        found.append((kind, data[5:size]))
        data = data[size:]
    return found


def parts_of(content):
    """Sub-packages of a robot state by type."""
    found = {}
    while content:
        size, kind = struct.unpack_from(">IB", content)
        found[kind] = content[5:size]
        content = content[size:]
    return found


def messages_of(data):
    return [
        Message(*struct.unpack_from(">Qbb", content), content[10:])
        for kind, content in packets_of(data)
        if kind == 20
    ]


def states_of(data):
    return [parts_of(content) for kind, content in packets_of(data) if kind == 16]


class Client:
    """A service and one client of it."""

    def __init__(self, arm="ur5", port=30001, powered=True):
        self.machine = machine_of(arm, powered)
        self.service = PrimaryService(self.machine, port)
        self.wire = Wire()
        self.session = self.service.accept(self.wire)

    def after(self, seconds):
        """What is sent in so much device time."""
        self.wire.take()
        pass_time(self.machine, seconds, [self.session])
        return self.wire.take()

    @property
    def state(self):
        return states_of(self.after(0.2))[-1]


@pytest.mark.parametrize("port", [30001, 30002])
@pytest.mark.parametrize(("arm", "version"), [("ur5", (3, 15, 8, 0)), ("ur5e", (5, 12, 2, 0))])
def test_the_first_thing_told_is_the_version(arm, version, port):
    (first, *_) = messages_of(Client(arm, port).wire.take())
    assert (first.kind, first.time_us) == (3, 2**64 - 1)
    length = first.body[0]
    assert first.body[1 : 1 + length] == b"URControl"
    assert struct.unpack_from(">BBii", first.body, 1 + length) == version
    date = first.body[1 + length + 10 :].decode()
    assert date == {"ur5": "17-04-2022, 00:00:00", "ur5e": "02-12-2022, 00:00:00"}[arm]


@pytest.mark.parametrize("arm", ["ur5", "ur5e"])
def test_a_connection_begins_with_the_79_bytes_of_ursim(arm):
    """URSim 5.13 tells a client of 30002 these; a UR10 of 3.5.3 and a UR5e of 5.0.5 79 bytes."""
    told = Client(arm, 30002).wire.take()
    assert told[:24] == b"\0\0\x007\x14" + b"\xff" * 8 + b"\xfe\x03\tURControl"[:11]
    assert told[55:79] == b"\0\0\0\x18\x14" + b"\xff" * 8 + b"\xfe\x0c" + bytes(8) + b"\x01"
    assert told[83] == 16


def test_no_client_that_searches_for_a_state_finds_one_in_what_it_is_told_first():
    """python-urx drops bytes until five look like the head of a state of at most 2000 bytes."""
    client = Client()
    client.wire.take()
    pass_time(client.machine, 2.56, [client.session])
    late = Wire()
    client.service.accept(late)
    told = late.take()
    heads = (struct.unpack_from(">iB", told, at) for at in range(len(told) - 5))
    first = next(at for at, (size, kind) in enumerate(heads) if 5 <= size <= 2000 and kind == 16)
    assert first == 79


@pytest.mark.parametrize(("arm", "sizes"), [("ur5", SIZES_CB3), ("ur5e", SIZES_E)])
def test_the_state_has_exactly_the_size_of_the_series(arm, sizes):
    data = Client(arm).after(0.11)
    ((_, content),) = [packet for packet in packets_of(data) if packet[0] == 16]
    assert {kind: len(part) + 5 for kind, part in parts_of(content).items()} == sizes
    assert len(content) + 5 == {"ur5": 1351, "ur5e": 1386}[arm]


@pytest.mark.parametrize("arm", ["ur5", "ur5e"])
def test_the_state_comes_ten_times_a_second(arm):
    assert len(states_of(Client(arm).after(3.0))) == 30


def test_the_robot_mode_says_what_the_arm_does():
    client = Client()
    flags = ("connected", "enabled", "power", "emergency", "protective", "running", "paused")
    names = ("us", *flags, "mode")
    layout = ">Q7?BB3dB"

    def told():
        values = struct.unpack(layout, client.state[0])
        assert values[10:13] == (1.0, client.machine.outputs["speed_scaling"], 1.0)
        return dict(zip(names, values, strict=False))

    mode = told()
    assert mode["us"] == pytest.approx(client.machine.now_s * 1e6, abs=1e5)
    assert mode["connected"]
    assert mode["enabled"]
    assert mode["power"]
    assert not mode["running"]
    assert mode["mode"] == 7
    client.machine.play(IdleProgram("p"))
    assert told()["running"]
    client.machine.protective_stop(1)
    mode = told()
    assert mode["protective"]
    assert mode["paused"]
    assert not mode["running"]
    client.machine.emergency_stop()
    mode = told()
    assert mode["emergency"]
    client.machine.modes.power_off()
    mode = told()
    assert mode["mode"] == RobotMode.POWER_OFF
    assert not mode["power"]
    assert not mode["enabled"]


def test_the_joints_are_those_that_rtde_tells():
    client = Client()
    data = client.state[1]
    out = client.machine.outputs
    for joint in range(6):
        q, target, qd, current, volts, celsius, _, mode = struct.unpack_from(
            ">3d4fB", data, 41 * joint
        )
        assert q == pytest.approx(out["actual_q"][joint], abs=1e-3)
        assert target == out["target_q"][joint]
        assert qd == pytest.approx(out["actual_qd"][joint], abs=1e-2)
        assert current == pytest.approx(out["actual_current"][joint], abs=0.2)
        assert volts == np.float32(out["actual_joint_voltage"][joint])
        assert celsius == pytest.approx(out["joint_temperatures"][joint], abs=0.2)
        assert mode == 253


def test_pose_and_tool_offset():
    client = Client()
    client.machine.tcp = np.array([0.0, 0.01, 0.12, 0.1, 0.2, 0.3])
    numbers = struct.unpack(">12d", client.state[4])
    assert numbers[:6] == pytest.approx(client.machine.outputs["actual_TCP_pose"], abs=1e-3)
    assert numbers[6:] == pytest.approx(client.machine.tcp)


def test_kinematics_and_limits_are_the_published_ones():
    client = Client()
    state, arm = client.state, client.machine.body.arm
    numbers = struct.unpack(">6I24dI", state[5])
    theta, a, d, alpha = np.reshape(numbers[6:30], (4, 6))
    assert a == pytest.approx([0, -0.425, -0.39225, 0, 0, 0])
    assert d == pytest.approx([0.089159, 0, 0, 0.10915, 0.09465, 0.0823])
    assert np.degrees(alpha) == pytest.approx([90, 0, 0, 90, -90, 0])
    assert not theta.any()
    numbers = struct.unpack(">53d4i", state[6])
    assert numbers[0:12:2] == pytest.approx(arm.q_min)
    assert numbers[1:12:2] == pytest.approx(arm.q_max)
    assert numbers[12:24:2] == pytest.approx(np.radians([180] * 6))
    again = np.reshape(numbers[29:53], (4, 6))
    assert again == pytest.approx(np.stack((a, d, alpha, theta)))
    assert numbers[-2] == 1  # a UR5


@pytest.mark.parametrize("arm", ["ur5", "ur5e"])
def test_the_master_board_tells_inputs_outputs_and_safety(arm):
    client = Client(arm)
    out = client.machine.outputs
    out["actual_digital_input_bits"], out["actual_digital_output_bits"] = 5, 6
    out["standard_analog_output1"] = 0.5
    client.machine.protective_stop(1)
    data = client.state[3]
    numbers = struct.unpack_from(">IIBBddBBddffffB?B", data)
    assert numbers[:2] == (out["actual_digital_input_bits"], out["actual_digital_output_bits"])
    assert numbers[9] == out["standard_analog_output1"]
    assert numbers[11] == 48.0
    assert numbers[14:] == (SafetyMode.PROTECTIVE_STOP, False, 0)


def test_a_program_is_told_by_its_name():
    client = Client()
    client.wire.take()
    client.machine.play(IdleProgram("rtde_control"))
    client.machine.halt()
    started, stopped = messages_of(client.wire.take())
    for message, title in ((started, b"PROGRAM_XXX_STARTED"), (stopped, b"PROGRAM_XXX_STOPPED")):
        assert message.kind == 7
        code, argument, length = struct.unpack_from(">iiB", message.body)
        assert (code, argument) == (0, 0)
        assert message.body[9 : 9 + length] == title
        assert message.body[9 + length :] == b"rtde_control"


def test_a_new_safety_mode_is_told_once():
    client = Client()
    client.machine.protective_stop(1)
    told = [m for m in messages_of(client.after(1.0)) if m.kind == 5]
    assert [struct.unpack(">iiBII", m.body) for m in told] == [(0, 0, 3, 0, 0)]


@pytest.mark.parametrize(("fault", "code"), [(1, 153), (2, 157), (4, 158), (172, 172), (9, 0)])
def test_codes_of_errors_are_those_of_the_maker(fault, code):
    client = Client()
    client.wire.take()
    client.machine.protective_stop(fault)
    (error,) = messages_of(client.wire.take())
    assert error.kind == 6
    assert struct.unpack_from(">iiiII", error.body) == (code, 0, 3, 0, 0)


def test_a_runtime_error_says_what_and_ends_the_program():
    client = Client()
    client.machine.play(IdleProgram("p"))
    client.wire.take()
    client.machine.fail("another thread is already controlling the robot", 206)
    exception, error, stopped = messages_of(client.wire.take())
    assert exception.kind == 10
    assert struct.unpack_from(">II", exception.body) == (1, 1)
    assert exception.body[8:] == b"another thread is already controlling the robot"
    assert (error.kind, struct.unpack_from(">i", error.body)[0]) == (6, 206)
    assert stopped.kind == 7


BAD_CODE = """def bad_code():
  current_pose = get_target_tcp_pose()
  movel(current_pos) # note pose vs pos
end
"""


@pytest.mark.parametrize(
    ("text", "line", "column", "told"),
    [
        # What UR's client library expects in its own test of exceptions, and in `send_script`.
        ("def f():\n  nowhere()\nend\n", 2, 3, "compile_error_name_not_found:nowhere:"),
        (BAD_CODE, 3, 9, "compile_error_name_not_found:current_pos:"),
        ("def f():\n  if True:\n   x = [\n  end\nend\n", 3, 4, "syntax_error_on_line:3:   x = [:"),
        ("sec f():\n  nowhere()\nend\n", 2, 3, "compile_error_name_not_found:nowhere:"),
    ],
)  # fmt: skip
def test_what_does_not_compile_is_told_with_its_place_and_never_starts(text, line, column, told):
    client = Client()
    client.wire.take()
    client.session.received(text.encode())
    exception, explanation = messages_of(client.wire.take() + client.after(0.5))
    assert exception.kind == 10
    assert struct.unpack_from(">II", exception.body) == (line, column)
    assert exception.body[8:].decode() == told
    assert explanation.kind == 0


EXAMPLE_FUN = """def example_fun():
  movej([0,-1.2,1.2,-0.1,1.57,0])
  sleep(0.1)
  current_pose = get_target_tcp_pose()
  relative_move = p[0,-0.1,0,0,0,0]
  movel(pose_trans(current_pose, relative_move), t=1)
end
"""
NAMED = 'def cool_function_name():\n  textmsg("hello")\nend\n'
SECONDARY = 'sec sec_script():\n  textmsg("Named secondary program")\nend\n'


def titles_of(data):
    """Titles and texts of key messages, the kind and text of others."""
    told = []
    for message in messages_of(data):
        if message.kind == 7:
            length = message.body[8]
            told.append((message.body[9 : 9 + length], message.body[9 + length :]))
        elif message.kind in (0, 10):
            told.append((message.kind, message.body[8 if message.kind == 10 else 0 :]))
    return told


@pytest.mark.thorough
@pytest.mark.parametrize("arm", ["ur5", "ur5e"])
@pytest.mark.parametrize("powered", [True, False])
def test_the_send_script_example_of_urs_client_library(arm, powered):
    """What it sends once it has stripped comments, and what it waits for; read, not run."""
    client = Client(arm, powered=powered)

    def sent(text, seconds):
        """What is told until no program plays any more."""
        client.wire.take()
        client.session.received(text.encode())
        told, end = client.wire.take() + client.after(0.1), client.machine.now_s + seconds
        while client.machine.program is not None:
            told += client.after(0.1)
            assert client.machine.now_s < end
        return titles_of(told)

    client.session.received(b"set robotmode run\n")
    assert titles_of(client.after(3.0)) == []
    assert client.state[0][15] == RobotMode.RUNNING
    started, stopped = b"PROGRAM_XXX_STARTED", b"PROGRAM_XXX_STOPPED"
    assert sent(EXAMPLE_FUN, 6.0) == [(started, b"example_fun"), (stopped, b"example_fun")]
    assert sent(NAMED, 0.5) == [
        (started, b"cool_function_name"), (0, b"hello"), (stopped, b"cool_function_name")
    ]  # fmt: skip
    assert sent(SECONDARY, 0.5) == [(0, b"Named secondary program")]
    exception, _ = sent(BAD_CODE, 0.5)
    assert exception == (10, b"compile_error_name_not_found:current_pos:")
    moved = sent("movej([0.1,-0.9,0.9,0,0,0])\n", 6.0)
    assert [title for title, _ in moved] == [started, stopped]
    np.testing.assert_allclose(client.machine.setpoint[0], [0.1, -0.9, 0.9, 0, 0, 0], atol=1e-6)


def test_what_does_not_compile_ends_what_plays():
    client = Client()
    client.machine.play(IdleProgram("before"))
    client.wire.take()
    client.session.received(BAD_CODE.encode())
    stopped, exception, _ = messages_of(client.wire.take())
    assert (stopped.kind, stopped.body[-6:]) == (7, b"before")
    assert exception.kind == 10


def test_a_runtime_exception_has_the_line_of_its_statement():
    client = Client()
    client.wire.take()
    client.session.received(b"def f():\n  sync()\n  x = 1 / 0\nend\n")
    told = messages_of(client.wire.take() + client.after(0.5))
    started, exception, stopped = told
    assert (started.kind, exception.kind, stopped.kind) == (7, 10, 7)
    assert struct.unpack_from(">II", exception.body) == (3, 3)


def test_popups_and_texts():
    client = Client()
    client.wire.take()
    client.machine.tell("popup", "Weigh", "Put 2 kg on: ü")
    client.machine.tell("text", text="done")
    popup, text = messages_of(client.wire.take())
    assert popup.kind == 2
    *_, warning, error, blocking, length = struct.unpack_from(">II???B", popup.body)
    assert (warning, error, blocking) == (False, False, False)
    assert popup.body[12 : 12 + length] == b"Weigh"
    assert popup.body[12 + length :].decode() == "Put 2 kg on: ü"
    assert (text.kind, text.body) == (0, b"done")


def test_the_secondary_interface_tells_no_messages():
    client = Client(port=30002)
    client.wire.take()
    client.machine.play(IdleProgram("p"))
    client.machine.protective_stop(1)
    assert {kind for kind, _ in packets_of(client.after(0.5))} == {16}


def test_every_client_is_told_and_those_that_left_are_not():
    client = Client()
    wire = Wire()
    session = client.service.accept(wire)
    wire.take()
    client.machine.tell("text", text="one")
    session.hung_up()
    wire.close()
    client.machine.tell("text", text="two")
    assert [message.body for message in messages_of(wire.take())] == [b"one"]
    assert [m.body for m in messages_of(client.wire.take())[2:]] == [b"one", b"two"]


def test_a_client_that_reads_nothing_costs_no_memory():
    client = Client()
    client.wire.take()
    client.wire.pending = MOST_PENDING
    client.machine.tell("text", text="lost")
    assert client.after(2.0) == b""
    client.wire.pending = 0
    assert len(states_of(client.after(1.0))) == 11  # the one that is overdue comes at once


REALTIME_SIZES = {"ur5": 1116, "ur5e": 1220}


class Monitor:
    """The real-time interface and one client."""

    def __init__(self, arm="ur5"):
        self.machine = machine_of(arm)
        self.wire = Wire()
        self.session = RealtimeService(self.machine).accept(self.wire)

    def tick(self):
        self.machine.tick()
        self.session.ticked()
        return self.wire.take()


@pytest.mark.parametrize("arm", ["ur5", "ur5e"])
def test_a_real_time_packet_a_tick_of_the_size_of_the_version(arm):
    monitor = Monitor(arm)
    for _ in range(5):
        data = monitor.tick()
        assert len(data) == REALTIME_SIZES[arm]
        assert struct.unpack_from(">i", data) == (len(data),)


def column(data, first, last=None):
    """Doubles by the columns of the documentation, which count from 1."""
    last = last or first
    return struct.unpack_from(f">{last - first + 1}d", data, 4 + 8 * (first - 1))


@pytest.mark.parametrize("arm", ["ur5", "ur5e"])
def test_real_time_columns_are_rtdes_variables(arm):
    monitor = Monitor(arm)
    out = monitor.machine.outputs
    for number, name in enumerate(n for n, v in out.variables.items() if v.type == "VECTOR6D"):
        if name.startswith(("actual_TCP", "target_TCP", "actual_joint_voltage")):
            out[name] = [number + 0.1 * i for i in range(6)]  # told apart
    data = monitor.tick()
    for first, name in (
        (1, "timestamp"),
        (2, "target_q"),
        (8, "target_qd"),
        (14, "target_qdd"),
        (20, "target_current"),
        (26, "target_moment"),
        (32, "actual_q"),
        (38, "actual_qd"),
        (44, "actual_current"),
        (50, "joint_control_output"),
        (56, "actual_TCP_pose"),
        (62, "actual_TCP_speed"),
        (68, "actual_TCP_force"),
        (74, "target_TCP_pose"),
        (80, "target_TCP_speed"),
        (86, "actual_digital_input_bits"),
        (87, "joint_temperatures"),
        (95, "robot_mode"),
        (96, "joint_mode"),
        (102, "safety_mode"),
        (109, "actual_tool_accelerometer"),
        (118, "speed_scaling"),
        (119, "actual_momentum"),
        (122, "actual_main_voltage"),
        (123, "actual_robot_voltage"),
        (124, "actual_robot_current"),
        (125, "actual_joint_voltage"),
        (131, "actual_digital_output_bits"),
        (132, "runtime_state"),
        (133, "elbow_position"),
        (136, "elbow_velocity"),
        (139, "safety_status"),
    ):
        count = out.variables[name].count
        expected = out[name] if count > 1 else [out[name]]
        assert list(column(data, first, first + count - 1)) == expected, name
    if arm == "ur5e":
        assert column(data, 143) == (out["payload"],)
        assert list(column(data, 144, 146)) == out["payload_cog"]
        assert list(column(data, 147, 152)) == out["payload_inertia"]


def test_whole_real_time_packets_are_dropped_for_a_slow_reader():
    monitor = Monitor()
    monitor.tick()
    monitor.wire.pending = 300  # the rest of a packet that was begun
    for _ in range(1000):
        assert monitor.tick() == b""
    assert monitor.session.dropped == 1000
    monitor.wire.pending = 0
    data = monitor.tick()
    assert column(data, 1) == (monitor.machine.now_s,)
