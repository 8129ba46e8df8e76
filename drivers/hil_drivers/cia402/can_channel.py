"""One CAN channel: which it is, whether the cycles fit onto it, and raw frames in and out.

- `CanChannel` is the station's option `bus`; `open_bus` opens it with `python-can`.
- `FramePort` is how the cycles see it: 16-byte frames (`hil.can`), sent and received without
  waiting. Where `python-can` has a socket that carries raw frames (SocketCAN, a bus between
  processes), `SocketPort` uses that socket, and `sending` and `receiving` move all frames of a
  cycle by one call of the kernel; any other adapter works frame by frame (`PythonCanPort`).
- `BusLog` logs all frames as `candump -L` does; the thread that owns the bus never waits for a
  disk.
- `load_of` says how full the bus is with a mapping at a rate, and `require_room` refuses what does
  not fit. It counts the worst case of bit stuffing, because a frame that has to wait is a late
  set-point.
"""

from __future__ import annotations

import itertools
import math
import re
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from hil.can import (
    ERROR,
    EXTENDED,
    FRAME,
    FULL,
    ID_MASK,
    MOST,
    REMOTE,
    Burst,
    BusLoad,
    CandumpWriter,
    Catch,
    bits_of,
    bus_load,
    is_up,
    runtime_folder,
    socket_path,
    unpack_frame,
    up_command,
)
from hil.core import PluginError, RobotConnectionError, SpecError
from hil.robot import Finding
from hil_drivers.cia402.mapping import MAPPINGS, Mapping
from hil_drivers.option_checks import OptionChecks

if TYPE_CHECKING:
    import can

SYNC_COB_ID = 0x080
RPDO_COB_IDS = (0x200, 0x300, 0x400, 0x500)
TPDO_COB_IDS = (0x180, 0x280, 0x380, 0x480)
EMCY_COB_ID, HEARTBEAT_COB_ID = 0x080, 0x700
SDO_REQUEST_COB_ID, SDO_ANSWER_COB_ID = 0x600, 0x580
"""Predefined connection set (CiA 301): all but SYNC plus the node's id."""


def rpdo_cob_id(number: int, node: int) -> int:
    """COB-ID of an RPDO (number from 1) of a node."""
    return RPDO_COB_IDS[number - 1] + node


def tpdo_cob_id(number: int, node: int) -> int:
    """COB-ID of a TPDO (number from 1) of a node."""
    return TPDO_COB_IDS[number - 1] + node


BITRATES = (10_000, 1_000_000)
"""Classic CAN [bit/s]."""

SIMULATED_BITRATES = (10_000, 10_000_000)
"""No wire has so much: it says that the computer alone is to be the limit."""

BITRATE = 1_000_000

SIMULATED = ("hil_unix", "virtual")
"""Interfaces of python-can on which time may run faster than on the wall."""

HOSTED_WITHIN_S = 2.0
"""How long the host of a simulated bus may take to accept a connection [s]."""

_MUST = OptionChecks("cia402")


@dataclass(frozen=True, slots=True)
class CanChannel:
    """The bus of a station, its option `bus`.

    Attributes:
        interface: Of python-can.
        channel: Of that interface: `can0`, a path, a number.
        bitrate: Bits per second of classic CAN [bit/s].
    """

    interface: str
    channel: str
    bitrate: int = BITRATE

    def __str__(self) -> str:
        return f"{self.interface} {self.channel}"

    @property
    def real(self) -> bool:
        """Whether drives outside this computer may be on it."""
        vcan = self.interface == "socketcan" and re.fullmatch(r"vcan\d+", self.channel)
        return not (vcan or self.interface in SIMULATED)

    def finding(self) -> Finding:
        """Return whether the bus is switched on, as far as that can be seen without a frame.

        Nothing is sent: drives answer only a master, and another one may be at work.
        """
        if self.interface == "socketcan":
            up = is_up(self.channel)
            if up is None:
                hint = "plug the adapter in; ip link shows the interfaces there are"
                return Finding("bus", False, f"there is no interface {self.channel}", hint=hint)
            hint = up_command(self.channel, self.bitrate)
            return Finding("bus", up, f"{self} is {'up' if up else 'down'}", hint=hint)
        if self.interface == "hil_unix":
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as line:
                line.settimeout(HOSTED_WITHIN_S)
                try:
                    line.connect(str(socket_path(self.channel)))
                    hosted = True
                except OSError:
                    hosted = False
            message = f"{self} {'is hosted' if hosted else 'is not hosted by anybody'}"
            return Finding("bus", hosted, message, hint="start the mock: hil mock can")
        return Finding("bus", True, f"{self}: its adapter is seen only when it is opened")


