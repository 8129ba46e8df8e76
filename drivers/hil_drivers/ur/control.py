"""Wrapper of the control interface of `ur-rtde` that converts every failed call into an exception.

Commands of `ur-rtde` return `False` without a reason if the robot program does not run, during a
protective stop, and after a time-out. The stop commands of `ur-rtde` return nothing. If a vector
passed to `ur-rtde` has the wrong length, the controller reads all following values from shifted
positions.

`ur-rtde` also reconnects to the controller by itself, without notifying the caller. During a
reconnection, `ur-rtde` loses set-points although every call returns `True`. The next set-point can
also overwrite the command that stops the robot program before the program has read that command.
The class `OwnLine` detects a reconnection: it checks whether the sockets that the library opened
are unchanged.
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
"""Waiting times [s] before each new attempt to connect while another client owns the RTDE
inputs; after a crash, the dead session still owns the inputs for some seconds."""

NO_COM_M = 1e-6
"""Centre of mass [m] that replaces a zero centre of mass, because software 5.x interprets zeros
as "keep the present centre of mass"."""

N = 6


class Control:
    """Connection to the robot program that executes the commands of `ur-rtde`.

    Only one thread at a time may use the connection.

    The constructor blocks the Python interpreter: for seconds after an error, and forever if the
    controller does not answer. Create an instance only in a process that can be killed.

    Args:
        address: Address of the controller.
        frequency_hz: Number of states per second that the controller sends.
        series: Major and minor version of the controller's software.
        library: Name of the Python module that contains the class `RTDEControlInterface`.

    Raises:
        PluginError: `ur-rtde` is not installed.
        RobotConnectionError: No controller answers, or another client owns the RTDE inputs.
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
        # The force-torque input is an additional register that another client can own.
        flags = int(kind.FLAG_UPLOAD_SCRIPT) | int(kind.FLAG_NO_EXT_FT)
        self._line = OwnLine()
        with self._line.opened():
            self._rtde = _opened(kind, address, frequency_hz, flags)

    @property
    def connected(self) -> bool:
        """Whether the first connection to the controller is still open.

        A later connection to the controller does not count.
        """
        return self._line.kept

    @property
    def playing(self) -> bool:
        """Whether the robot program runs, according to the latest data of this connection."""
        return bool(self._ask("isProgramRunning"))

    @property
    def operation(self) -> tuple[int, bool]:
        """Identifier of the newest asynchronous operation, and whether the operation is running."""
        status = self._ask("getAsyncOperationProgressEx")
        return int(status.operationId()), bool(status.isAsyncOperationRunning())

    def arm_watchdog(self, least_hz: float) -> None:
        """Arm the watchdog: the program stops if commands arrive at less than `least_hz` [Hz]."""
        self._command("setWatchdog", least_hz)

    def kick(self) -> None:
        """Reset the watchdog; this call clears the command register."""
        self._command("kickWatchdog")

    def move_j(self, q: Sequence[float], speed: float, acceleration: float) -> None:
        """Start a move planned by the controller; return within a few ticks."""
        self._command("moveJ", _six(q), speed, acceleration, True)

    def servo_j(self, q: Sequence[float], lookahead_s: float, gain: float) -> None:
        """Send the next `servoj` set-point."""
        self._command("servoJ", _six(q), 0.0, 0.0, self._period_s, lookahead_s, gain)

    def servo_stop(self, deceleration: float) -> None:
        """End a `servoj` motion with a tool deceleration [m/s²]; return when the arm is at rest."""
        self._command("servoStop", deceleration)

    def stop_j(self, deceleration: float) -> None:
        """End a move with a joint deceleration [rad/s²]; return when the arm is at rest.

        The method reports no failure: the caller must check that the arm is at rest.
        """
        self._ask("stopJ", deceleration)

    def set_payload(self, payload: Payload) -> None:
        """Declare a payload to the controller, with its inertia if the software accepts one."""
        com = list(payload.com)
        if self._series >= (5, 10):
            inertia = list(payload.inertia)
            self._command("setTargetPayload", payload.mass, com, inertia)
            return
        if self._series[0] >= 5 and not any(com):
            com[2] = NO_COM_M
        self._command("setPayload", payload.mass, com)

    def end(self) -> None:
        """End the robot program and release the RTDE inputs; the call takes half a second."""
        try:
            if self.playing:
                self._ask("stopScript")
        finally:
            self._ask("disconnect")

    def _command(self, what: str, *details: object) -> None:
        if self._ask(what, *details) is not True:
            raise self._refused(what)

    def _ask(self, what: str, *details: object) -> Any:
        """Call a method of `ur-rtde` and convert every exception that the method raises.

        Raises:
            CommandRefused: The library rejects an argument (`ValueError`).
            RobotConnectionError: The library raises an exception other than `ValueError`.
        """
        try:
            return getattr(self._rtde, what)(*details)
        except ValueError as error:
            raise CommandRefused(
                f"ur-rtde rejects {what}: {error}", hint="plan within the limits of ur-rtde"
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
            hint="look for a stop or a message at the teach pendant, then connect again",
        )


