"""CANopen bus of the drives: process data, SDO, NMT and PDO configuration on one CAN bus.

`CanBus` implements the protocols of `bus` on CAN. Process data and all other parts of a cycle are
implemented in `can_cycle`, because a library that handles one frame at a time is too slow for a
cycle. SDO transfers and EDS files are handled by the library `canopen`. The library `canopen` gets
no bus and no thread: the cycle thread passes received frames that are not process data to the
library (`CanopenAcyclic.heard`), and the frames of the library are sent through the port of the
cycles (`CanBus._send`).

Two functions of CiA 301 are implemented in this module without the library `canopen`. Function 1 is
the expedited transfer to many drives at the same time with one frame per drive, so that a silent
drive does not delay the other drives (`upload_each`, `download_each`). Function 2 is the mapping of
PDOs, with reading back (`_PdoOf`): drives refuse different steps of this procedure, and error
messages must name the object and the drive.
"""

from __future__ import annotations

import contextlib
import logging
import struct
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import canopen

from hil.can import pack_frame
from hil.core import (
    CommandRefused,
    FloatArray,
    HilError,
    RobotConnectionError,
    RobotTimeout,
    SpecError,
)
from hil.robot import Finding
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.bus import MASTER_SILENCE_MS, Setting
from hil_drivers.cia402.can_channel import (
    HEARTBEAT_COB_ID,
    MOST_CYCLIC,
    SDO_ANSWER_COB_ID,
    SDO_REQUEST_COB_ID,
    SYNC_COB_ID,
    BusLog,
    LoggedPort,
    load_of,
    open_bus,
    port_of,
    rpdo_cob_id,
    tpdo_cob_id,
)
from hil_drivers.cia402.can_cycle import (
    LISTEN_INSIDE_S,
    LISTEN_S,
    CanCyclic,
    Temperatures,
    require_no_master,
)
from hil_drivers.cia402.mapping import MAPPINGS, Mapping, Pdo
from hil_drivers.cia402.objects import NOT_THERE, NOT_TO_WRITE, Aborted, Entry
from hil_drivers.cia402.options import Options

ROOM_S, ROOM_LOOK_S = 0.5, 0.002
"""Longest wait for space in the transmit queue while no cycles run, and polling period [s]."""


