"""RTDE over real sockets: the unmodified ur_rtde, and a plain client beside it."""

import contextlib
import functools
import math
import random
import socket
import struct
import time

import numpy as np
import pytest

from tests.support.mock_servers import loopback, mock_ur, served
from tests.support.ur_raw import Raw, started
from tests.support.waiting import until

rtde_receive = pytest.importorskip("rtde_receive")
rtde_io = pytest.importorskip("rtde_io")

pytestmark = pytest.mark.wire

ARMS = [("ur5", 125.0), ("ur5e", 500.0)]
BOTH = pytest.mark.parametrize(("arm", "rate_hz"), ARMS)
GETTERS = {
    "target_q": "getTargetQ",
    "target_qd": "getTargetQd",
    "target_qdd": "getTargetQdd",
    "target_current": "getTargetCurrent",
    "target_moment": "getTargetMoment",
    "actual_q": "getActualQ",
    "actual_qd": "getActualQd",
    "actual_current": "getActualCurrent",
    "joint_control_output": "getJointControlOutput",
    "actual_TCP_pose": "getActualTCPPose",
    "actual_TCP_speed": "getActualTCPSpeed",
    "actual_TCP_force": "getActualTCPForce",
    "target_TCP_pose": "getTargetTCPPose",
    "target_TCP_speed": "getTargetTCPSpeed",
    "actual_digital_input_bits": "getActualDigitalInputBits",
    "joint_temperatures": "getJointTemperatures",
    "actual_execution_time": "getActualExecutionTime",
    "robot_mode": "getRobotMode",
    "joint_mode": "getJointMode",
    "safety_mode": "getSafetyMode",
    "actual_tool_accelerometer": "getActualToolAccelerometer",
    "speed_scaling": "getSpeedScaling",
    "target_speed_fraction": "getTargetSpeedFraction",
    "actual_momentum": "getActualMomentum",
    "actual_main_voltage": "getActualMainVoltage",
    "actual_robot_voltage": "getActualRobotVoltage",
    "actual_robot_current": "getActualRobotCurrent",
    "actual_joint_voltage": "getActualJointVoltage",
    "actual_digital_output_bits": "getActualDigitalOutputBits",
    "runtime_state": "getRuntimeState",
    "standard_analog_input0": "getStandardAnalogInput0",
    "standard_analog_input1": "getStandardAnalogInput1",
    "standard_analog_output0": "getStandardAnalogOutput0",
    "standard_analog_output1": "getStandardAnalogOutput1",
    "robot_status_bits": "getRobotStatus",
    "safety_status_bits": "getSafetyStatusBits",
    "payload": "getPayload",
    "payload_cog": "getPayloadCog",
    "payload_inertia": "getPayloadInertia",
}
E_GETTERS = {"ft_raw_wrench": "getFtRawWrench"}
INTS = DOUBLES = range(12, 20)


@contextlib.contextmanager
def receiving(where, *arguments):
    receive = rtde_receive.RTDEReceiveInterface(where, *arguments)
    try:
        assert receive.isConnected()
        yield receive
    finally:
        receive.disconnect()


def io_of(where):
    """None as long as the inputs are those of a client that has only just hung up."""
    with contextlib.suppress(RuntimeError):
        return rtde_io.RTDEIOInterface(where)


@contextlib.contextmanager
def writing(where):
    io = until(lambda: io_of(where))
    try:
        yield io
    finally:
        io.disconnect()


def snapshot(receive, getters):
    """All of one tick: what every getter says, at a time stamp that did not change meanwhile."""
    while True:
        stamp = receive.getTimestamp()
        told = {name: getattr(receive, getter)() for name, getter in getters.items()}
        told |= {f"output_int_register_{i}": receive.getOutputIntRegister(i) for i in INTS}
        told |= {f"output_double_register_{i}": receive.getOutputDoubleRegister(i) for i in DOUBLES}
        if receive.getTimestamp() == stamp:
            return stamp, told


