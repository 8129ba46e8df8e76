"""The drives' end of a CAN bus, and the line of each drive to it.

`end_of` opens a bus: one that the mock hosts between processes (`HubEnd`), or one of python-can
that is there already (`PythonCanEnd`). `Line` is between one drive and that end: there frames are
lost, delayed or spoilt by faults.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import struct
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import can

from hil.can import ERROR, ERROR_BUS_OFF, EXTENDED, REMOTE, Frame, Hub, runtime_folder, socket_path
from hil.core import PluginError, RobotConnectionError, SpecError

HOSTED = "hil_unix"

Send = Callable[[int, bytes], None]
"""Sends a frame (COB-ID, data) on the bus."""


def end_of(
    interface: str, channel: str, bitrate: float | None = None, wire_speed: float | None = None
) -> BusEnd:
    """The drives' end of a bus.

    Args:
        interface: `hil_unix`, or an interface of python-can.
        channel: Its channel.
        bitrate: Of the bus; on `hil_unix`, what the modelled wire has.
        wire_speed: Seconds of the modelled wire in one second; 1 when None.

    Raises:
        PluginError: There is no such bus here.
        SpecError: There is no wire that could be so fast or slow.
    """
    _require_wire(interface, bitrate, wire_speed)
    if interface == HOSTED:
        return HubEnd(channel, bitrate, wire_speed or 1.0)
    return open_end(interface, channel, bitrate)


def _require_wire(interface: str, bitrate: float | None, speed: float | None) -> None:
    if bitrate is not None and not 0 < bitrate < math.inf:
        raise SpecError(f"--bitrate is {bitrate:g}", hint="give bits per second, such as 1000000")
    if speed is None:
        return
    if interface != HOSTED or bitrate is None:
        raise SpecError(
            f"--wire-speed {speed:g}: no wire is modelled on {interface}"
            + ("" if bitrate is None else ", it has its own"),
            hint=f"give --bitrate as well, on {HOSTED}",
        )
    if not 0 < speed < math.inf:
        raise SpecError(f"--wire-speed is {speed:g}", hint="give what the master has as its pace")


Heard = Callable[[int, bytes, float], None]
"""COB-ID, data, wall time (monotonic)."""

FLAGS = EXTENDED | REMOTE | ERROR


class Readable(Protocol):
    """Something `select` can wait for."""

    def fileno(self) -> int:
        """Of a socket."""


class BusEnd(Protocol):
    """Where frames come from and go to; one thread."""

    where: str
    heard: Heard

    def send(self, can_id: int, data: bytes) -> None:
        """Put a frame on the bus."""

    def flush(self) -> None:
        """See that all which was sent goes now: what follows takes long."""

    def serve(self, timeout_s: float, others: Sequence[Readable] = ()) -> bool:
        """Handle frames; wait for one so long, or until one of `others` is readable.

        Returns whether one of them has.

        Raises:
            RobotConnectionError: The bus is gone.
        """

    def bus_off(self) -> None:
        """Put everybody else who is there now off the bus."""

    def recover(self) -> None:
        """Let the drives back onto the bus."""

    def close(self) -> None:
        """Leave the bus."""


def ignored(can_id: int, data: bytes, now_s: float) -> None:
    """Ignore a frame; the default of `heard`."""


class HubEnd:
    """A bus between processes, hosted by the mock.

    Args:
        channel: See `hil.can.channels.socket_path`.
        bitrate: Of the wire, where it is modelled [bit/s].
        speed: Seconds of that wire in one second of the clock.

    Attributes:
        where: The channel, for messages.
        heard: Called with every frame.
        hub: The bus.

    Raises:
        PluginError: The channel is taken, or cannot be made.
    """

    def __init__(self, channel: str, bitrate: float | None = None, speed: float = 1.0) -> None:
        self.hub = Hub(channel, bitrate=bitrate, speed=speed)
        self.where = f"{HOSTED} channel {channel}"
        self.heard: Heard = ignored
        self.send, self.flush = self.hub.local.send, self.hub.flush
        self.hub.local.heard = self._came

    def serve(self, timeout_s: float, others: Sequence[Readable] = ()) -> bool:
        """See `BusEnd`."""
        due_s = self.hub.due_s
        if due_s is not None:
            timeout_s = min(timeout_s, due_s - time.monotonic())
        ready, _, _ = select.select([self.hub, *others], [], [], max(0.0, timeout_s))
        self.hub.serve()
        return any(each is not self.hub for each in ready)

    def bus_off(self) -> None:
        """See `BusEnd`."""
        self.hub.bus_off()

    def recover(self) -> None:
        """See `BusEnd`."""
        self.hub.recover()

    def close(self) -> None:
        """See `BusEnd`."""
        self.hub.close()

    def _came(self, frame: Frame) -> None:
        if not frame.id & FLAGS:
            self.heard(frame.id, frame.data, time.monotonic())


def side_path(interface: str, channel: str) -> str:
    """Where the side channel of such a mock is: beside the socket of its bus.

    Args:
        interface: As of `end_of`.
        channel: Of the bus.
    """
    if interface == HOSTED:
        return os.fspath(socket_path(channel).with_suffix(".side"))
    return os.fspath(runtime_folder() / f"{interface}-{channel}.side")


BURST = 64
"""Frames taken at once before the others have their turn."""


class PythonCanEnd:
    """Any bus of python-can.

    Args:
        bus: The bus.
        where: For messages.

    Attributes:
        where, heard: See `BusEnd`.
        lost: Frames the bus would not take.
    """

    def __init__(self, bus: can.BusABC, where: str) -> None:
        self._bus, self.where = bus, where
        self.heard: Heard = ignored
        self._off = False
        self.lost = 0

    def send(self, can_id: int, data: bytes) -> None:
        """See `BusEnd`; what the bus does not take is lost, as on a wire nobody listens to."""
        if self._off:
            return
        try:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        except can.CanError as error:
            self.lost += 1
            if self.lost == 1:
                print(f"{self.where}: frame lost: {error}", file=sys.stderr)  # noqa: T201

    def flush(self) -> None:
        """See `BusEnd`; nothing is kept here."""

    def serve(self, timeout_s: float, others: Sequence[Readable] = ()) -> bool:
        """See `BusEnd`; it does not wait for `others`."""
        try:
            for _ in range(BURST):
                message = self._bus.recv(max(0.0, timeout_s))
                if message is None:
                    break
                self._came(message)
                timeout_s = 0.0
        except can.CanError as error:
            raise RobotConnectionError(
                f"{self.where} is gone: {error}", hint="is the interface still up?"
            ) from error
        return False

    def bus_off(self) -> None:
        """See `BusEnd`: an error frame, then silence both ways."""
        with contextlib.suppress(can.CanError):
            self._bus.send(can.Message(arbitration_id=ERROR_BUS_OFF, is_error_frame=True, dlc=8))
        self._off = True

    def recover(self) -> None:
        """See `BusEnd`."""
        self._off = False

    def close(self) -> None:
        """See `BusEnd`."""
        self._bus.shutdown()

    def _came(self, message: can.Message) -> None:
        data_frame = not (message.is_extended_id or message.is_remote_frame)
        if data_frame and not message.is_error_frame and not self._off:
            self.heard(message.arbitration_id, bytes(message.data), time.monotonic())


def open_end(interface: str, channel: str, bitrate: float | None) -> PythonCanEnd:
    """Join a bus.

    Raises:
        PluginError: There is no such bus here.
    """
    more: dict[str, Any] = {} if bitrate is None else {"bitrate": round(bitrate)}
    where = f"{interface} channel {channel}"
    try:
        return PythonCanEnd(can.Bus(channel=channel, interface=interface, **more), where)
    except (can.CanError, OSError, ValueError, TypeError, NotImplementedError) as error:
        raise PluginError(
            f"{where} cannot be opened: {error}",
            hint="is the interface up? hil_unix needs no hardware and no kernel module",
        ) from error


TPDOS = (0x180, 0x280, 0x380, 0x480)
SDO_ANSWER, SDO_REQUEST, HEARTBEAT = 0x580, 0x600, 0x700

DOWNLOAD, UPLOAD = 1, 2
"""Commands that begin an SDO transfer, in the three upper bits of its first byte."""

ABORT = struct.Struct("<BHBI")
ABORTED = 0x80
NOT_MAPPABLE = 0x0604_0041
MOST_BYTES = 8

Refusal = Callable[[int, int, int], int]
"""From command, index and sub-index to an abort code; 0 lets the request pass."""


class Line:
    """The connection between one drive and the bus.

    Args:
        node_id: Of the drive.
        put: Puts a frame on the bus.

    Attributes:
        sound: Whether nothing is wrong: frames pass as they are.
        cuts: Why nothing passes, either way.
        mute: Its heartbeats are lost.
        refusals: Answers to SDO requests that do not reach the drive.
        unheard: SDO requests are lost.
        late_steps: How late TPDOs come, in steps of device time.
        owed: `lost_frames` or `wrong_length` → how many of the next TPDOs suffer from it.
        by_bytes: How much too long those of the wrong length are.
    """

    def __init__(self, node_id: int, put: Send) -> None:
        self._node_id, self._put = node_id, put
        self._tpdos = frozenset(base + node_id for base in TPDOS)
        self._held: deque[tuple[int, int, bytes]] = deque()
        self._steps = 0
        self.sound = True
        self.cuts: set[str] = set()
        self.mute = self.unheard = False
        self.refusals: dict[str, Refusal] = {}
        self.late_steps = 0
        self.owed: Counter[str] = Counter()
        self.by_bytes = 0

    def look(self) -> None:
        """See whether anything is wrong, after an attribute was changed."""
        wrong = self.cuts or self.mute or self.unheard or self.refusals or self.late_steps
        self.sound = not (wrong or self._held or any(self.owed.values()))

    def send(self, can_id: int, data: bytes) -> None:
        """From the drive to the bus."""
        if self.sound:
            self._put(can_id, data)
        elif self.cuts or (self.mute and can_id == HEARTBEAT + self._node_id):
            return
        elif can_id in self._tpdos:
            self._answer(can_id, data)
        else:
            self._put(can_id, data)

    def passes(self, can_id: int, data: bytes) -> bool:
        """Return whether the drive gets a frame of the bus; a refusal is sent in its place."""
        if self.sound:
            return True
        if self.cuts:
            return False
        if can_id != SDO_REQUEST + self._node_id or len(data) != MOST_BYTES:
            return True
        return not self.unheard and not self._refused(data)

    def passed(self, steps: int) -> None:
        """Device time has passed."""
        self._steps += steps

    def release(self) -> None:
        """Send delayed frames that are due."""
        while self._held and self._held[0][0] <= self._steps:
            _, can_id, data = self._held.popleft()
            if not self.cuts:
                self._put(can_id, data)
        self.look()

    def _answer(self, can_id: int, data: bytes) -> None:
        if self._owes("lost_frames"):
            return
        if self._owes("wrong_length"):
            data = data[: max(0, len(data) + self.by_bytes)]
            data = data.ljust(min(MOST_BYTES, len(data) + max(0, self.by_bytes)), b"\x00")
        if self.late_steps or self._held:
            self._held.append((self._steps + self.late_steps, can_id, data))
        else:
            self._put(can_id, data)

    def _refused(self, data: bytes) -> bool:
        command, index, sub = data[0] >> 5, data[1] | data[2] << 8, data[3]
        for refusal in self.refusals.values():
            if code := refusal(command, index, sub):
                self._put(SDO_ANSWER + self._node_id, ABORT.pack(ABORTED, index, sub, code))
                return True
        return False

    def _owes(self, kind: str) -> bool:
        owed = self.owed[kind] > 0
        self.owed[kind] -= owed
        return owed


def refused_mapping(command: int, index: int, sub: int) -> int:
    """Refuse writes to the mapping, as a drive with fixed process data does."""
    laid_out = 0x1600 <= index <= 0x17FF or 0x1A00 <= index <= 0x1BFF
    return NOT_MAPPABLE if command == DOWNLOAD and laid_out and sub else 0


def refused_object(wanted: int, code: int) -> Refusal:
    """Every transfer of an object, or of all for 0, ends with an abort code."""

    def refusal(command: int, index: int, sub: int) -> int:
        begins = command in (DOWNLOAD, UPLOAD)
        return code if begins and wanted in (0, index) else 0

    return refusal