class CanBus:
    """Implementation of `hil_drivers.cia402.bus.Bus`; the constructor sends nothing to the drives.

    Args:
        options: Options of the station.
        names: Names of the joints, in the order of the axes, for messages.

    Attributes:
        acyclic: See `Bus`.
        cyclic: See `Bus`.
        celsius: See `Bus`.

    Raises:
        RobotConnectionError: The bus does not exist, its adapter is not connected, or another
            master is on the bus.
        PluginError: A required Python package is not installed.
        RecordingError: The log of the bus cannot be created.
        SpecError: An EDS file is unreadable.
    """

    def __init__(self, options: Options, names: Sequence[str]) -> None:
        self._options = options
        self._log: BusLog | None = None
        self._leaving = contextlib.ExitStack()
        try:
            self._join(names)
        except BaseException:
            self.close()
            raise

    def load(self) -> Finding:
        """See `Bus`."""
        options = self._options
        n, bitrate = len(options.nodes), options.bus.bitrate
        load = load_of(MAPPINGS[options.mapping], n, options.rate_hz, bitrate)
        message = f"{n} axes at {options.rate_hz:g} Hz, mapping {options.mapping}: {load}, "
        return Finding(
            "bus-load",
            load.fits,
            f"{message}{load.total.worst:.0%} with all other frames, at {bitrate / 1000:g} kbit/s",
            round(load.cyclic.worst, 4),
            MOST_CYCLIC,
            "lower rate_hz, or use a smaller mapping",
        )

    def losses(self) -> str:
        """See `Bus`."""
        return str(self.cyclic.counts)

    def flush(self) -> None:
        """See `Bus`."""
        if self._log is not None:
            self._log.flush()

    def close(self) -> None:
        """See `Bus`."""
        with contextlib.suppress(HilError):
            self._leaving.close()

    def _join(self, names: Sequence[str]) -> None:
        options = self._options
        bus = open_bus(options.bus)
        self._leaving.callback(bus.shutdown)
        if options.candump:
            self._log = BusLog(options.candump, options.bus.channel)
            self._leaving.callback(self._log.close)
        self._port = port_of(bus)
        # Another master must not drive these axes at the same time: listen before sending anything.
        port = self._port if self._log is None else LoggedPort(self._port, self._log)
        lasts_s = LISTEN_INSIDE_S if options.bus.interface == "virtual" else LISTEN_S
        require_no_master(port, options.nodes, options.master_id, lasts_s)
        self._temperatures = Temperatures(options.nodes, options.temperature_object)
        self.celsius: FloatArray = self._temperatures.celsius
        self.acyclic = CanopenAcyclic(self._send, options.nodes, names, options.eds)
        self.cyclic = CanCyclic(
            self._port,
            MAPPINGS[options.mapping],
            options.nodes,
            options.period_s,
            master_id=options.master_id,
            notify=self._heard,
            log=self._log,
            late_cycles=options.late_cycles,
        )

    def _heard(self, can_id: int, data: bytes, time_s: float) -> None:
        """Handle a frame that is not process data; called by the thread that owns the bus."""
        self._temperatures.heard(can_id, data)
        self.acyclic.heard(can_id, data, time_s)

    def _send(self, can_id: int, data: bytes) -> None:
        """Send a frame that is not process data, after waiting for space in the transmit queue."""
        frame, until = pack_frame(can_id, data), time.monotonic() + ROOM_S
        while not self._port.send(frame):
            if time.monotonic() > until:
                raise RobotConnectionError(
                    f"no frame could be sent on the bus for {ROOM_S:g} s",
                    hint="check cable, termination and bit rate, and whether any drive "
                    "acknowledges frames",
                )
            time.sleep(ROOM_LOOK_S)
        if self._log is not None:
            self._log(time.time(), frame)


Send = Callable[[int, bytes], None]

PREOPERATIONAL, OPERATIONAL = 0x7F, 0x05
_COMMANDS = {PREOPERATIONAL: 0x80, OPERATIONAL: 0x01}
_NAMES = {
    PREOPERATIONAL: "pre-operational",
    OPERATIONAL: "operational",
    0x04: "stopped",
    0: "booting",
}

ANSWER_S = 1.0
"""Longest wait for an SDO answer of a drive [s]; some drives need more than the usual 0.3 s."""
TRIES = 2
PRODUCER_MS = 100
"""Heartbeat period of the drives: value of 1017h [ms]."""
CONFIRM_S = 3.0
"""Longest wait for the heartbeat that confirms a change of a drive's NMT state [s]."""

_HEAD = struct.Struct("<BHB")
_READ, _WRITE = 0x40, 0x23
_VALUE, _VALUE_MASK = 0x42, 0xE2
_WRITTEN = 0x60
"""Command bytes of expedited SDO transfers, which contain the value (CiA 301, 7.2.4.3)."""

LOOK_S = 0.001

logging.getLogger("canopen").addHandler(logging.NullHandler())


