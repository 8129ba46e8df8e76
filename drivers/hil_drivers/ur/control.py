"""`ur-rtde`'s control interface with every answer looked at: `False` is an error, and says which.

Its commands return `False` without a word when the program does not run, in a protective stop and
on time-outs; its stops return nothing at all; vectors of a wrong length shift what the controller
reads. None of that leaves this file.

Nor does it say that its connection is another one: it connects again by itself, and while it does,
its set-points are lost with every answer `True`, and the stop of its program may be overwritten by
the next set-point before the program sees it. `OwnLine` notices that by the sockets it opened.
"""

from __future__ import annotations

import contextlib
import os
import socket
import stat
import time
from collections.abc import Iterator, Sequence
from importlib import import_module
from typing import Any, TypeAlias

from hil.arms import Payload
from hil.core import CommandRefused, PluginError, RobotConnectionError
from hil_drivers.ur.rtde import RTDE_PORT

LIBRARY = "rtde_control"

IN_USE_WAITS_S = (0.5, 1.0, 2.0)
"""How long to wait before each further try while somebody else owns the inputs: a session that
has crashed keeps them for a while [s]."""

NO_COM_M = 1e-6
"""In place of a centre of mass of zeros, which 5.x takes for "keep the one you have" [m]."""

N = 6


class Control:
    """The robot program that carries out commands, and the connection to it; for one thread.

    Its constructor holds the interpreter, for seconds when something is wrong and for ever when
    the controller does not answer: only in a process that may be killed.

    Args:
        address: Of the controller.
        frequency_hz: Of the controller's state.
        series: Major and minor version of its software.
        library: Module that offers `RTDEControlInterface`.

    Raises:
        PluginError: `ur-rtde` is not installed.
        RobotConnectionError: No controller answers, or another client owns the inputs.
    """

    def __init__(
        self,
        address: str,
        frequency_hz: float,
        series: tuple[int, int],
        *,
        library: str = LIBRARY,
    ) -> None:
        self._series = series
        self._period_s = 1.0 / frequency_hz
        kind = _library(library)
        # The force-torque input is one more register that somebody else might own.
        flags = int(kind.FLAG_UPLOAD_SCRIPT) | int(kind.FLAG_NO_EXT_FT)
        self._line = OwnLine()
        with self._line.opened():
            self._rtde = _opened(kind, address, frequency_hz, flags)

    @property
    def connected(self) -> bool:
        """Whether it has the connection it was opened with; no other one is to be trusted."""
        return self._line.kept

    @property
    def playing(self) -> bool:
        """Whether the robot program runs, as far as this connection has received."""
        return bool(self._ask("isProgramRunning"))

    @property
    def operation(self) -> tuple[int, bool]:
        """Number of the newest asynchronous operation, and whether it is running."""
        status = self._ask("getAsyncOperationProgressEx")
        return int(status.operationId()), bool(status.isAsyncOperationRunning())

    def arm_watchdog(self, least_hz: float) -> None:
        """From now on the program stops when it is commanded less often than this."""
        self._command("setWatchdog", least_hz)

    def kick(self) -> None:
        """Reset the watchdog; clears the command register."""
        self._command("kickWatchdog")

    def move_j(self, q: Sequence[float], speed: float, acceleration: float) -> None:
        """Begin a move of the controller's own; comes back at once (a few ticks)."""
        self._command("moveJ", _six(q), speed, acceleration, True)

    def servo_j(self, q: Sequence[float], lookahead_s: float, gain: float) -> None:
        """Lead the arm to the next set-point."""
        self._command("servoJ", _six(q), 0.0, 0.0, self._period_s, lookahead_s, gain)

    def servo_stop(self, deceleration: float) -> None:
        """End leading; comes back when the arm has come to rest [m/s²]."""
        self._command("servoStop", deceleration)

    def stop_j(self, deceleration: float) -> None:
        """End a move; comes back when the arm has come to rest [rad/s²].

        It says nothing about how that went: whoever calls it has to look at the arm.
        """
        self._ask("stopJ", deceleration)

    def set_payload(self, payload: Payload) -> None:
        """Declare a load, with its inertia where the controller takes one."""
        com = list(payload.com)
        if self._series >= (5, 10):
            inertia = list(payload.inertia)
            self._command("setTargetPayload", payload.mass, com, inertia)
            return
        if self._series[0] >= 5 and not any(com):
            com[2] = NO_COM_M
        self._command("setPayload", payload.mass, com)

    def end(self) -> None:
        """End the program and release the inputs; takes half a second."""
        try:
            if self.playing:
                self._ask("stopScript")
        finally:
            self._ask("disconnect")

    def _command(self, what: str, *details: object) -> None:
        if self._ask(what, *details) is not True:
            raise self._refused(what)

    def _ask(self, what: str, *details: object) -> Any:
        """Whatever its C++ throws is an error of ours."""
        try:
            return getattr(self._rtde, what)(*details)
        except ValueError as error:
            raise CommandRefused(
                f"ur-rtde does not send {what}: {error}", hint="plan within what it takes"
            ) from error
        except Exception as error:
            raise RobotConnectionError(
                f"ur-rtde has failed in {what}: {error}",
                hint="check the network, then connect again",
            ) from error

    def _refused(self, what: str) -> CommandRefused:
        runs = "its program runs" if self.playing else "its program does not run"
        return CommandRefused(
            f"the controller has not accepted {what}: {runs}",
            hint="look for a stop or a message at the teach pendant; connect again once it is gone",
        )