def _library(name: str) -> Any:
    try:
        return import_module(name).RTDEControlInterface
    except ImportError as error:
        raise PluginError(
            f"the driver ur needs ur-rtde: {error}", hint='pip install "hil[ur]"'
        ) from error


def _opened(kind: Any, address: str, frequency_hz: float, flags: int) -> Any:
    """Create the control interface; retry while a dead session still owns the RTDE inputs."""
    for wait_s in (*IN_USE_WAITS_S, None):
        try:
            return kind(address, frequency_hz, flags)
        except Exception as error:  # RuntimeError, and exceptions of the C++ code
            if "already in use" not in str(error):
                raise _unreachable(address, str(error)) from error
            if wait_s is None:
                raise _owned(address, str(error)) from error
            time.sleep(wait_s)
    raise AssertionError


def _unreachable(address: str, said: str) -> RobotConnectionError:
    hint = (
        "check the address, that the arm is switched on and that an e-Series is in remote control"
    )
    if "remote control" in said:
        hint = "switch the arm to remote control at the teach pendant"
    return RobotConnectionError(f"{address}: the controller cannot be commanded: {said}", hint=hint)


def _owned(address: str, said: str) -> RobotConnectionError:
    return RobotConnectionError(
        f"{address}: another client owns the inputs that move the arm: {said}",
        hint="end the other program that drives it; switch EtherNet/IP, PROFINET and MODBUS off "
        "at the teach pendant; a crashed session releases the inputs after some seconds",
    )


def _six(q: Sequence[float]) -> list[float]:
    numbers = [float(value) for value in q]
    if len(numbers) != N:
        raise CommandRefused(
            f"a UR arm takes {N} joint angles, not {len(numbers)}",
            hint="plan for this arm: the plan is for a different one",
        )
    return numbers


OPEN_FILES = "/proc/self/fd", "/dev/fd"

Socket: TypeAlias = tuple[int, int, int]
"""Identity of a socket: file descriptor, device and inode.

The number of a file descriptor can be reused, whereas the combination of descriptor, device and
inode is unique.
"""


class OwnLine:
    """RTDE connections of this process that are opened inside the block `with opened()`."""

    def __init__(self) -> None:
        self._mine: frozenset[Socket] = frozenset()

    @contextlib.contextmanager
    def opened(self) -> Iterator[None]:
        """Record the connections that are opened inside the `with` block."""
        before = _connections()
        yield
        self._mine = _connections() - before

    @property
    def kept(self) -> bool:
        """Whether all recorded connections are still open and unchanged.

        The check of the connections takes a microsecond.
        """
        return all(_is_open(each) for each in self._mine)


def _connections() -> frozenset[Socket]:
    folder = next(filter(os.path.isdir, OPEN_FILES), None)
    numbers = [int(name) for name in os.listdir(folder)] if folder else []
    return frozenset(filter(None, map(_rtde, numbers)))


def _rtde(number: int) -> Socket | None:
    """Return the identity of a socket if its peer is an RTDE server, else None."""
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