def bus_of(value: Any) -> CanChannel:
    """The bus of a station's mapping; raises `SpecError`."""
    if value is None:
        raise SpecError(
            "the driver cia402 lacks its option bus",
            hint="say where the drives are, as in bus: {interface: socketcan, channel: can0, "
            "bitrate: 1000000}",
        )
    given = _MUST.mapping_of("bus", value)
    _MUST.require_known(given, [each.name for each in fields(CanChannel)], "bus")
    lacking = [name for name in ("interface", "channel") if given.get(name) is None]
    if lacking:
        raise _MUST.wrong_option("bus", dict(given), f"give {', '.join(lacking)} too")
    interface = _interface(given["interface"])
    range_ = SIMULATED_BITRATES if interface in SIMULATED else BITRATES
    rate = _MUST.number("bus.bitrate", given.get("bitrate", BITRATE), range_, whole=True)
    return CanChannel(interface, _channel(interface, given["channel"]), int(rate))


def _interface(value: Any) -> str:
    """Return an interface of python-can or its plug-ins; any text if it is not installed."""
    try:
        from can.interfaces import VALID_INTERFACES
    except ImportError:  # joining the bus says what to install
        return _MUST.text("bus.interface", value)
    return str(_MUST.choice("bus.interface", value, sorted(VALID_INTERFACES)))


def _channel(interface: str, value: Any) -> str:
    """Return a channel in the one form in which stations are compared."""
    channel = _MUST.text("bus.channel", str(value) if isinstance(value, int) else value)
    if ".." in Path(channel).parts:
        raise _MUST.wrong_option("bus.channel", value, "name it, or give its path without ..")
    if interface != "hil_unix":
        return channel
    try:
        path = socket_path(channel)
    except PluginError as error:
        raise _MUST.wrong_option("bus.channel", value, error.hint or error.message) from error
    return path.stem if path.parent == runtime_folder() and path.suffix == ".sock" else str(path)


STARTING_S = 10.0
"""How long a bus between processes is waited for: `hil mock can &` may still be starting [s]."""

JOIN_AGAIN_S = 0.1
_HINTS = {
    "hil_unix": "start the mock drives in another terminal first: hil mock can",
    "socketcan": "is the interface up? ip link set can0 up txqueuelen 100 type can bitrate 1000000",
}
_HINT = "is the adapter plugged in, its driver installed, and nobody else using it?"


def open_bus(bus: CanChannel, *, within_s: float = STARTING_S) -> can.BusABC:
    """One end of the bus, of `python-can`; shut it down when done.

    Args:
        bus: Which.
        within_s: How long to wait for the host of a bus between processes [s].

    Raises:
        RobotConnectionError: There is no such bus, or its adapter is not there.
        PluginError: `python-can` or the adapter's own package is not installed.
    """
    until = time.monotonic() + within_s
    while True:
        try:
            return _opened(bus)
        except RobotConnectionError:
            # An adapter that is not there now will not be there in a moment either.
            if bus.interface != "hil_unix" or time.monotonic() >= until:
                raise
        time.sleep(JOIN_AGAIN_S)


def _opened(bus: CanChannel) -> can.BusABC:
    try:
        import can

        return can.Bus(interface=bus.interface, channel=bus.channel, bitrate=bus.bitrate)
    except ImportError as error:
        raise PluginError(
            f"the bus {bus.interface} needs a package that is not installed: {error}",
            hint='pip install "hil[can]", and what python-can asks for with this adapter',
        ) from error
    except (can.CanError, OSError, ValueError, TypeError) as error:
        said = str(error).splitlines()[0]
        raise RobotConnectionError(
            f"the CAN bus {bus.interface} {bus.channel} cannot be joined: {said}",
            hint=_HINTS.get(bus.interface, _HINT),
        ) from error


class FramePort(Protocol):
    """One end of a bus."""

    def send(self, frame: bytes | memoryview) -> bool:
        """Put a frame on the bus; False when there is no room for it.

        Raises:
            RobotConnectionError: The bus is gone.
        """

    def receive(self, until_s: float) -> bytes | None:
        """The next frame; None when there is none until that `time.monotonic` (0: right now).

        Raises:
            RobotConnectionError: The bus is gone.
        """

    def wait(self, until_s: float) -> bool:
        """Whether there is something to receive, at the latest at that `time.monotonic`."""


AGAIN_S = 1e-4
"""From one try to the next where the transmit queue is full [s]."""


