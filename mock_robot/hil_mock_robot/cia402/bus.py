"""Connection of the mock drives to a CAN bus, and lines from this connection to each drive.

`end_of` opens a bus: a bus that the mock hosts between processes (`HubEnd`), or an existing bus of
python-can (`PythonCanEnd`). `Line` connects one drive to the bus; injected faults make a line lose,
delay or corrupt frames.
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
"""Function that sends a frame (COB-ID, data) on the bus."""


def end_of(
    interface: str, channel: str, bitrate: float | None = None, wire_speed: float | None = None
) -> BusEnd:
    """Open the connection of the mock drives to a bus.

    Args:
        interface: Name of the interface: `hil_unix`, or another interface of python-can.
        channel: Channel of the interface, such as `can0`.
        bitrate: Bit rate of the bus [bit/s]; on `hil_unix`, bit rate of the modelled wire.
        wire_speed: Ratio of the time of the modelled wire to wall time; None for 1.

    Raises:
        PluginError: The bus does not exist on this computer.
        SpecError: Bit rate or speed of the wire is invalid.
    """
    _require_wire(interface, bitrate, wire_speed)
    if interface == HOSTED:
        return HubEnd(channel, bitrate, wire_speed or 1.0)
    return open_end(interface, channel, bitrate)


def _require_wire(interface: str, bitrate: float | None, speed: float | None) -> None:
    if bitrate is not None and not 0 < bitrate < math.inf:
        raise SpecError(f"--bitrate is {bitrate:g}", hint="use bits per second, such as 1000000")
    if speed is None:
        return
    if interface != HOSTED or bitrate is None:
        raise SpecError(
            f"--wire-speed {speed:g}: no wire is modelled on {interface}"
            + ("" if bitrate is None else ", which has its own wire"),
            hint=f"use --wire-speed with --bitrate, on {HOSTED}",
        )
    if not 0 < speed < math.inf:
        raise SpecError(f"--wire-speed is {speed:g}", hint="use the pace of the master")


Heard = Callable[[int, bytes, float], None]
"""Callback for a received frame, with COB-ID, data and monotonic wall time [s]."""

FLAGS = EXTENDED | REMOTE | ERROR


class Readable(Protocol):
    """Object on which `select` can wait."""

    def fileno(self) -> int:
        """Return the file descriptor of the object."""


class BusEnd(Protocol):
    """Connection of the drives to a bus; used by one thread."""

    where: str
    heard: Heard

    def send(self, can_id: int, data: bytes) -> None:
        """Put a frame on the bus."""

    def flush(self) -> None:
        """Send all queued frames before a computation that takes long."""

    def serve(self, timeout_s: float, others: Sequence[Readable] = ()) -> bool:
        """Handle received frames; wait for a frame or until one of `others` is readable.

        Returns:
            Whether one of `others` is readable.

        Raises:
            RobotConnectionError: The connection to the bus is lost.
        """

    def bus_off(self) -> None:
        """Put all present participants except the drives off the bus."""

    def recover(self) -> None:
        """Put all participants back on the bus."""

    def close(self) -> None:
        """Close the connection of the drives to the bus."""


def ignored(can_id: int, data: bytes, now_s: float) -> None:
    """Ignore a frame; the default of `heard`."""


class HubEnd:
    """Bus between processes, hosted by the mock.

    Args:
        channel: Name or path of the channel, as in `hil.can.channels.socket_path`.
        bitrate: Bit rate of the modelled wire [bit/s]; None for no model.
        speed: Ratio of the time of the modelled wire to the time of the clock.

    Attributes:
        where: Name of the channel, used in messages.
        heard: Callback for every frame.
        hub: Hub of the bus.

    Raises:
        PluginError: The channel is used by another host, or cannot be created.
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
    """Return the path of the mock's side channel, beside the socket of its bus.

    Args:
        interface: Name of the interface, as in `end_of`.
        channel: Channel of the bus.
    """
    if interface == HOSTED:
        return os.fspath(socket_path(channel).with_suffix(".side"))
    return os.fspath(runtime_folder() / f"{interface}-{channel}.side")


BURST = 64
"""Maximum number of frames received before the side channel is served."""


