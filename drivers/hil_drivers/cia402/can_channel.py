"""CAN channel of a station: configuration, check of the bus load, and raw frame input and output.

- `CanChannel` is the value of the station option `bus`; `open_bus` opens the channel with
  `python-can`.
- `FramePort` is the interface that the cycles use to send and receive 16-byte frames (`hil.can`)
  without waiting. If `python-can` has a socket for raw frames (SocketCAN, a bus between processes),
  `SocketPort` uses that socket, and `sending` and `receiving` move all frames of a cycle with one
  system call. If an adapter has no socket for raw frames, `PythonCanPort` sends and receives the
  frames one by one.
- `BusLog` logs all frames in the format of `candump -L`. The thread that owns the bus never waits
  for a disk.
- `load_of` computes the bus load of a mapping at a rate, and `require_room` raises if the load is
  too high. The load includes the worst case of bit stuffing, because a frame that has to wait
  delays a set-point.
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
"""COB-IDs of the predefined connection set (CiA 301); a node adds its id to all except SYNC."""


def rpdo_cob_id(number: int, node: int) -> int:
    """Return the COB-ID of an RPDO (number from 1) of a node."""
    return RPDO_COB_IDS[number - 1] + node


def tpdo_cob_id(number: int, node: int) -> int:
    """Return the COB-ID of a TPDO (number from 1) of a node."""
    return TPDO_COB_IDS[number - 1] + node


BITRATES = (10_000, 1_000_000)
"""Valid bit rates of classic CAN: minimum and maximum [bit/s]."""

SIMULATED_BITRATES = (10_000, 10_000_000)
"""Valid bit rates of a simulated bus [bit/s].

