"""The drives over CANopen: one end of a CAN bus with all that goes over it.

`CanBus` is the field bus of `bus` for CAN. Process data and all that a cycle has to do with are our
own code (`can_cycle`): a frame at a time through a library costs more than a cycle has. Everything
else is CANopen's daily business, and `canopen` does it: SDO transfers, EDS files. That library gets
no bus and no thread of its own: the thread of the cycles hands it the frames that are no process
data (`CanopenAcyclic.heard`), and what it sends goes out through the same port (`CanBus._send`).

Two things of CiA 301 are done here without it. Expedited transfers to many drives at once, one
frame each, so that a silent drive holds nothing up (`upload_each`, `download_each`). And the
procedure by which PDOs are laid out and read back (`_PdoOf`), because drives differ in what they
refuse there, and messages have to say which object of which drive it was.
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
"""How long room in the transmit queue is waited for by what is no process data [s]."""


class CanBus:
    """Implements `hil_drivers.cia402.bus.Bus`; nothing is asked of any drive yet.

    Args:
        options: Of the station.
        names: Of the axes, for messages.

    Attributes:
        acyclic, cyclic, celsius: See `Bus`.

    Raises:
        RobotConnectionError: There is no such bus, its adapter is not there, or another master is
            on it.
        PluginError: A package is missing.
        RecordingError: The log of the bus cannot be made.
        SpecError: An EDS file cannot be read.
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
            f"{message}{load.total.worst:.0%} with all else, at {bitrate / 1000:g} kbit/s",
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
        # No other master may drive these axes: listen before anything is sent.
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
        """Handle a frame that is no process data; called by the thread that owns the bus."""
        self._temperatures.heard(can_id, data)
        self.acyclic.heard(can_id, data, time_s)

    def _send(self, can_id: int, data: bytes) -> None:
        """Send a frame that is no process data; wait for room."""
        frame, until = pack_frame(can_id, data), time.monotonic() + ROOM_S
        while not self._port.send(frame):
            if time.monotonic() > until:
                raise RobotConnectionError(
                    f"the bus has had no room for a frame for {ROOM_S:g} s",
                    hint="see to cable, termination and bit rate: does any drive acknowledge?",
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
"""How long a drive may take to answer [s]; some need longer than the usual 0.3 s."""
TRIES = 2
PRODUCER_MS = 100
"""1017h: the drives' heartbeats."""
CONFIRM_S = 3.0
"""Time within which a drive confirms an NMT state by heartbeat [s]."""

_HEAD = struct.Struct("<BHB")
_READ, _WRITE = 0x40, 0x23
_VALUE, _VALUE_MASK = 0x42, 0xE2
_WRITTEN = 0x60
"""Commands of expedited transfers (CiA 301, 7.2.4.3), which hold their value themselves."""

LOOK_S = 0.001

logging.getLogger("canopen").addHandler(logging.NullHandler())


class CanopenAcyclic:
    """Implements `hil_drivers.cia402.bus.Acyclic` by SDO, and NMT for the states.

    Args:
        send: Puts a frame (COB-ID, data) on the bus; called by any thread. What it raises comes
            out of every method here that may raise.
        nodes: Node ids, in the order of the axes.
        names: Of the axes, for messages.
        eds: Per axis, path of its EDS file; may be empty.

    Raises:
        SpecError: An EDS file cannot be read.
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
        # Axis, index, sub-index → where the answer to an expedited request goes.
        self._expected: dict[tuple[int, int, int], list[bytes]] = {}
        self._told = threading.Condition()
        self._states: list[int | None] = [None] * len(nodes)

    @property
    def n(self) -> int:
        """See `Acyclic`."""
        return len(self._nodes)

    def name_of(self, axis: int) -> str:
        """An axis for messages: joint and node."""
        return f"{self._names[axis]} (node {self._nodes[axis]})"

    def heard(self, can_id: int, data: bytes, time_s: float = 0.0) -> None:
        """A frame is on the bus; called by the cyclic thread, returns at once."""
        if can_id in self._answers and len(data) == 8:
            # No lock: a thread that asks could hold it while the bus waits.
            _, index, sub = _HEAD.unpack_from(data)
            answer = self._expected.pop((self._answers[can_id], index, sub), None)
            if answer is None:
                self._network.notify(can_id, bytearray(data), time_s)
            else:
                answer.append(data)
        elif can_id in self._axes and data:
            with self._told:
                self._states[self._axes[can_id]] = data[0]
                self._told.notify_all()

    def upload(self, axis: int, entry: Entry) -> int:
        """See `Acyclic`; a value shorter than the object is extended by its sign."""
        what = f"{entry} cannot be read"
        raw = self._asked(axis, entry, what, lambda sdo: sdo.upload(entry.index, entry.sub))
        return int.from_bytes(raw[: entry.size], "little", signed=entry.code.islower())

    def download(self, axis: int, entry: Entry, value: int) -> None:
        """See `Acyclic`."""
        try:
            data = value.to_bytes(entry.size, "little", signed=entry.code.islower())
        except OverflowError:
            raise CommandRefused(
                f"{self.name_of(axis)}: {value} does not fit into {entry}"
            ) from None
        what = f"{entry} does not take {value}"
        self._asked(axis, entry, what, lambda sdo: sdo.download(entry.index, entry.sub, data))

    def upload_each(
        self, entry: Entry, axes: Iterable[int], within_s: float = 0.0
    ) -> dict[int, int]:
        """See `Acyclic`."""
        answers = self._asked_each(_READ, entry, bytes(4), axes, within_s)
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
        answers = self._asked_each(command, entry, data, axes, within_s)
        return [axis for axis, said in answers.items() if said[0] == _WRITTEN]

    @staticmethod
    def settings(options: Options, of_drive: Sequence[Setting]) -> list[Setting]:
        """See `Acyclic`; SYNC comes first, the master's heartbeat (1016h) last."""
        return [
            Setting(od.SYNC_COB_ID, SYNC_COB_ID, needed=False),
            Setting(od.CYCLE_PERIOD, options.period_us, needed=False),
            *of_drive,
            Setting(od.CONSUMER_HEARTBEAT, options.master_id << 16 | MASTER_SILENCE_MS),
        ]

    def unwatch(self, axes: Sequence[int], within_s: float) -> None:
        """See `Acyclic`; ends the drives' watch of the master's heartbeat (1016h)."""
        self.download_each(od.CONSUMER_HEARTBEAT, 0, axes, within_s)

    def preoperational(self) -> None:
        """See `Acyclic`; the drives' heartbeats are on from then on."""
        self._command(PREOPERATIONAL)
        for axis in range(len(self._nodes)):
            self.download(axis, od.PRODUCER_HEARTBEAT, PRODUCER_MS)
        self._confirm(PREOPERATIONAL)

    def operational(self) -> None:
        """See `Acyclic`; confirmed by the drives' heartbeats."""
        self._command(OPERATIONAL)
        self._confirm(OPERATIONAL)

    def release(self) -> None:
        """See `Acyclic`."""
        self._command(PREOPERATIONAL)

    def map(self, mapping: Mapping) -> None:
        """See `Acyclic`.

        Raises:
            SpecError: An EDS file says that it cannot be.
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

    def _asked(self, axis: int, entry: Entry, what: str, ask: Callable[[Any], Any]) -> Any:
        """One request at a time per node, tried again when there is no answer."""
        self._expected.pop((axis, entry.index, entry.sub), None)  # the next answer is this one's
        with self._locks[axis]:
            for _ in range(TRIES):
                try:
                    return ask(self._remote[axis].sdo)
                except canopen.SdoAbortedError as error:
                    raise Aborted(f"{self.name_of(axis)}: {what}", error.code) from error
                except canopen.SdoCommunicationError as error:
                    why = error
        raise RobotTimeout(
            f"{self.name_of(axis)}: {what}: {TRIES} times no answer in {ANSWER_S:g} s ({why})",
            hint="is the drive powered, is its node id right, and the bit rate of the bus?",
        )

    def _asked_each(
        self, command: int, entry: Entry, data: bytes, axes: Iterable[int], within_s: float
    ) -> dict[int, bytes]:
        """Return answers by axis; late ones are not mistaken for answers to the next request."""
        head, until = _HEAD.pack(command, entry.index, entry.sub), time.monotonic() + within_s
        answers: dict[int, list[bytes]] = {axis: [] for axis in axes}
        with contextlib.suppress(HilError):  # a bus that takes no frame takes none of the others
            for axis, answer in answers.items():
                self._expected[axis, entry.index, entry.sub] = answer
                self._send(SDO_REQUEST_COB_ID + self._nodes[axis], head + data)
        while not all(answers.values()) and time.monotonic() < until:
            time.sleep(LOOK_S)
        return {axis: answer[0] for axis, answer in answers.items() if answer}

    def _command(self, state: int) -> None:
        with self._told:
            self._states = [None] * len(self._nodes)
        for node in self._nodes:
            self._network.send_message(0, [_COMMANDS[state], node])

    def _confirm(self, state: int) -> None:
        until = time.monotonic() + CONFIRM_S
        with self._told:
            while any(present != state for present in self._states):
                left_s = until - time.monotonic()
                if left_s <= 0.0:
                    raise self._not_there(state)
                self._told.wait(left_s)

    def _not_there(self, state: int) -> RobotTimeout:
        late = [
            f"{self.name_of(axis)} {_state_text(told)}"
            for axis, told in enumerate(self._states)
            if told != state
        ]
        return RobotTimeout(
            f"not {_NAMES[state]} after {CONFIRM_S:g} s: {'; '.join(late)}",
            hint="switch the drives off and on again; look for another master on the bus",
        )


def _state_text(state: int | None) -> str:
    return "sends no heartbeat" if state is None else f"is {_NAMES.get(state, f'in state {state}')}"


class _FedNetwork(canopen.Network):
    """`canopen`'s network without a bus and a thread: frames come by `notify` and go by `send`.

    Args:
        send: Puts a frame (COB-ID, data) on the bus; called by any thread.
    """

    def __init__(self, send: Send) -> None:
        super().__init__()
        self._send = send

    def send_message(self, can_id: int, data: Iterable[int], remote: bool = False) -> None:
        """Put a frame on the bus."""
        self._send(can_id, bytes(data))

    def send_periodic(self, *_: Any, **__: Any) -> Any:
        """Raise: frames in time with the cycles are sent by the cycles."""
        raise NotImplementedError("periodic frames belong to the cycles")


def dictionary_of(path: str, node: int) -> Any:
    """The `canopen.ObjectDictionary` in an EDS or DCF file.

    Args:
        path: Of the file.
        node: Node id; COB-IDs in the file may depend on it.

    Raises:
        SpecError: It cannot be read.
    """
    try:
        return canopen.import_od(path, node)
    except Exception as error:  # an importer of whatever the file may hold
        raise SpecError(
            f"{path} is no EDS file that can be read: {error}", hint="take the maker's own"
        ) from error


def require_mappable(dictionary: Any, mapping: Mapping, where: str) -> None:
    """Refuse a mapping of objects that the file does not have, or not for PDOs.

    Args:
        dictionary: What `dictionary_of` gave.
        mapping: Of every axis.
        where: Which file and which axis, for messages.

    Raises:
        SpecError: One line for each object that cannot be.
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
            hint=f"mapping {mapping.name} needs them: choose another one, or the drive's own EDS",
        )