@pytest.fixture(scope="module")
def controller():
    """Where a controller of an arm listens, in real time; each is started once."""
    with contextlib.ExitStack() as stack:
        started = functools.cache(lambda arm: stack.enter_context(mock_ur("--model", arm)).address)
        yield started


# The unmodified ur_rtde


@BOTH
def test_every_state_getter_of_ur_rtde_equals_the_outputs(arm, rate_hz):
    where = loopback()
    getters = GETTERS | (E_GETTERS if arm == "ur5e" else {})
    names = ["timestamp", *getters]
    names += [f"output_int_register_{i}" for i in INTS]
    names += [f"output_double_register_{i}" for i in DOUBLES]
    with (
        served(
            "tests.support.ur_distinct",
            ["--address", where, "--model", arm, "--speed", str(5 / rate_hz)],
        ),
        started(where, names, rate_hz) as raw,
        receiving(where) as receive,
    ):
        for _ in range(3):
            stamp, told = snapshot(receive, getters)
            truth = raw.read()
            while truth["timestamp"] < stamp:
                truth = raw.read()
            assert truth.pop("timestamp") == stamp
            assert told == truth
            numbers = [n for v in truth.values() for n in (v if isinstance(v, list) else [v])]
            assert len(set(numbers)) > 0.9 * len(numbers), "they are not distinct"
            until(lambda before=stamp: receive.getTimestamp() > before)


@BOTH
def test_receiving_follows_the_controller_at_its_rate(controller, arm, rate_hz):
    where = controller(arm)
    with receiving(where) as receive:
        first, since, stamps = receive.getTimestamp(), time.monotonic(), set()
        while max(stamps, default=0.0) < first + 1.0:
            stamps.add(receive.getTimestamp())
            time.sleep(0.0005)
            assert time.monotonic() < since + 10.0
        # A busy computer is late and catches up, by half a second at most; it is never early.
        assert time.monotonic() - since > 0.4
        ticks = np.array(sorted(stamps)) * rate_hz
        assert ticks == pytest.approx(ticks.round())
        assert np.diff(ticks).min() == pytest.approx(1.0)
        assert receive.getRobotMode() == 7
        assert receive.getSafetyMode() == 1
        upright = [0, -math.pi / 2, 0, -math.pi / 2, 0, 0]
        assert receive.getActualQ() == pytest.approx(upright, abs=1e-2)


def test_a_receiver_chooses_its_frequency(controller):
    where = controller("ur5e")
    with receiving(where, 25.0) as receive:
        stamps, since = set(), time.monotonic()
        while time.monotonic() - since < 0.8:
            stamps.add(receive.getTimestamp())
            time.sleep(0.0005)
        assert np.diff(sorted(stamps)).min() == pytest.approx(0.04)
        assert len(stamps) < 30


@BOTH
def test_ur_rtde_sets_outputs_and_only_those_it_means(controller, arm, rate_hz):
    where = controller(arm)
    with writing(where) as io, receiving(where) as receive:
        assert io.setStandardDigitalOut(3, True)
        assert io.setStandardDigitalOut(0, True)
        assert io.setConfigurableDigitalOut(1, True)
        assert io.setToolDigitalOut(0, True)
        until(lambda: receive.getActualDigitalOutputBits() == 0b1_00000010_00001001)
        assert io.setStandardDigitalOut(3, False)
        until(lambda: receive.getActualDigitalOutputBits() == 0b1_00000010_00000001)
        assert io.setAnalogOutputVoltage(0, 0.5)
        until(lambda: receive.getStandardAnalogOutput0() == 5.0)
        assert io.setAnalogOutputCurrent(1, 0.25)
        until(lambda: receive.getStandardAnalogOutput1() == 8.0)
        assert receive.getStandardAnalogOutput0() == 5.0
        assert io.setSpeedSlider(0.4)
        until(lambda: receive.getTargetSpeedFraction() == 0.4)