The maximum is above the bit rate of any real bus, so that only the computer limits the cycle rate.
"""

BITRATE = 1_000_000

SIMULATED = ("hil_unix", "virtual")
"""Interfaces of python-can on which device time can run faster than wall time."""

HOSTED_WITHIN_S = 2.0
"""Longest wait for the host of a simulated bus to accept a connection [s]."""

_MUST = OptionChecks("cia402")


@dataclass(frozen=True, slots=True)
class CanChannel:
    """CAN bus of a station, as set by the station option `bus`.

    Attributes:
        interface: Name of the python-can interface.
        channel: Channel of the python-can interface: a name (`can0`), a path or a number.
        bitrate: Bit rate of classic CAN [bit/s].
    """

    interface: str
    channel: str
    bitrate: int = BITRATE

    def __str__(self) -> str:
        return f"{self.interface} {self.channel}"

    @property
    def real(self) -> bool:
        """Whether the bus can have drives outside this computer."""
        vcan = self.interface == "socketcan" and re.fullmatch(r"vcan\d+", self.channel)
        return not (vcan or self.interface in SIMULATED)

    def finding(self) -> Finding:
        """Return whether the bus is up, as far as the driver can detect without sending a frame.

        The check sends no frame: drives answer only a master, and another master is possibly
        active.
        """
        if self.interface == "socketcan":
            up = is_up(self.channel)
            if up is None:
                hint = "plug the adapter in; `ip link` lists the existing interfaces"
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
            message = f"{self} {'is hosted' if hosted else 'has no host'}"
            return Finding("bus", hosted, message, hint="start the mock: hil mock can")
        return Finding("bus", True, f"{self}: the adapter can be checked only by opening it")


def bus_of(value: Any) -> CanChannel:
    """Return the CAN bus described by the option `bus` of a station.

    Raises:
        SpecError: The option `bus` is missing, incomplete or has an invalid value.
    """
    if value is None:
        raise SpecError(
            "the driver cia402 needs the option bus",
            hint="declare the bus of the drives, as in bus: {interface: socketcan, channel: can0, "
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
    """Return a valid name of a python-can interface; any text if python-can is not installed."""
    try:
        from can.interfaces import VALID_INTERFACES
    except ImportError:  # `open_bus` reports the missing package
        return _MUST.text("bus.interface", value)
    return str(_MUST.choice("bus.interface", value, sorted(VALID_INTERFACES)))


def _channel(interface: str, value: Any) -> str:
    """Return the channel in normalized form, so that equal channels of two stations are equal."""
    channel = _MUST.text("bus.channel", str(value) if isinstance(value, int) else value)
    if ".." in Path(channel).parts:
        raise _MUST.wrong_option("bus.channel", value, "use a name, or a path without '..'")
    if interface != "hil_unix":
        return channel
    try:
        path = socket_path(channel)
    except PluginError as error:
        raise _MUST.wrong_option("bus.channel", value, error.hint or error.message) from error
    return path.stem if path.parent == runtime_folder() and path.suffix == ".sock" else str(path)


STARTING_S = 10.0
"""Waiting time for a bus between processes, because the mock is possibly still starting [s]."""

JOIN_AGAIN_S = 0.1
_HINTS = {
    "hil_unix": "start the mock drives in another terminal first: hil mock can",
    "socketcan": "is the interface up? ip link set can0 up txqueuelen 100 type can bitrate 1000000",
}
_HINT = "check that the adapter is plugged in, has its driver, and is not used by another program"


def open_bus(bus: CanChannel, *, within_s: float = STARTING_S) -> can.BusABC:
    """Open the bus with `python-can`; the caller must shut the returned bus down.

    Args:
        bus: Description of the CAN bus.
        within_s: Longest waiting time for the host of a bus between processes [s].

    Raises:
        RobotConnectionError: The bus does not exist, or its adapter is not connected.
        PluginError: `python-can` or the adapter's own package is not installed.
    """
    until = time.monotonic() + within_s
    while True:
        try:
            return _opened(bus)
        except RobotConnectionError:
            # Only a bus between processes can appear later; retrying does not help with an adapter.
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
            hint='pip install "hil[can]", and the package of python-can for this adapter',
        ) from error
    except (can.CanError, OSError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise RobotConnectionError(
            f"the CAN bus {bus.interface} {bus.channel} cannot be opened: {reason}",
            hint=_HINTS.get(bus.interface, _HINT),
        ) from error


class FramePort(Protocol):
    """Connection to a CAN bus on which frames are sent and received as 16 bytes."""

    def send(self, frame: bytes | memoryview) -> bool:
        """Put a frame on the bus; return False if the transmit queue is full.

        Raises:
            RobotConnectionError: The connection to the bus is lost.
        """

    def receive(self, until_s: float) -> bytes | None:
        """Return the next received frame; None if no frame is received before the time limit.

        Args:
            until_s: Time limit of the wait [s, `time.monotonic`]; with 0 the method does not wait.

        Raises:
            RobotConnectionError: The connection to the bus is lost.
        """

    def wait(self, until_s: float) -> bool:
        """Return whether a frame is available; wait at most until a time of `time.monotonic`."""


AGAIN_S = 1e-4
"""Time between two attempts to send while the transmit queue is full [s]."""


def send_within(port: FramePort, frame: bytes | memoryview, until_s: float) -> bool:
    """Send a frame; retry while the transmit queue is full, until a time of `time.monotonic`.

    The default transmit queue of SocketCAN holds ten frames. A cycle has more than ten frames, and
    each frame takes 0.13 ms on the wire at 1 Mbit/s.
    """
    while not port.send(frame):
        if time.monotonic() >= until_s:
            return False
        time.sleep(AGAIN_S)
    return True


def port_of(bus: Any) -> FramePort:
    """Return a `FramePort` for a `python-can` bus.

    The port uses the raw-frame socket of the bus; if the bus has no such socket, the port uses the
    methods of `python-can`.
    """
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
    """Frame port on a socket with one frame per packet, for `UnixBus` and SocketCAN.

    The port does not change the settings of the socket, so other code can use the same socket.

    Args:
        line: Socket of the bus.
        name: Name of the bus, for messages.

    Attributes:
        line: Socket of the bus.
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
            raise self.gone("its host has ended, or frames were not read fast enough")
        return raw

    def wait(self, until_s: float) -> bool:
        """See `FramePort`."""
        # select() has a resolution of microseconds; poll and socket time-outs have milliseconds.
        wait_s = until_s - time.monotonic()
        return bool(select.select(self._lines, (), (), wait_s if wait_s > 0.0 else 0.0)[0])

    def gone(self, why: str) -> RobotConnectionError:
        """Return the error that reports a lost connection to the bus."""
        return _gone(self._name, why)