class CanopenAcyclic:
    """Implementation of `hil_drivers.cia402.bus.Acyclic` with SDO, and NMT for the states.

    Args:
        send: Function that puts a frame (COB-ID, data) on the bus; called by any thread. Exceptions
            of `send` are passed on by all methods that can raise.
        nodes: Node ids, in the order of the axes.
        names: Names of the joints, in the order of the axes, for messages.
        eds: Paths of the drives' EDS files, one per axis; empty for no EDS files.

    Raises:
        SpecError: An EDS file is unreadable.
    """

    def __init__(
        self, send: Send, nodes: Sequence[int], names: Sequence[str], eds: Sequence[str] = ()
    ) -> None:
        self._nodes, self._names, self._eds = tuple(nodes), tuple(names), tuple(eds)
        self._send, self._network = send, _FedNetwork(send)
        self._dictionaries = [
            dictionary_of(p, n) for p, n in zip(self._eds, nodes, strict=bool(eds))
        ]
        self._remote = [self._added(axis) for axis in range(len(nodes))]
        self._locks = [threading.Lock() for _ in nodes]
        self._axes = {HEARTBEAT_COB_ID + node: axis for axis, node in enumerate(nodes)}
        self._answers = {SDO_ANSWER_COB_ID + node: axis for axis, node in enumerate(nodes)}
        # Axis, index, sub-index → list that receives the answer to an expedited request.
        self._expected: dict[tuple[int, int, int], list[bytes]] = {}
        self._state_changed = threading.Condition()
        self._states: list[int | None] = [None] * len(nodes)

    @property
    def n(self) -> int:
        """See `Acyclic`."""
        return len(self._nodes)

    def name_of(self, axis: int) -> str:
        """Return the name of an axis for messages, from the joint and the node id."""
        return f"{self._names[axis]} (node {self._nodes[axis]})"

    def heard(self, can_id: int, data: bytes, time_s: float = 0.0) -> None:
        """Handle a received frame without blocking; called by the cycle thread."""
        if can_id in self._answers and len(data) == 8:
            # No lock: a requesting thread could block the thread of the bus with it.
            _, index, sub = _HEAD.unpack_from(data)
            answer = self._expected.pop((self._answers[can_id], index, sub), None)
            if answer is None:
                self._network.notify(can_id, bytearray(data), time_s)
            else:
                answer.append(data)
        elif can_id in self._axes and data:
            with self._state_changed:
                self._states[self._axes[can_id]] = data[0]
                self._state_changed.notify_all()

    def upload(self, axis: int, entry: Entry) -> int:
        """Read an object of a drive; a value shorter than the object is sign-extended."""
        what = f"{entry} cannot be read"
        raw = self._request(axis, entry, what, lambda sdo: sdo.upload(entry.index, entry.sub))
        return int.from_bytes(raw[: entry.size], "little", signed=entry.code.islower())

    def download(self, axis: int, entry: Entry, value: int) -> None:
        """See `Acyclic`."""
        try:
            data = value.to_bytes(entry.size, "little", signed=entry.code.islower())
        except OverflowError:
            raise CommandRefused(
                f"{self.name_of(axis)}: {value} does not fit into {entry}"
            ) from None
        what = f"{entry} does not accept {value}"
        self._request(axis, entry, what, lambda sdo: sdo.download(entry.index, entry.sub, data))

    def upload_each(
        self, entry: Entry, axes: Iterable[int], within_s: float = 0.0
    ) -> dict[int, int]:
        """See `Acyclic`."""
        answers = self._request_each(_READ, entry, bytes(4), axes, within_s)
        return {
            axis: int.from_bytes(data[4 : 4 + entry.size], "little", signed=entry.code.islower())
            for axis, data in answers.items()
            if data[0] & _VALUE_MASK == _VALUE
        }

    def download_each(
        self, entry: Entry, value: int, axes: Iterable[int], within_s: float = 0.0
    ) -> list[int]:
        """See `Acyclic`."""
        data = value.to_bytes(4, "little", signed=value < 0)
        command = _WRITE | (4 - entry.size) << 2
        answers = self._request_each(command, entry, data, axes, within_s)
        return [axis for axis, answer in answers.items() if answer[0] == _WRITTEN]

    @staticmethod
    def settings(options: Options, of_drive: Sequence[Setting]) -> list[Setting]:
        """Return the settings in the order of writing: SYNC first, 1016h last; see `Acyclic`."""
        return [
            Setting(od.SYNC_COB_ID, SYNC_COB_ID, needed=False),
            Setting(od.CYCLE_PERIOD, options.period_us, needed=False),
            *of_drive,
            Setting(od.CONSUMER_HEARTBEAT, options.master_id << 16 | MASTER_SILENCE_MS),
        ]

    def unwatch(self, axes: Sequence[int], within_s: float) -> None:
        """Switch the monitoring of the master's heartbeat (1016h) off in some drives."""
        self.download_each(od.CONSUMER_HEARTBEAT, 0, axes, within_s)

    def preoperational(self) -> None:
        """Bring all drives into pre-operational and switch their heartbeats on; see `Acyclic`."""
        self._command(PREOPERATIONAL)
        for axis in range(len(self._nodes)):
            self.download(axis, od.PRODUCER_HEARTBEAT, PRODUCER_MS)
        self._confirm(PREOPERATIONAL)

    def operational(self) -> None:
        """Start the process data of all drives, confirmed by their heartbeats; see `Acyclic`."""
        self._command(OPERATIONAL)
        self._confirm(OPERATIONAL)

    def release(self) -> None:
        """See `Acyclic`."""
        self._command(PREOPERATIONAL)

    def map(self, mapping: Mapping) -> None:
        """See `Acyclic`.

        Raises:
            SpecError: According to the EDS file of a drive, the mapping is impossible.
        """
        for axis, dictionary in enumerate(self._dictionaries):
            require_mappable(dictionary, mapping, f"{self._eds[axis]}, {self.name_of(axis)}")
        for axis, node in enumerate(self._nodes):
            for received, pdos in ((True, mapping.rpdos), (False, mapping.tpdos)):
                for pdo in pdos:
                    _PdoOf(self, axis, node, pdo.number, received=received).lay_out(pdo)
                for number in ALL_PDOS - {pdo.number for pdo in pdos}:
                    _PdoOf(self, axis, node, number, received=received).silence()

    def _added(self, axis: int) -> Any:
        dictionary: Any = self._dictionaries[axis] if self._dictionaries else None
        node = canopen.RemoteNode(self._nodes[axis], dictionary)
        node.sdo.RESPONSE_TIMEOUT = ANSWER_S
        return self._network.add_node(node)

    def _request(self, axis: int, entry: Entry, what: str, ask: Callable[[Any], Any]) -> Any:
        """Send SDO requests, one at a time per node, and repeat requests without an answer."""
        self._expected.pop((axis, entry.index, entry.sub), None)  # drop an older request
        with self._locks[axis]:
            for _ in range(TRIES):
                try:
                    return ask(self._remote[axis].sdo)
                except canopen.SdoAbortedError as error:
                    raise Aborted(f"{self.name_of(axis)}: {what}", error.code) from error
                except canopen.SdoCommunicationError as error:
                    why = error
        raise RobotTimeout(
            f"{self.name_of(axis)}: {what}: no answer in {ANSWER_S:g} s, {TRIES} times ({why})",
            hint="check the power of the drive, its node id and the bit rate of the bus",
        )

    def _request_each(
        self, command: int, entry: Entry, data: bytes, axes: Iterable[int], within_s: float
    ) -> dict[int, bytes]:
        """Send one expedited SDO request to each axis and return the answers by axis.

        An answer that arrives too late is never used as the answer to a later request.
        """
        head, until = _HEAD.pack(command, entry.index, entry.sub), time.monotonic() + within_s
        answers: dict[int, list[bytes]] = {axis: [] for axis in axes}
        with contextlib.suppress(HilError):  # if one frame fails, the others fail too
            for axis, answer in answers.items():
                self._expected[axis, entry.index, entry.sub] = answer
                self._send(SDO_REQUEST_COB_ID + self._nodes[axis], head + data)
        while not all(answers.values()) and time.monotonic() < until:
            time.sleep(LOOK_S)
        return {axis: answer[0] for axis, answer in answers.items() if answer}

    def _command(self, state: int) -> None:
        with self._state_changed:
            self._states = [None] * len(self._nodes)
        for node in self._nodes:
            self._network.send_message(0, [_COMMANDS[state], node])

    def _confirm(self, state: int) -> None:
        until = time.monotonic() + CONFIRM_S
        with self._state_changed:
            while any(present != state for present in self._states):
                left_s = until - time.monotonic()
                if left_s <= 0.0:
                    raise self._not_there(state)
                self._state_changed.wait(left_s)

    def _not_there(self, state: int) -> RobotTimeout:
        late = [
            f"{self.name_of(axis)} {_state_text(present)}"
            for axis, present in enumerate(self._states)
            if present != state
        ]
        return RobotTimeout(
            f"drives are not {_NAMES[state]} after {CONFIRM_S:g} s: {'; '.join(late)}",
            hint="switch the drives off and on again; check the bus for another master",
        )