def _why_not(dictionary: Any, entry: Entry, *, received: bool) -> str:
    variable = dictionary.get_variable(entry.index, entry.sub)
    if variable is None:
        return "is not in it"
    if not variable.pdo_mappable:
        return "cannot be mapped into a PDO"
    if len(variable) != entry.bits:
        return f"has {len(variable)} bits there, {entry.bits} by CiA 402"
    if received and not variable.writable:
        return "cannot be written"
    return ""


NOT_VALID, NO_RTR = 1 << 31, 1 << 30

EVERY_SYNC = 1
"""Transmission type: an RPDO is applied at the next SYNC, a TPDO sampled and sent at each."""

ALL_PDOS = frozenset({1, 2, 3, 4})
"""Of the predefined connection set: those that are not ours are switched off."""


_FIXED = NOT_TO_WRITE | NOT_THERE
"""Answers of drives whose mapping is as it is."""

_SAME_AGAIN = "switch the drive off and on; if it says the same again, its mapping is fixed"


class _PdoOf:
    """The objects of one PDO of one drive; changed in pre-operational, as CiA 301 has it.

    All methods raise `CommandRefused` when the drive does not take it or reads back something
    else, and `RobotTimeout` when it does not answer.
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
        """Make it as wanted, and read it back."""
        wanted = [entry.mapped for entry in pdo.entries]
        self._write(self._cob_id, self._valid | NOT_VALID)
        self._map(pdo, wanted)
        self._write(self._type, EVERY_SYNC)
        self._write(self._cob_id, self._valid)
        self._check(pdo, wanted)

    def silence(self) -> None:
        """Make it invalid, if there is such a PDO at all."""
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
                hint="choose another `mapping` in the station, or map it with the maker's tool",
            ) from error

    def _check(self, pdo: Pdo, wanted: list[int]) -> None:
        mapped = self._mapping()
        if mapped != wanted:
            actual = ", ".join(f"{each:08X}h" for each in mapped) or "nothing"
            expected = ", ".join(str(entry) for entry in pdo.entries)
            raise CommandRefused(
                f"{self._called} carries {actual} after it was given {expected}", hint=_SAME_AGAIN
            )
        for entry, value in ((self._type, EVERY_SYNC), (self._cob_id, self._valid)):
            now = self._read(entry)
            # Bit 30 of a COB-ID (no remote frames) is not kept by all drives, and not needed.
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