def send_within(port: FramePort, frame: bytes | memoryview, until_s: float) -> bool:
    """Put a frame on the bus, again and again where there is no room, until that `monotonic`.

    SocketCAN's queue has room for ten frames unless it was made longer: a cycle has more,
    and each takes 0.13 ms on the wire at 1 Mbit/s.
    """
    while not port.send(frame):
        if time.monotonic() >= until_s:
            return False
        time.sleep(AGAIN_S)
    return True


def port_of(bus: Any) -> FramePort:
    """The port of a `python-can` bus: its own socket where it has one that carries raw frames."""
    line = getattr(bus, "socket", None)
    if isinstance(line, socket.socket) and _carries_frames(line):
        return SocketPort(line, str(bus.channel_info))
    return PythonCanPort(bus)


def _carries_frames(line: socket.socket) -> bool:
    if line.family == getattr(socket, "AF_CAN", None):
        return line.type == socket.SOCK_RAW
    return line.family == socket.AF_UNIX and line.type == socket.SOCK_SEQPACKET


_NOW = socket.MSG_DONTWAIT


class SocketPort:
    """A socket whose packets are frames: `UnixBus` and SocketCAN.

    Nothing of it is changed: its other users may go on.

    Args:
        line: The socket.
        name: Of the bus, for messages.

    Attributes:
        line: As given.
    """

    def __init__(self, line: socket.socket, name: str) -> None:
        self.line = line
        self._send, self._recv = line.send, line.recv
        self._lines, self._name = [line], name

    def send(self, frame: bytes | memoryview) -> bool:
        """See `FramePort`."""
        try:
            self._send(frame, _NOW)
        except OSError as error:
            if error.errno in FULL:
                return False
            raise self.gone(error.strerror or str(error)) from error
        return True

    def receive(self, until_s: float) -> bytes | None:
        """See `FramePort`."""
        try:
            raw = self._recv(FRAME.size, _NOW)
        except BlockingIOError:
            return self.receive(0.0) if until_s and self.wait(until_s) else None
        except OSError as error:
            raise self.gone(error.strerror or str(error)) from error
        if not raw:
            raise self.gone("its host has ended, or frames were not taken fast enough")
        return raw

    def wait(self, until_s: float) -> bool:
        """See `FramePort`."""
        # select() counts in microseconds; poll and socket time-outs in milliseconds.
        wait_s = until_s - time.monotonic()
        return bool(select.select(self._lines, (), (), wait_s if wait_s > 0.0 else 0.0)[0])

    def gone(self, why: str) -> RobotConnectionError:
        """Return the error for a bus that is gone."""
        return _gone(self._name, why)


class PythonCanPort:
    """Any other `python-can` bus.

    Args:
        bus: Of `python-can`; nothing else receives from it.
    """

    def __init__(self, bus: Any) -> None:
        import can

        self._bus, self._error, self._message = bus, can.CanError, can.Message
        self._next: bytes | None = None

    def send(self, frame: bytes | memoryview) -> bool:
        """See `FramePort`."""
        can_id, length, data = FRAME.unpack(frame)
        message = self._message(
            arbitration_id=can_id & ID_MASK, is_extended_id=False, data=data[:length]
        )
        try:
            self._bus.send(message, timeout=0)
        except (self._error, OSError) as error:
            if _is_full(error):
                return False
            raise self._gone(error) from error
        return True

    def receive(self, until_s: float) -> bytes | None:
        """See `FramePort`."""
        if self._next is None:
            self.wait(until_s)
        raw, self._next = self._next, None
        return raw

    def wait(self, until_s: float) -> bool:
        """See `FramePort`."""
        if self._next is None:
            try:
                message = self._bus.recv(max(until_s - time.monotonic(), 0.0))
            except (self._error, OSError) as error:
                raise self._gone(error) from error
            self._next = None if message is None else _raw(message)
        return self._next is not None

    def _gone(self, error: Exception) -> RobotConnectionError:
        return _gone(str(self._bus.channel_info), str(error))


def _is_full(error: Exception) -> bool:
    code = getattr(error, "error_code", None) or getattr(error, "errno", None)
    return code in FULL or "full" in str(error).lower()


def _raw(message: Any) -> bytes:
    flags = EXTENDED * message.is_extended_id | REMOTE * message.is_remote_frame
    flags |= ERROR * message.is_error_frame
    data = bytes(message.data or b"")[:8]
    return FRAME.pack(message.arbitration_id | flags, min(message.dlc, 8), data)