def _library(name: str) -> Any:
    try:
        return import_module(name).RTDEControlInterface
    except ImportError as error:
        raise PluginError(
            f"the driver ur needs ur-rtde: {error}", hint='pip install "hil[ur]"'
        ) from error


def _opened(kind: Any, address: str, frequency_hz: float, flags: int) -> Any:
    """The interface, tried again while a session that has gone still owns the inputs."""
    for wait_s in (*IN_USE_WAITS_S, None):
        try:
            return kind(address, frequency_hz, flags)
        except Exception as error:  # RuntimeError, and what its C++ throws
            if "already in use" not in str(error):
                raise _unreachable(address, str(error)) from error
            if wait_s is None:
                raise _owned(address, str(error)) from error
            time.sleep(wait_s)
    raise AssertionError


def _unreachable(address: str, said: str) -> RobotConnectionError:
    hint = "is the address right, the arm switched on and, on an e-Series, in remote control?"
    if "remote control" in said:
        hint = "switch the arm to remote control at the teach pendant"
    return RobotConnectionError(f"{address}: the controller cannot be commanded: {said}", hint=hint)


def _owned(address: str, said: str) -> RobotConnectionError:
    return RobotConnectionError(
        f"{address}: somebody else owns the inputs that move the arm: {said}",
        hint="end the other program that drives it; switch EtherNet/IP, PROFINET and MODBUS off "
        "at the teach pendant; a session that has crashed lets go after a while",
    )


def _six(q: Sequence[float]) -> list[float]:
    numbers = [float(value) for value in q]
    if len(numbers) != N:
        raise CommandRefused(
            f"a UR arm takes {N} joint angles, not {len(numbers)}",
            hint="the plan is for another arm",
        )
    return numbers


OPEN_FILES = "/proc/self/fd", "/dev/fd"

Socket: TypeAlias = tuple[int, int, int]
"""Descriptor, device, inode: a number may be given away again, all three together are not."""


class OwnLine:
    """The RTDE connections of this process that somebody opens while `opened` is entered."""

    def __init__(self) -> None:
        self._mine: frozenset[Socket] = frozenset()

    @contextlib.contextmanager
    def opened(self) -> Iterator[None]:
        """Find the connections that are opened inside the block."""
        before = _connections()
        yield
        self._mine = _connections() - before

    @property
    def kept(self) -> bool:
        """Whether all of them are still open, the very same ones; costs a microsecond."""
        return all(_is_open(each) for each in self._mine)


def _connections() -> frozenset[Socket]:
    folder = next(filter(os.path.isdir, OPEN_FILES), None)
    numbers = [int(name) for name in os.listdir(folder)] if folder else []
    return frozenset(filter(None, map(_rtde, numbers)))


def _rtde(number: int) -> Socket | None:
    """The socket behind a descriptor, if it leads to an RTDE server."""
    with contextlib.suppress(OSError):
        about = os.fstat(number)
        if stat.S_ISSOCK(about.st_mode):
            with socket.socket(fileno=os.dup(number)) as line:
                peer = line.getpeername()
            if isinstance(peer, tuple) and peer[1] == RTDE_PORT:
                return number, about.st_dev, about.st_ino
    return None


def _is_open(each: Socket) -> bool:
    try:
        now = os.fstat(each[0])
    except OSError:
        return False
    return (now.st_dev, now.st_ino) == each[1:]