def _state_text(state: int | None) -> str:
    return "sends no heartbeat" if state is None else f"is {_NAMES.get(state, f'in state {state}')}"


class _FedNetwork(canopen.Network):
    """CANopen network object of the library `canopen` without a bus and without a thread.

    The owner of the network passes received frames to `notify`; the network passes frames to be
    sent to `send`.

    Args:
        send: Function that puts a frame (COB-ID, data) on the bus; called by any thread.
    """

    def __init__(self, send: Send) -> None:
        super().__init__()
        self._send = send

    def send_message(self, can_id: int, data: Iterable[int], remote: bool = False) -> None:
        """Send a frame of the library through the function `send`."""
        self._send(can_id, bytes(data))

    def send_periodic(self, *_: Any, **__: Any) -> Any:
        """Raise `NotImplementedError`, because only the cycles send periodic frames."""
        raise NotImplementedError("periodic frames are sent by the cyclic exchange only")


def dictionary_of(path: str, node: int) -> Any:
    """Return the `canopen.ObjectDictionary` of an EDS or DCF file.

    Args:
        path: Path of the file.
        node: Node id of the drive; COB-IDs in the file can depend on the node id.

    Raises:
        SpecError: The EDS or DCF file is unreadable.
    """
    try:
        return canopen.import_od(path, node)
    except Exception as error:  # the importer raises various errors for invalid files
        raise SpecError(
            f"{path} is not a readable EDS file: {error}", hint="use the manufacturer's EDS file"
        ) from error