def test_registers_that_ur_rtde_writes_are_echoed(controller):
    names = [f"input_{kind}_register_{i}" for kind in ("int", "double") for i in range(18, 23)]
    where = controller("ur5")
    with writing(where) as io, started(where, names) as raw:
        for i in range(18, 23):
            assert io.setInputIntRegister(i, -i)
            assert io.setInputDoubleRegister(i, i / 8)
        wanted = [-i for i in range(18, 23)] + [i / 8 for i in range(18, 23)]
        until(lambda: list(raw.read().values()) == wanted)


def test_a_second_client_may_not_write_what_the_first_one_writes_until_that_hangs_up(controller):
    where = controller("ur5")
    with writing(where), pytest.raises(RuntimeError, match="already in use"):
        rtde_io.RTDEIOInterface(where)
    with writing(where) as io:
        assert io.setStandardDigitalOut(0, True)


def test_two_receivers_get_what_each_has_asked_for(controller):
    where = controller("ur5e")
    with (
        receiving(where) as receive,
        started(where, ["timestamp"], 50.0) as slow,
        started(where, ["actual_q", "timestamp"], 500.0) as fast,
    ):
        spacing = [slow.read()["timestamp"] for _ in range(6)]
        assert np.diff(spacing) == pytest.approx(0.02)
        spacing = [fast.read()["timestamp"] for _ in range(6)]
        assert np.diff(spacing) == pytest.approx(0.002)
        assert receive.isConnected()


# What UR's own clients do

RECORDED = """
    timestamp target_q target_qd target_qdd target_current target_moment actual_q actual_qd
    actual_current joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force
    target_TCP_pose target_TCP_speed actual_digital_input_bits joint_temperatures
    actual_execution_time robot_mode joint_mode safety_mode safety_status
    actual_tool_accelerometer speed_scaling target_speed_fraction actual_momentum
    actual_main_voltage actual_robot_voltage actual_robot_current actual_joint_voltage
    actual_digital_output_bits runtime_state
"""


@BOTH
def test_a_recording_at_full_rate_has_no_gap(controller, arm, rate_hz):
    """As UR's Python client records: version, 32 outputs, start, read, pause."""
    where = controller(arm)
    with Raw(where) as raw:
        assert raw.negotiate()
        assert len(raw.ask("v")) == 16
        number, types = raw.outputs(RECORDED.split(), rate_hz)
        assert number == 1
        assert "NOT_FOUND" not in types
        assert raw.start()
        ticks = [round(raw.read()["timestamp"] * rate_hz) for _ in range(round(rate_hz))]
        assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))
        assert raw.pause()


def test_a_client_pauses_and_starts_again(controller):
    """As UR's C++ client does at its first connection."""
    where = controller("ur5e")
    with started(where, ["timestamp"], 50.0) as raw, started(where, ["timestamp"]) as other:
        before = [raw.read()["timestamp"] for _ in range(5)][-1]
        assert raw.pause()
        until(lambda: other.read()["timestamp"] > before + 0.2)
        raw.socket.settimeout(0.01)
        with pytest.raises(TimeoutError):
            raw.receive()
        raw.socket.settimeout(5.0)
        assert raw.start()
        assert raw.read()["timestamp"] > before + 0.2


@pytest.mark.journey
def test_a_control_loop_writes_set_points_and_reads_them_back(controller):
    """As UR's example of a control loop does, with a watchdog and its own recipe ids."""
    points = [f"input_double_register_{i}" for i in range(6)]
    where = controller("ur5")
    with started(where, points) as raw, Raw(where) as writer:
        assert writer.negotiate()
        assert writer.inputs(points) == (1, ["DOUBLE"] * 6)
        assert writer.inputs(["input_int_register_0"]) == (2, ["INT32"])
        writer.write(1, "6d", *range(6))
        until(lambda: list(raw.read().values()) == [0, 1, 2, 3, 4, 5])
        writer.write(1, "5d", *range(10, 15))
        writer.write(2, "i", 1)
        for _ in range(20):
            assert list(raw.read().values()) == [0, 1, 2, 3, 4, 5]


# Time


