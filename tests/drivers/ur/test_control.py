"""Every answer of `ur-rtde` is looked at, and what is sent is what was meant."""

from __future__ import annotations

import socket
import sys
import types

import pytest

from hil.arms.payload import Payload
from hil.core.errors import CommandRefused, PluginError, RobotConnectionError
from hil_drivers.ur import control as module
from hil_drivers.ur.control import Control
from tests.support.mock_servers import loopback


class Interface:
    """Says `answer` to everything, and keeps what it was called with."""

    FLAG_UPLOAD_SCRIPT, FLAG_NO_EXT_FT = 1, 64
    errors: tuple[Exception, ...] = ()
    answer = True

    def __init__(self, *how):
        self.calls = []
        made.append(self)
        if self.errors:
            error, *rest = self.errors
            type(self).errors = tuple(rest)
            raise error

    def isProgramRunning(self):  # noqa: N802
        return self.answer

    def __getattr__(self, name):
        return lambda *args: (self.calls.append((name, *args)), self.answer)[1]


made: list[Interface] = []


@pytest.fixture
def open_control(monkeypatch):
    made.clear()
    library = types.ModuleType("fake_rtde_control")

    def make(series=(3, 15), answer=True, errors=()):
        members = {"answer": answer, "errors": tuple(errors)}
        library.RTDEControlInterface = type("Fake", (Interface,), members)
        return Control("192.0.2.7", 125.0, series, library="fake_rtde_control")

    monkeypatch.setitem(sys.modules, "fake_rtde_control", library)
    monkeypatch.setattr(module, "IN_USE_WAITS_S", (0.0, 0.0))
    return make


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (lambda c: c.arm_watchdog(4.0), "setWatchdog"),
        (lambda c: c.kick(), "kickWatchdog"),
        (lambda c: c.move_j([0.0] * 6, 0.5, 1.0), "moveJ"),
        (lambda c: c.servo_j([0.0] * 6, 0.1, 300), "servoJ"),
        (lambda c: c.servo_stop(10.0), "servoStop"),
        (lambda c: c.set_payload(Payload(1.0)), "setPayload"),
    ],
)
@pytest.mark.parametrize("answer", [False, None])
def test_an_answer_that_is_not_true_is_an_error(open_control, command, said, answer):
    control = open_control(answer=answer)
    with pytest.raises(CommandRefused, match=said):
        command(control)


@pytest.mark.parametrize(
    ("thrown", "error"),
    [
        (RuntimeError("unable to get state data"), RobotConnectionError),
        (OverflowError("std::logic_error"), RobotConnectionError),
        (ValueError("not within [0;3.14]"), CommandRefused),
    ],
)
@pytest.mark.parametrize(
    "command",
    [
        lambda c: c.kick(),
        lambda c: c.move_j([0.0] * 6, 0.5, 1.0),
        lambda c: c.servo_j([0.0] * 6, 0.1, 300.0),
        lambda c: c.stop_j(6.0),
        lambda c: c.servo_stop(10.0),
        lambda c: c.operation,
        lambda c: c.set_payload(Payload(1.0)),
    ],
)
def test_whatever_the_library_throws_is_an_error_of_ours(open_control, command, thrown, error):
    control = open_control()

    class Throws:
        def __getattr__(self, name):
            def throw(*args):
                raise thrown

            return throw

    control._rtde = Throws()
    with pytest.raises(error, match="ur-rtde"):
        command(control)


@pytest.mark.parametrize("n", [0, 5, 7])
def test_a_vector_of_another_length_never_gets_to_the_library(open_control, n):
    control = open_control()
    for command in (
        lambda: control.move_j([0.0] * n, 0.5, 1.0),
        lambda: control.servo_j([0.0] * n, 0.1, 300.0),
    ):
        with pytest.raises(CommandRefused, match="6 joint angles"):
            command()
    assert not made[0].calls


def test_moves_are_never_synchronous(open_control):
    open_control().move_j([0.0] * 6, 0.5, 1.0)
    assert made[0].calls == [("moveJ", [0.0] * 6, 0.5, 1.0, True)]


@pytest.mark.parametrize(
    ("series", "com", "sent"),
    [
        ((3, 15), (0.0, 0.0, 0.0), ("setPayload", 2.0, [0.0, 0.0, 0.0])),
        # 5.x takes zeros for "keep the one you have".
        ((5, 8), (0.0, 0.0, 0.0), ("setPayload", 2.0, [0.0, 0.0, 1e-6])),
        ((5, 8), (0.0, 0.0, 0.1), ("setPayload", 2.0, [0.0, 0.0, 0.1])),
        ((5, 10), (0.0, 0.0, 0.1), ("setTargetPayload", 2.0, [0.0, 0.0, 0.1], [0.1] * 6)),
    ],
)
def test_a_payload_is_declared_as_the_software_wants_it(open_control, series, com, sent):
    open_control(series).set_payload(Payload(2.0, com, (0.1,) * 6))
    assert made[0].calls == [sent]


IN_USE = RuntimeError("One of the RTDE input registers are already in use! Currently you must")


def test_inputs_in_use_are_tried_again(open_control):
    open_control(errors=[IN_USE, IN_USE])
    assert len(made) == 3


def test_inputs_that_stay_in_use_are_told_with_who_may_own_them(open_control):
    with pytest.raises(RobotConnectionError, match="owns the inputs") as caught:
        open_control(errors=[IN_USE] * 3)
    assert "PROFINET" in caught.value.hint


def test_any_other_error_is_not_tried_again(open_control):
    with pytest.raises(RobotConnectionError, match="timeout of 5 seconds"):
        open_control(errors=[RuntimeError("Failed to start, before timeout of 5 seconds")])
    assert len(made) == 1


class Connecting(Interface):
    """Opens a connection as `ur-rtde` does, and another one when it has lost it."""

    def __init__(self, host, *how):
        super().__init__(host, *how)
        self.line = socket.create_connection((host, 30004), 5.0)

    def connect_again(self, host):
        self.line.close()
        self.line = socket.create_connection((host, 30004), 5.0)


@pytest.mark.wire
def test_a_connection_that_the_library_opens_again_is_not_the_one_it_had(monkeypatch):
    address = loopback()
    library = types.ModuleType("fake_rtde_control")
    library.RTDEControlInterface = Connecting
    monkeypatch.setitem(sys.modules, "fake_rtde_control", library)
    with (
        socket.create_server((address, 30004)),
        socket.create_connection((address, 30004)) as another,
    ):
        control = Control(address, 125.0, (3, 15), library="fake_rtde_control")
        assert control.connected
        another.close()
        assert control.connected
        made[-1].connect_again(address)
        assert not control.connected
        made[-1].line.close()


def test_without_the_library_the_error_says_what_to_install():
    with pytest.raises(PluginError, match="ur-rtde") as caught:
        Control("192.0.2.7", 125.0, (3, 15), library="no_such_library")
    assert "pip install" in caught.value.hint