def require_mappable(dictionary: Any, mapping: Mapping, where: str) -> None:
    """Raise if the EDS file lacks a mapped object, or does not allow the object in PDOs.

    Args:
        dictionary: Object dictionary from `dictionary_of`.
        mapping: PDO mapping of every axis.
        where: Text with the name of the file and of the axis, for messages.

    Raises:
        SpecError: Objects cannot be mapped; the message has one line for each of these objects.
    """
    wrong = [
        f"{where}: {entry} {why}"
        for pdo in mapping.pdos
        for entry in pdo.entries
        if (why := _why_not(dictionary, entry, received=pdo in mapping.rpdos))
    ]
    if wrong:
        raise SpecError(
            "\n".join(wrong),
            hint=f"mapping {mapping.name} needs these objects: choose another mapping, or use the "
            "EDS file of this drive",
        )


def _why_not(dictionary: Any, entry: Entry, *, received: bool) -> str:
    variable = dictionary.get_variable(entry.index, entry.sub)
    if variable is None:
        return "does not exist"
    if not variable.pdo_mappable:
        return "cannot be mapped into a PDO"
    if len(variable) != entry.bits:
        return f"has {len(variable)} bits in this file, {entry.bits} bits by CiA 402"
    if received and not variable.writable:
        return "cannot be written"
    return ""


NOT_VALID, NO_RTR = 1 << 31, 1 << 30

EVERY_SYNC = 1
"""Transmission type of all PDOs: every SYNC.

An RPDO is applied at the next SYNC; a TPDO is sampled and sent at each SYNC.
"""

ALL_PDOS = frozenset({1, 2, 3, 4})
"""PDO numbers of the predefined connection set; unused PDOs are disabled."""


_FIXED = NOT_TO_WRITE | NOT_THERE
"""Abort codes with which a drive with fixed process data refuses to change the mapping."""

