"""Mistakes of the mock UR controller itself end one client or program, not everybody's robot."""

import json
import socket
import struct

import pytest

from hil_mock_robot.ur.faults import UrFaults
from hil_mock_robot.ur.loop import Loop
from hil_mock_robot.ur.modes import RuntimeState
from hil_mock_robot.ur.pacing import FreeRun, LockStep
from hil_mock_robot.ur.program import Threaded
from hil_mock_robot.ur.rtde import RtdeService
from hil_mock_robot.ur.side import SideService
from tests.support.mock_servers import loopback
from tests.support.ur_machine import Wire, machine_of, movej, pass_time
from tests.support.ur_raw import Raw


class Wrong(Exception):
    """Nobody foresaw that."""


class Broken(Threaded):
    """A program with a mistake in its third tick."""

    def main(self):
        yield
        yield
        raise Wrong("a mistake \ud800")


class BrokenMotion:
    def advance(self, now, scale):
        raise Wrong("of a motion")


def contained(machine):
    machine.mishaps.contained = True
    told = []
    machine.listeners.append(lambda event: told.append((event.kind, event.text)))
    return told


# Programs and motions


def test_a_mistake_in_a_program_ends_that_program_and_says_so(capsys):
    machine = machine_of()
    told = contained(machine)
    machine.play(Broken("work"))
    pass_time(machine, 0.1)
    assert machine.runtime is RuntimeState.STOPPED
    (text,) = [text for kind, text in told if kind == "error"]
    assert "Wrong" in text
    assert text.isascii()
    assert "a program" in capsys.readouterr().err


def test_a_mistake_in_a_motion_brakes_the_arm():
    machine = machine_of()
    contained(machine)
    machine.move(movej(machine.setpoint[0] + 0.5, 1.0, 2.0, machine.tick_s))
    pass_time(machine, 0.3)
    assert machine.setpoint[1].any()
    machine.move(BrokenMotion())
    pass_time(machine, 0.3)
    assert not machine.setpoint[1].any()
    assert machine.modes.running


def test_a_mistake_that_comes_again_is_told_once(capsys):
    machine = machine_of()
    contained(machine)
    for _ in range(3):
        machine.move(BrokenMotion())
        machine.tick()
    assert capsys.readouterr().err.count("internal error of the mock") == 1
    assert list(machine.mishaps.counts.values()) == [3]


@pytest.mark.parametrize("what", ["a program", "a motion"])
def test_in_tests_a_mistake_is_seen(what):
    machine = machine_of()
    if what == "a program":
        machine.play(Broken("work"))
    else:
        machine.move(BrokenMotion())
    with pytest.raises(Wrong):
        pass_time(machine, 0.1)


# Clients


WHERE = loopback()


class BrokenService:
    """A port on which one word is a mistake, in the method of that name."""

    port = 30020

    def __init__(self, where):
        self.where = where

    def accept(self, link):
        self._maybe("accept")
        return self

    lossless = False

    def received(self, data):
        self._maybe("received")

    def ticked(self):
        self._maybe("ticked")

    def hung_up(self):
        self._maybe("hung_up")

    def _maybe(self, where):
        if where == self.where:
            raise Wrong(where)


def meeting(loop, raw):
    """The broken port and a recording beside it."""
    raw.send("V", struct.pack(">H", 2))
    raw.send("O", struct.pack(">d", 125.0) + b"timestamp")
    raw.send("S")
    with socket.create_connection((WHERE, BrokenService.port), 5.0) as other:
        turns(loop)
        other.sendall(b"hello")
        turns(loop)
    turns(loop)


def turns(loop):
    for _ in range(20):
        loop.turn()


@pytest.fixture
def loop_with():
    loops = []

    def make(where, is_contained):
        machine = machine_of()
        machine.mishaps.contained = is_contained
        services = [RtdeService(machine), BrokenService(where)]
        loops.append(Loop(machine, services, FreeRun(), WHERE))
        return loops[-1], machine

    yield make
    for loop in loops:
        loop.close()


@pytest.mark.wire
@pytest.mark.parametrize("where", ["accept", "received", "ticked", "hung_up"])
def test_a_mistake_with_one_client_hangs_up_on_that_client_only(where, loop_with):
    loop, machine = loop_with(where, True)
    with Raw(WHERE) as raw:
        meeting(loop, raw)
        assert [kind for kind, _ in (raw.receive() for _ in range(3))] == list("VOS")
        raw.names, raw.types, raw.protocol = ["timestamp"], ["DOUBLE"], 2
        ticks = [round(raw.read()["timestamp"] * 125) for _ in range(30)]
        assert ticks == list(range(ticks[0], ticks[0] + 30))
        assert [link.port for link, _ in loop.sessions.values()] == [30004]
    assert sum(machine.mishaps.counts.values()) == 1


@pytest.mark.wire
@pytest.mark.parametrize("where", ["accept", "received", "ticked", "hung_up"])
def test_in_tests_a_mistake_with_a_client_is_seen(where, loop_with):
    loop, _ = loop_with(where, False)
    with Raw(WHERE) as raw, pytest.raises(Wrong):
        meeting(loop, raw)


# The side channel


def side():
    machine = machine_of()
    service = SideService(30100, machine, UrFaults(machine), LockStep())
    wire = Wire()
    return service, service.accept(wire), wire


def answers(wire):
    return [json.loads(line) for line in wire.take().splitlines()]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "line",
    [
        b'{"do": []}',
        b'{"do": {}}',
        b'{"do": 3}',
        b"[" * 90_000,
        b'{"do": "fault", "kind": "silence", "for_s": 1e308}',
        b'{"do": "fault", "kind": "silence", "for_s": 1' + 400 * b"0" + b"}",
        b'{"do": "fault", "kind": "cut", "at_s": 1e308}',
        b'{"do": "push", "torque": [1' + 400 * b"0" + b",0,0,0,0,0]}",
        b'{"do": "mount", "mass_kg": NaN}',
        b'{"do": "mount", "mass_kg": {}}',
        b'{"do": "step", "ticks": 1e3}',
        b"\xff\xfe",
        b"\x00",
    ],
)
def test_a_request_that_cannot_be_gets_an_answer_in_words(line):
    service, session, wire = side()
    session.received(line + b"\n")
    (answer,) = answers(wire)
    assert answer["error"]
    assert answer["hint"]
    for _ in range(3):
        service.faults.tick()


def test_requests_that_wait_for_a_step_are_not_kept_without_bound():
    service, session, wire = side()
    session.received(b'{"do": "step", "ticks": 1000}\n')
    for _ in range(10):
        session.received(b'{"do": "state"}\n' * 100)
    assert not wire.closed
    for _ in range(1000):
        if wire.closed:
            break
        session.received(b'{"do": "state"}\n' * 1000)
    assert wire.closed
    assert answers(wire)[-1]["error"]
    session.hung_up()
    assert service.pacer.permitted == 0