class PythonCanEnd:
    """Connection of the mock drives to any bus of python-can.

    Args:
        bus: Bus of python-can.
        where: Name of the bus, used in messages.

    Attributes:
        where: See `BusEnd`.
        heard: See `BusEnd`.
        lost: Number of frames that the bus did not accept.
    """

    def __init__(self, bus: can.BusABC, where: str) -> None:
        self._bus, self.where = bus, where
        self.heard: Heard = ignored
        self._off = False
        self.lost = 0

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame, which is lost if the bus does not accept it (see `BusEnd`)."""
        if self._off:
            return
        try:
            self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        except can.CanError as error:
            self.lost += 1
            if self.lost == 1:
                print(f"{self.where}: frame lost: {error}", file=sys.stderr)  # noqa: T201

    def flush(self) -> None:
        """Do nothing, because this class does not queue frames (see `BusEnd`)."""

    def serve(self, timeout_s: float, others: Sequence[Readable] = ()) -> bool:
        """Handle received frames without waiting for `others` (see `BusEnd`)."""
        try:
            for _ in range(BURST):
                message = self._bus.recv(max(0.0, timeout_s))
                if message is None:
                    break
                self._came(message)
                timeout_s = 0.0
        except can.CanError as error:
            raise RobotConnectionError(
                f"{self.where} is lost: {error}", hint="check that the interface is up"
            ) from error
        return False

    def bus_off(self) -> None:
        """Send an error frame, then ignore all frames in both directions (see `BusEnd`)."""
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
    """Open a bus of python-can.

    Raises:
        PluginError: The bus does not exist on this computer.
    """
    more: dict[str, Any] = {} if bitrate is None else {"bitrate": round(bitrate)}
    where = f"{interface} channel {channel}"
    try:
        return PythonCanEnd(can.Bus(channel=channel, interface=interface, **more), where)
    except (can.CanError, OSError, ValueError, TypeError, NotImplementedError) as error:
        raise PluginError(
            f"{where} cannot be opened: {error}",
            hint="check that the interface is up; hil_unix needs no hardware and no kernel module",
        ) from error


TPDOS = (0x180, 0x280, 0x380, 0x480)
SDO_ANSWER, SDO_REQUEST, HEARTBEAT = 0x580, 0x600, 0x700

DOWNLOAD, UPLOAD = 1, 2
"""Command specifiers (upper three bits of the first byte) that begin an SDO transfer."""

ABORT = struct.Struct("<BHBI")
ABORTED = 0x80
NOT_MAPPABLE = 0x0604_0041
MOST_BYTES = 8

Refusal = Callable[[int, int, int], int]
"""Function that returns an abort code for an SDO request, or 0 to accept the request."""


class Line:
    """Connection between one drive and the bus, which injected faults can disturb.

    Args:
        node_id: Node id of the drive.
        put: Function that puts a frame on the bus.

    Attributes:
        sound: Whether no fault is active, so that frames pass unchanged.
        cuts: Set of reasons why no frame passes in either direction; empty if frames pass.
        mute: Whether the heartbeats of the drive are lost.
        refusals: Functions that answer SDO requests instead of the drive.
        unheard: Whether SDO requests to the drive are lost.
        late_steps: Delay of the drive's TPDOs in steps of device time.
        owed: Number of the next TPDOs that `lost_frames` or `wrong_length` affects, by kind.
        by_bytes: Number of bytes by which TPDOs with a wrong length are too long.
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
        """Update the attribute `sound` after a change of another attribute."""
        wrong = self.cuts or self.mute or self.unheard or self.refusals or self.late_steps
        self.sound = not (wrong or self._held or any(self.owed.values()))

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame from the drive to the bus."""
        if self.sound:
            self._put(can_id, data)
        elif self.cuts or (self.mute and can_id == HEARTBEAT + self._node_id):
            return
        elif can_id in self._tpdos:
            self._answer(can_id, data)
        else:
            self._put(can_id, data)

    def passes(self, can_id: int, data: bytes) -> bool:
        """Return whether a frame of the bus reaches the drive; send a refusal of SDO requests."""
        if self.sound:
            return True
        if self.cuts:
            return False
        if can_id != SDO_REQUEST + self._node_id or len(data) != MOST_BYTES:
            return True
        return not self.unheard and not self._refused(data)

    def passed(self, steps: int) -> None:
        """Advance device time by a number of steps."""
        self._steps += steps

    def release(self) -> None:
        """Send the delayed frames that are due."""
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
    """Return the abort code for a write to the PDO mapping of fixed process data; else 0."""
    laid_out = 0x1600 <= index <= 0x17FF or 0x1A00 <= index <= 0x1BFF
    return NOT_MAPPABLE if command == DOWNLOAD and laid_out and sub else 0


def refused_object(wanted: int, code: int) -> Refusal:
    """Return a function that refuses all transfers of an object, or of all objects for 0."""

    def refusal(command: int, index: int, sub: int) -> int:
        begins = command in (DOWNLOAD, UPLOAD)
        return code if begins and wanted in (0, index) else 0

    return refusal