_SAME_AGAIN = "switch the drive off and on; if the error remains, the mapping of the drive is fixed"


class _PdoOf:
    """Configuration objects of one PDO of one drive, written in pre-operational (CiA 301).

    All methods raise `CommandRefused` if the drive does not accept a value or reads back a
    different value, and `RobotTimeout` if the drive does not answer.
    """

    def __init__(
        self, acyclic: CanopenAcyclic, axis: int, node: int, number: int, *, received: bool
    ) -> None:
        self._acyclic, self._axis = acyclic, axis
        self._called = f"{acyclic.name_of(axis)}: {'RPDO' if received else 'TPDO'}{number}"
        communication = (0x1400 if received else 0x1800) + number - 1
        self._mapped = (0x1600 if received else 0x1A00) + number - 1
        self._cob_id = Entry("PDO COB-ID", communication, 1, "I")
        self._type = Entry("PDO transmission type", communication, 2, "B")
        self._count = Entry("number of mapped objects", self._mapped, 0, "B")
        cob_id = rpdo_cob_id(number, node) if received else tpdo_cob_id(number, node)
        self._valid = cob_id if received else cob_id | NO_RTR

    def lay_out(self, pdo: Pdo) -> None:
        """Write the mapping of the PDO and read back the mapping."""
        wanted = [entry.mapped for entry in pdo.entries]
        self._write(self._cob_id, self._valid | NOT_VALID)
        self._map(pdo, wanted)
        self._write(self._type, EVERY_SYNC)
        self._write(self._cob_id, self._valid)
        self._check(pdo, wanted)

    def silence(self) -> None:
        """Disable the PDO if the drive has a PDO of this number."""
        try:
            now = self._read(self._cob_id)
        except Aborted as error:
            if error.code in NOT_THERE:
                return
            raise
        if not now & NOT_VALID:
            self._write(self._cob_id, now | NOT_VALID)

    def _map(self, pdo: Pdo, wanted: list[int]) -> None:
        try:
            self._write(self._count, 0)
        except Aborted as error:
            if error.code in _FIXED and self._mapping() == wanted:
                return
            raise
        for sub, entry in enumerate(pdo.entries, start=1):
            self._place(sub, entry)
        self._write(self._count, len(wanted))

    def _place(self, sub: int, entry: Entry) -> None:
        try:
            self._acyclic.download(self._axis, self._slot(sub), entry.mapped)
        except Aborted as error:
            raise Aborted(
                f"{self._called} cannot carry {entry}",
                error.code,
                hint="choose another `mapping` in the station, or map the object with the "
                "manufacturer's tool",
            ) from error

    def _check(self, pdo: Pdo, wanted: list[int]) -> None:
        mapped = self._mapping()
        if mapped != wanted:
            actual = ", ".join(f"{each:08X}h" for each in mapped) or "nothing"
            expected = ", ".join(str(entry) for entry in pdo.entries)
            raise CommandRefused(
                f"{self._called} maps {actual} after {expected} was written", hint=_SAME_AGAIN
            )
        for entry, value in ((self._type, EVERY_SYNC), (self._cob_id, self._valid)):
            now = self._read(entry)
            # Not all drives store bit 30 of a COB-ID (no remote frames), and it is not needed.
            if now | NO_RTR != value | NO_RTR:
                raise CommandRefused(
                    f"{self._called}: {entry} reads {now:X}h after {value:X}h was written",
                    hint=_SAME_AGAIN,
                )

    def _mapping(self) -> list[int]:
        count = self._read(self._count)
        return [self._read(self._slot(sub)) for sub in range(1, count + 1)]

    def _slot(self, sub: int) -> Entry:
        return Entry("mapped object", self._mapped, sub, "I")

    def _read(self, entry: Entry) -> int:
        return self._acyclic.upload(self._axis, entry)

    def _write(self, entry: Entry, value: int) -> None:
        self._acyclic.download(self._axis, entry, value)