class PythonCanPort:
    """Port on any `python-can` bus, one frame at a time.

    Args:
        bus: Bus of `python-can`; no other code must receive from this bus.
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
        f"the CAN bus ({name}) is lost: {why}",
        hint="check adapter, cable and power (mock drives: is `hil mock can` running?), "
        "then connect again",
    )


Sending = Callable[[float], bool]


def sending(port: FramePort, frames: Sequence[bytearray | memoryview]) -> Sending:
    """Return a function that sends a fixed list of frames with their contents at the call.

    The argument of the returned function is the time of `time.monotonic` until which the function
    retries while the transmit queue is full. The returned function returns False if the transmit
    queue was full until that time.

    Args:
        port: Port of the bus.
        frames: Writable buffers of 16 bytes, one per frame, that must keep their place in memory.
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
    """Return a function that returns at most `MOST` received frames without blocking."""
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
            why = error.strerror or "its host has ended, or frames were not read fast enough"
            raise port.gone(why) from error

    return at_once


Log = Callable[[float, bytes], None]


class BusLog:
    """Log of all sent and received frames in the format of `candump -L`.

    The order of the frames in the log is the order in which this process sent or received the
    frames.

    Args:
        path: Log file. If the file exists, the first free name of `run-2.log`, `run-3.log`, … is
            used, so that each connection has its own log and no log is overwritten.
        channel: Name of the bus in the log.

    Raises:
        RecordingError: The log file cannot be created; `flush` and `close` raise this error if they
            cannot write.
    """

    def __init__(self, path: str, channel: str) -> None:
        self._writer = CandumpWriter(_free(Path(path)), "".join(channel.split()) or "can")
        self._waiting: deque[tuple[float, bytes]] = deque()

    @property
    def path(self) -> Path:
        """Path of the log file."""
        return self._writer.path

    def __call__(self, time_s: float, raw: bytes) -> None:
        """Queue a frame for the log with its Unix time [s]; any thread can call this."""
        self._waiting.append((time_s, raw))

    def flush(self) -> None:
        """Write the queued frames to the log file; only one thread may call this."""
        while self._waiting:
            time_s, raw = self._waiting.popleft()
            self._writer.write(unpack_frame(raw, time_s))

    def close(self) -> None:
        """Write the queued frames to the log file and close the file. Idempotent."""
        self.flush()
        self._writer.close()


def _free(path: Path) -> Path:
    others = (path.with_stem(f"{path.stem}-{number}") for number in itertools.count(2))
    return next(each for each in itertools.chain([path], others) if not each.exists())