def _gone(name: str, why: str) -> RobotConnectionError:
    return RobotConnectionError(
        f"the CAN bus ({name}) is gone: {why}",
        hint="see to adapter, cable and power (mock drives: is `hil mock can` running?), "
        "then connect again",
    )


Sending = Callable[[float], bool]


def sending(port: FramePort, frames: Sequence[bytearray | memoryview]) -> Sending:
    """Return a function that sends these frames as they then are; False if there was no room.

    It is told until when (`time.monotonic`) it may try again with what there was no room for.

    Args:
        port: To the bus.
        frames: Of 16 bytes each, writable; they stay where they are.
    """
    if isinstance(port, SocketPort):
        return _burst(port, frames)
    views = [memoryview(frame) for frame in frames]

    def one_by_one(until_s: float) -> bool:
        went = [send_within(port, view, until_s) for view in views]
        return all(went)

    return one_by_one


def _burst(port: SocketPort, frames: Sequence[bytearray | memoryview]) -> Sending:
    send, line, number = Burst(frames).send, port.line, len(frames)

    def at_once(until_s: float) -> bool:
        try:
            sent = send(line)
            while sent < number and time.monotonic() < until_s:
                time.sleep(AGAIN_S)
                sent += send(line, after=sent)
        except OSError as error:
            raise port.gone(error.strerror or str(error)) from error
        return sent == number

    return at_once


def receiving(port: FramePort) -> Callable[[], Sequence[bytes]]:
    """Return a function that returns waiting frames, at most `MOST`, without waiting for more."""
    if isinstance(port, SocketPort):
        return _catch(port)
    receive = port.receive

    def one_by_one() -> Sequence[bytes]:
        frames: list[bytes] = []
        while len(frames) < MOST and (raw := receive(0.0)) is not None:
            frames.append(raw)
        return frames

    return one_by_one


def _catch(port: SocketPort) -> Callable[[], Sequence[bytes]]:
    take, line = Catch().take, port.line

    def at_once() -> Sequence[bytes]:
        try:
            return take(line)
        except OSError as error:
            why = error.strerror or "its host has ended, or frames were not taken fast enough"
            raise port.gone(why) from error

    return at_once


Log = Callable[[float, bytes], None]


class BusLog:
    """All frames in the order in which this end saw them, as `candump -L` writes them.

    Args:
        path: File; where there is one, the first of `run-2.log`, `run-3.log`, … that is free: a log
            is one connection, and that of another is not lost.
        channel: How to call the bus in it.

    Raises:
        RecordingError: The file cannot be made; `flush` and `close` raise it as well.
    """

    def __init__(self, path: str, channel: str) -> None:
        self._writer = CandumpWriter(_free(Path(path)), "".join(channel.split()) or "can")
        self._waiting: deque[tuple[float, bytes]] = deque()

    @property
    def path(self) -> Path:
        """Where it is."""
        return self._writer.path

    def __call__(self, time_s: float, raw: bytes) -> None:
        """Keep a frame [Unix time, 16 bytes]; from any thread."""
        self._waiting.append((time_s, raw))

    def flush(self) -> None:
        """Write waiting frames; called by one thread."""
        while self._waiting:
            time_s, raw = self._waiting.popleft()
            self._writer.write(unpack_frame(raw, time_s))

    def close(self) -> None:
        """Write all and be done. Idempotent."""
        self.flush()
        self._writer.close()


def _free(path: Path) -> Path:
    others = (path.with_stem(f"{path.stem}-{number}") for number in itertools.count(2))
    return next(each for each in itertools.chain([path], others) if not each.exists())


class LoggedPort:
    """A port whose frames are logged, in the order in which this end sees them.

    Args:
        port: The port.
        log: Gets Unix time and 16 bytes.
    """

    def __init__(self, port: FramePort, log: Log) -> None:
        self._port, self._log = port, log

    def send(self, frame: bytes | memoryview) -> bool:
        """See `FramePort`."""
        sent = self._port.send(frame)
        if sent:
            self._log(time.time(), bytes(frame))
        return sent

    def receive(self, until_s: float) -> bytes | None:
        """See `FramePort`."""
        raw = self._port.receive(until_s)
        if raw is not None:
            self._log(time.time(), raw)
        return raw

    def wait(self, until_s: float) -> bool:
        """See `FramePort`."""
        return self._port.wait(until_s)


MOST_CYCLIC = 0.80
"""Share of the bus that SYNC and process data may take, at worst."""

MOST_LOAD = 0.90
"""Share that all frames may take, at worst; the rest is for EMCY, and for frames sent again."""

LEAST_HZ = 4.0
"""Slower than that (60C2h: 250 ms) nothing is led along a path."""