def test_accelerated_time_loses_nothing_when_a_client_is_slow():
    with mock_ur("--speed", "free") as mock, started(mock.address, RECORDED.split()) as raw:
        ticks = []
        for number in range(3000):
            if number % 1000 == 0:
                time.sleep(0.3)
            ticks.append(round(raw.read()["timestamp"] * 125))
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))


class Permits:
    """As many ticks as the test lets pass."""

    def __init__(self, patient):
        self.patient = patient

    def wait_s(self):
        return 0.0

    def ticked(self):
        pass


@pytest.fixture
def looped():
    """A loop in this process, and a client that has started but reads nothing."""
    from hil_mock_robot.ur.loop import Loop
    from hil_mock_robot.ur.rtde import RtdeService
    from tests.support.ur_machine import machine_of

    with contextlib.ExitStack() as stack:

        def make(patient):
            machine, where = machine_of(), loopback()
            loop = Loop(machine, [RtdeService(machine)], Permits(patient), where)
            stack.callback(loop.close)
            raw = stack.enter_context(Raw(where, receive_buffer=4096))
            names = b"actual_q,actual_qd,actual_current,joint_temperatures,target_q"
            raw.send("V", b"\x00\x02")
            raw.send("O", struct.pack(">d", 125.0) + names)
            raw.send("S")
            until(lambda: loop.turn() or loop.sessions)
            ((link, _),) = loop.sessions.values()
            link.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
            until(lambda: loop.turn() or link.pending)
            return loop, machine, link, raw

        yield make


def test_real_time_does_not_wait_for_a_client_that_does_not_read(looped):
    loop, machine, link, _ = looped(patient=False)
    before = machine.ticks
    for _ in range(50):
        loop.turn()
    assert machine.ticks == before + 50
    assert not link.closed


def test_accelerated_time_waits_until_the_client_has_read(looped, monkeypatch):
    monkeypatch.setattr("hil_mock_robot.ur.loop.LONGEST_WAIT_S", 0.01)
    loop, machine, _, raw = looped(patient=True)
    before = machine.ticks
    for _ in range(5):
        loop.turn()
    assert machine.ticks == before
    raw.socket.setblocking(False)

    def read():
        with contextlib.suppress(BlockingIOError):
            raw.socket.recv(65_536)
        loop.turn()
        return machine.ticks > before

    until(read)


@pytest.mark.parametrize("patient", [True, False])
def test_a_client_that_never_reads_is_hung_up_on(looped, monkeypatch, patient):
    monkeypatch.setattr("hil_mock_robot.ur.loop.LONGEST_WAIT_S", 0.01)
    loop, machine, _, _ = looped(patient)
    monkeypatch.setattr("hil_mock_robot.ur.loop.DEAF_S", 0.05)
    until(lambda: loop.turn() or not loop.sessions)
    before = machine.ticks
    loop.turn()
    assert machine.ticks == before + 1


# What clients should not do


def test_nobody_notices_clients_that_send_rubbish_or_vanish(controller):
    """Garbage, half packages, resets in mid-stream: a recording beside them has no gap."""
    chance = random.Random(4)
    where = controller("ur5e")
    with started(where, ["timestamp"], 500.0) as witness:
        for number in range(40):
            raw = Raw(where)
            if number % 4 == 0:
                raw.close()
                raw = started(where, RECORDED.split(), 500.0)
                raw.read()
                raw.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            elif number % 4 == 1:
                raw.send("O", chance.randbytes(2000))
                raw.send("U", b"")
            with contextlib.suppress(OSError):
                if number % 4 > 1:
                    raw.socket.sendall(chance.randbytes(chance.randrange(5000)))
            raw.close()
        ticks = [round(witness.read()["timestamp"] * 500) for _ in range(400)]
        assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))


def test_a_length_that_cannot_be_ends_only_that_connection(controller):
    where = controller("ur5")
    with started(where, ["timestamp"]) as witness, Raw(where) as raw:
        raw.socket.sendall(b"\x00\x01S")
        with pytest.raises(ConnectionError):
            raw.receive()
        assert witness.read()["timestamp"] > 0