class LoggedPort:
    """Port that logs all frames in the order in which they are sent and received.

    Args:
        port: Port through which the frames are sent and received.
        log: Callback for each frame, with the Unix time [s] and the 16 bytes of the frame.
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
"""Maximum worst-case share of the bus for SYNC and process data."""

MOST_LOAD = 0.90
"""Maximum worst-case share of the bus for all frames; the rest is for EMCY and repeats."""

LEAST_HZ = 4.0
"""Minimum cycle rate [Hz], because drives cannot follow a path if 60C2h exceeds 250 ms."""

DRIVE_HEARTBEAT_HZ, MASTER_HEARTBEAT_HZ = 10.0, 20.0

MARKER_HZ = 10.0
"""Maximum sustained rate of marker frames, which announce plan steps and status changes [Hz]."""

SDO_HZ = 10.0
"""Rate of SDO requests and answers (temperatures, error codes) while the cycles run [Hz]."""


@dataclass(frozen=True, slots=True)
class Load:
    """Bus load as a share of the bit rate: 1.0 is a full bus.

    Attributes:
        cyclic: Bus load by SYNC, RPDOs and TPDOs.
        beside: Bus load by heartbeats, markers and SDOs.
    """

    cyclic: BusLoad
    beside: BusLoad

    @property
    def total(self) -> BusLoad:
        """Bus load by all frames."""
        return BusLoad(
            self.cyclic.nominal + self.beside.nominal, self.cyclic.worst + self.beside.worst
        )

    @property
    def fits(self) -> bool:
        """Whether the bus load is so low that the drives get their set-points in time."""
        return self.cyclic.worst <= MOST_CYCLIC and self.total.worst <= MOST_LOAD

    def __str__(self) -> str:
        return f"{self.cyclic.nominal:.0%} to {self.cyclic.worst:.0%} of the bus every cycle"


def require_room(
    name: str, n: int, rate_hz: float, bitrate: float, allowed: Iterable[str] = ()
) -> None:
    """Raise if the cycles exceed the capacity of the bus.

    Args:
        name: Name of the PDO mapping.
        n: Number of axes.
        rate_hz: Cycle rate [Hz].
        bitrate: Bit rate of the bus [bit/s].
        allowed: Names of alternative mappings that the hint can propose.

    Raises:
        SpecError: The bus load is too high; the message contains the bus load, and the hint
            contains a possible cycle rate.
    """
    load = load_of(MAPPINGS[name], n, rate_hz, bitrate)
    if load.fits:
        return
    raise SpecError(
        f"{n} axes at {rate_hz:g} Hz with mapping {name} do not fit into {bitrate / 1000:g} "
        f"kbit/s: {_load_text(load)}",
        hint=_what_fits(name, n, rate_hz, bitrate, allowed),
    )


def _load_text(load: Load) -> str:
    c, t = load.cyclic, load.total
    return (
        f"SYNC and process data need {c.nominal:.0%} of the bus, {c.worst:.0%} with worst-case bit "
        f"stuffing (limit {MOST_CYCLIC:.0%}), all frames {t.worst:.0%} (limit {MOST_LOAD:.0%})"
    )


def _what_fits(name: str, n: int, rate_hz: float, bitrate: float, allowed: Iterable[str]) -> str:
    most = most_rate_hz(MAPPINGS[name], n, bitrate)
    rate = f"rate_hz {most:.6g} is the largest that fits" if most else "no rate fits"
    smaller = [m for m in allowed if load_of(MAPPINGS[m], n, rate_hz, bitrate).fits]
    other = f"; {rate_hz:g} Hz fit with mapping {' or '.join(smaller)}" if smaller else ""
    return f"{rate}{other}; otherwise use a faster bus, or EtherCAT"


def load_of(mapping: Mapping, n: int, rate_hz: float, bitrate: float) -> Load:
    """Return the load of a bus of `bitrate` [bit/s] with n axes and `rate_hz` cycles per second."""
    cyclic = bus_load(cycle_lengths(mapping, n), rate_hz, bitrate)
    beats = bus_load([1], n * DRIVE_HEARTBEAT_HZ + MASTER_HEARTBEAT_HZ, bitrate)
    marker = bus_load([6], MARKER_HZ, bitrate)
    sdo = bus_load([8, 8], SDO_HZ, bitrate)
    beside = (beats, marker, sdo)
    return Load(cyclic, BusLoad(sum(b.nominal for b in beside), sum(b.worst for b in beside)))


def most_rate_hz(mapping: Mapping, n: int, bitrate: float) -> float:
    """Return the largest possible cycle rate [Hz], with a period in whole ms; 0 if none."""
    beside = load_of(mapping, n, 0.0, bitrate).beside.worst
    room = min(MOST_CYCLIC, MOST_LOAD - beside) * bitrate
    if room <= 0.0:
        return 0.0
    rate = 1000.0 / math.ceil(1000.0 * bits_of(cycle_lengths(mapping, n)).worst / room)
    return rate if rate >= LEAST_HZ else 0.0


def cycle_lengths(mapping: Mapping, n: int) -> list[int]:
    """Return the number of data bytes of each frame in one cycle: SYNC, RPDOs, TPDOs of n axes."""
    return [0, *(pdo.length for pdo in mapping.pdos for _ in range(n))]