DRIVE_HEARTBEAT_HZ, MASTER_HEARTBEAT_HZ = 10.0, 20.0

MARKER_HZ = 10.0
"""Steps of the plan and changes of status, per second at most for long."""

SDO_HZ = 10.0
"""Requests per second beside the cycles (temperatures, error codes), each with its answer."""


@dataclass(frozen=True, slots=True)
class Load:
    """How full the bus is: 1.0 is a full one.

    Attributes:
        cyclic: By SYNC, RPDOs and TPDOs.
        beside: By heartbeats, marker and SDO.
    """

    cyclic: BusLoad
    beside: BusLoad

    @property
    def total(self) -> BusLoad:
        """By all frames."""
        return BusLoad(
            self.cyclic.nominal + self.beside.nominal, self.cyclic.worst + self.beside.worst
        )

    @property
    def fits(self) -> bool:
        """Whether the drives get their set-points in time."""
        return self.cyclic.worst <= MOST_CYCLIC and self.total.worst <= MOST_LOAD

    def __str__(self) -> str:
        return f"{self.cyclic.nominal:.0%} to {self.cyclic.worst:.0%} of the bus every cycle"


def require_room(
    name: str, n: int, rate_hz: float, bitrate: float, allowed: Iterable[str] = ()
) -> None:
    """Raise if the cycles do not fit onto the bus.

    Args:
        name: Of the mapping.
        n: Number of axes.
        rate_hz: Cycles per second.
        bitrate: Of the bus [bit/s].
        allowed: Names of mappings that would do for the purpose, for the hint.

    Raises:
        SpecError: It says how full the bus would be, and what fits.
    """
    load = load_of(MAPPINGS[name], n, rate_hz, bitrate)
    if load.fits:
        return
    raise SpecError(
        f"{n} axes at {rate_hz:g} Hz with mapping {name} do not fit into {bitrate / 1000:g} "
        f"kbit/s: {_said(load)}",
        hint=_what_fits(name, n, rate_hz, bitrate, allowed),
    )


def _said(load: Load) -> str:
    c, t = load.cyclic, load.total
    return (
        f"SYNC and process data take {c.nominal:.0%} of the bus, {c.worst:.0%} with the worst bit "
        f"stuffing ({MOST_CYCLIC:.0%} is the most), all frames {t.worst:.0%} ({MOST_LOAD:.0%})"
    )


def _what_fits(name: str, n: int, rate_hz: float, bitrate: float, allowed: Iterable[str]) -> str:
    most = most_rate_hz(MAPPINGS[name], n, bitrate)
    rate = f"rate_hz {most:.6g} is the largest that fits" if most else "no rate fits"
    smaller = [m for m in allowed if load_of(MAPPINGS[m], n, rate_hz, bitrate).fits]
    other = f"; with mapping {' or '.join(smaller)} {rate_hz:g} Hz fit" if smaller else ""
    return f"{rate}{other}; else a faster bus, or EtherCAT"


def load_of(mapping: Mapping, n: int, rate_hz: float, bitrate: float) -> Load:
    """How full a bus of `bitrate` [bit/s] is with n axes at `rate_hz` cycles per second."""
    cyclic = bus_load(cycle_lengths(mapping, n), rate_hz, bitrate)
    beats = bus_load([1], n * DRIVE_HEARTBEAT_HZ + MASTER_HEARTBEAT_HZ, bitrate)
    marker = bus_load([6], MARKER_HZ, bitrate)
    sdo = bus_load([8, 8], SDO_HZ, bitrate)
    beside = (beats, marker, sdo)
    return Load(cyclic, BusLoad(sum(b.nominal for b in beside), sum(b.worst for b in beside)))


def most_rate_hz(mapping: Mapping, n: int, bitrate: float) -> float:
    """Return the largest rate that fits and has whole milliseconds a cycle [Hz]; 0 if none does."""
    beside = load_of(mapping, n, 0.0, bitrate).beside.worst
    room = min(MOST_CYCLIC, MOST_LOAD - beside) * bitrate
    if room <= 0.0:
        return 0.0
    rate = 1000.0 / math.ceil(1000.0 * bits_of(cycle_lengths(mapping, n)).worst / room)
    return rate if rate >= LEAST_HZ else 0.0


def cycle_lengths(mapping: Mapping, n: int) -> list[int]:
    """Data bytes of the frames of one cycle: SYNC, RPDOs and TPDOs of n axes."""
    return [0, *(pdo.length for pdo in mapping.pdos for _ in range(n))]
