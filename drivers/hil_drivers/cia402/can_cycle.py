"""One cycle over CAN: SYNC, RPDOs, the TPDOs that answer it, and what else is heard.

docs/explanation/can-cycle.md says what is on the wire when, and what is counted as what. This is
our own code because of the time that a cycle has (`benchmarks/can.py`): all commands are packed
into one block of memory and sent by one call of the kernel, all answers taken by one call and
unpacked at one go. In the order of the file:

- `CanCyclic` is the `Cyclic` of CAN; it puts `Commands` on the bus and reads `Answers`.
- `Collector` takes the answers to a SYNC. Nothing on an answer says which SYNC it belongs to, so
  where answers are owed from earlier cycles it is told late from fresh by what comes after it;
  `Debts` keeps the account.
- `NodeWatch` looks at every other frame: heartbeats, boot-ups, emergencies, errors of the bus. With
  `MasterWatch` it finds another master, and `require_no_master` listens for one before the first
  frame is sent.
- `Temperatures` reads motor temperatures from the SDO answers that pass. The driver and a replay of
  its log see the same frames, so both know a temperature from the same cycle on.
- `stop_directly` is the stop of last resort: quick stop from a process that does not own the bus.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np

from hil.can import ERROR, ERROR_BUS_OFF, ERROR_CONTROLLER, FRAME, TX_OVERFLOW, pack_frame
from hil.core import FloatArray, HilError, RobotConnectionError
from hil_drivers.cia402.axis import QUICK_STOP
from hil_drivers.cia402.bus import ByteArray, Emergency, Inputs, News, Outputs
from hil_drivers.cia402.can_channel import (
    EMCY_COB_ID,
    HEARTBEAT_COB_ID,
    RPDO_COB_IDS,
    SDO_ANSWER_COB_ID,
    SYNC_COB_ID,
    FramePort,
    Log,
    LoggedPort,
    open_bus,
    port_of,
    receiving,
    rpdo_cob_id,
    sending,
    tpdo_cob_id,
)
from hil_drivers.cia402.mapping import MAPPINGS, MOST_BYTES, Mapping, Pdo
from hil_drivers.cia402.objects import MODE_NAMES
from hil_drivers.cia402.options import Options

BEAT_S = 0.05
"""From one heartbeat of ours to the next, by device time [s]."""

PUMP_S = 0.01
"""How long one wait of `pump` takes at most [s]."""

SLACK_SHARE, MOST_SLACK_S = 0.5, 0.002
"""Share of the time for answers, and time [s], within which frames may wait for room."""

MARKER = struct.Struct("<iH")
"""What the master announces: segment and status."""

Notify = Callable[[int, bytes, float], None]
_OPERATIONAL = b"\x05"

_HEAD_BYTES = 5
"""Identifier and length: enough to know a frame by."""

_HEAD = FRAME.size - MOST_BYTES


class CanCyclic:
    """Implements `hil_drivers.cia402.bus.Cyclic` over a frame port.

    Args:
        port: Sends and receives 16-byte frames (`hil_drivers.cia402.can_channel`).
        mapping: Of every axis.
        nodes: Node ids, in the order of the axes.
        period_s: Device time of a cycle [s].
        master_id: Of our heartbeat and marker.
        notify: Gets every frame that is no process data: `canopen.Network.notify`
            (COB-ID, data, Unix time); called by the thread that calls us.
        log: Gets every frame sent and received: Unix time, 16 bytes.
        late_cycles: Cycles in a row in which the bus may have no room for our frames, or in which a
            node may answer twice.

    Attributes:
        counts: Of errors so far.
        sync_time: Unix time of the last SYNC.
        sent: (R, n, 8) RPDO bytes sent with it, as they lie in memory until the next exchange.
        answered: (T, n, 8) TPDO bytes, likewise.
    """

    def __init__(
        self,
        port: FramePort,
        mapping: Mapping,
        nodes: Sequence[int],
        period_s: float,
        *,
        master_id: int = 127,
        notify: Notify | None = None,
        log: Log | None = None,
        late_cycles: int = 3,
    ) -> None:
        self._port = port if log is None else LoggedPort(port, log)
        self._commands, self._answers = Commands(mapping, nodes), Answers(mapping, nodes)
        sync = bytearray(pack_frame(SYNC_COB_ID, b""))
        self._send_all = sending(self._port, [sync, *self._commands.frames])
        self.sent, self.answered = self._commands.data, self._answers.data
        self.counts = Counts()
        self._watch = NodeWatch(nodes, self._answers.cob_ids, self.counts, notify, late_cycles)
        self._collector = Collector(self._port, self._answers, self._watch)
        self._inputs = Inputs.none_yet(len(nodes))
        self._period_s, self._device_s, self._beat_at = period_s, 0.0, 0.0
        self._beat = pack_frame(HEARTBEAT_COB_ID + master_id, _OPERATIONAL)
        self._marker_id = tpdo_cob_id(1, master_id)
        self._announced: tuple[int, int] | None = None
        self._synced_s = self.sync_time = 0.0

    @property
    def cycle(self) -> int:
        """See `Cyclic`."""
        return self._watch.cycle

    @property
    def synced_s(self) -> float:
        """See `Cyclic`."""
        return self._synced_s

    def exchange(self, outputs: Outputs, give_up_s: float) -> Inputs:
        """See `Cyclic`; the same `Inputs` every time."""
        self._begin(outputs, give_up_s)
        self._collector.collect(self._inputs, self._synced_s, give_up_s)
        return self._inputs

    def idle(self, until_s: float) -> None:
        """See `Cyclic`."""
        self._collector.idle(until_s)

    def pump(self, until_s: float) -> None:
        """See `Cyclic`; also sends the master's heartbeat."""
        then = time.monotonic()
        while then < until_s:
            self._send_beat()
            raw = self._port.receive(min(until_s, then + PUMP_S))
            if raw is not None and raw[:_HEAD_BYTES] not in self._answers.slots:
                self._watch.heard(raw)
            now = time.monotonic()
            self._device_s += now - then
            self._watch.look(self._device_s)
            then = now

    def news(self) -> News | None:
        """See `Cyclic`."""
        return self._watch.take_news()

    def watch(self, on: bool) -> None:
        """Whether overdue heartbeats and boot-ups of the drives are news, from now on."""
        self._watch.watch(on)

    def _begin(self, outputs: Outputs, give_up_s: float) -> None:
        """Send all that is ours, SYNC as early as may be."""
        self._commands.pack(outputs)
        if (told := (outputs.segment, outputs.status)) != self._announced:
            self._announced = told
            self._send(pack_frame(self._marker_id, MARKER.pack(*told)))
        self._watch.cycle += 1
        self._synced_s = time.monotonic()
        self._device_s += self._period_s
        self.sync_time = time.time()
        slack_s = min(SLACK_SHARE * (give_up_s - self._synced_s), MOST_SLACK_S)
        if not self._send_all(self._synced_s + slack_s):
            self._watch.overflow()
        if self._device_s >= self._beat_at:
            self._send_beat()
        if self._device_s >= self._watch.look_at:
            self._watch.look(self._device_s)

    def _send(self, frame: bytes) -> None:
        if not self._port.send(frame):
            self._watch.overflow()

    def _send_beat(self) -> None:
        if self._device_s >= self._beat_at:
            self._beat_at = self._device_s + BEAT_S
            self._send(self._beat)


class Commands:
    """The RPDOs of one cycle.

    Args:
        mapping, nodes: Of the arm.

    Attributes:
        frames: Views of 16 bytes, in the order in which they are sent.
        data: (R, n, 8) the data bytes of the same.
    """

    def __init__(self, mapping: Mapping, nodes: Sequence[int]) -> None:
        pdos, n = mapping.rpdos, len(nodes)
        self._memory = bytearray(FRAME.size * n * len(pdos))
        self._heads = [
            (rpdo_cob_id(pdo.number, node), pdo.length) for pdo in pdos for node in nodes
        ]
        self._packing = struct.Struct("<" + "".join(("IB3x" + _codes(pdo)) * n for pdo in pdos))
        self._fields = [[entry.name for entry in pdo.entries] for pdo in pdos]
        # Identifiers and lengths never change: their places in the list of values are filled once.
        self._values: list[int] = []
        self._places: list[tuple[str, slice]] = []
        for number, names in enumerate(self._fields):
            width, start = len(names) + 2, len(self._values)
            for head in self._heads[number * n : (number + 1) * n]:
                self._values += [*head, *[0] * len(names)]
            for at, name in enumerate(names):
                self._places.append((name, slice(start + 2 + at, start + width * n, width)))
        self.frames = _views(self._memory)
        self.data = _data(self._memory, len(pdos), n)

    def pack(self, outputs: Outputs) -> None:
        """Write the frames anew."""
        values = self._values
        for name, places in self._places:
            values[places] = getattr(outputs, name)
        self._packing.pack_into(self._memory, 0, *values)


class Answers:
    """The TPDOs of one cycle, in the order PDO by PDO, axis by axis: their slots.

    Args:
        mapping, nodes: Of the arm.

    Attributes:
        slots: First five bytes of a frame (identifier, length) → the slot it belongs to.
        memory: Frames by slot, 16 bytes each.
        data: (T, n, 8) the data bytes of the same.
        cob_ids: Of all slots.
        all_fresh: `Inputs.fresh` when all came.
    """

    def __init__(self, mapping: Mapping, nodes: Sequence[int]) -> None:
        pdos, self._n = mapping.tpdos, len(nodes)
        self.all_fresh = [True] * self._n
        self.memory = bytearray(FRAME.size * len(nodes) * len(pdos))
        heads = [(tpdo_cob_id(pdo.number, node), pdo.length) for pdo in pdos for node in nodes]
        self.slots = {struct.pack("<IB", *head): slot for slot, head in enumerate(heads)}
        self.cob_ids = frozenset(cob_id for cob_id, _ in heads)
        self.data = _data(self.memory, len(pdos), self._n)
        self._packing = struct.Struct(
            "<" + "".join((f"{_HEAD}x" + _codes(pdo)) * self._n for pdo in pdos)
        )
        self._places: list[tuple[str, slice]] = []
        start = 0
        for pdo in pdos:
            width = len(pdo.entries)
            for at, entry in enumerate(pdo.entries):
                self._places.append((entry.name, slice(start + at, start + width * self._n, width)))
            start += width * self._n

    def __len__(self) -> int:
        return len(self.slots)

    def axis(self, slot: int) -> int:
        """Return the axis of a slot."""
        return slot % self._n

    def unpack(self, inputs: Inputs) -> None:
        """Write the values of all slots."""
        values = self._packing.unpack_from(self.memory)
        for name, places in self._places:
            getattr(inputs, name)[:] = values[places]


def _codes(pdo: Pdo) -> str:
    codes = "".join(entry.code for entry in pdo.entries)
    return f"{codes}{MOST_BYTES - pdo.length}x"


def _views(memory: bytearray) -> list[memoryview]:
    whole = memoryview(memory)
    return [whole[at : at + FRAME.size] for at in range(0, len(memory), FRAME.size)]


def _data(memory: bytearray, pdos: int, n: int) -> ByteArray:
    frames = np.frombuffer(memory, dtype=np.uint8).reshape(pdos, n, FRAME.size)
    return frames[:, :, _HEAD:]


LEAST_NAP_S = 2e-5
MOST_NAP_SHARE = 0.5

NAP_LONGER, NAP_SHORTER = 1.05, 0.99
"""A nap that was too short becomes longer, one that was not shorter: five of six are long enough,
and a single slow cycle changes little."""

SOON_TIMES, SOON_S = 2.0, 5e-4
"""An answer comes soon when it takes no longer than so many times what is usual, and this."""

USUAL_FADES = 0.995
"""Usual is what the slowest of the last few hundred cycles took, those with debts apart."""


class Collector:
    """The slots of one cycle, filled as frames come.

    Which SYNC an answer belongs to is not written on it. Where one is owed from an earlier cycle,
    the first that comes is that one if a second follows, or if answers are slow just now; it is
    this cycle's again when it came soon and nothing more has come by the next SYNC. Where several
    are owed, `Debts` is strict.

    Args:
        port: Where frames come from.
        answers: The slots.
        watch: Takes everything else, and counts.
    """

    def __init__(self, port: FramePort, answers: Answers, watch: NodeWatch) -> None:
        self._port, self._answers, self._watch = port, answers, watch
        self._take = receiving(port)
        self._counts, self._slot_of = watch.counts, answers.slots.get
        self._came: list[bytes | None] = [None] * len(answers)
        self._none_came: list[bytes | None] = [None] * len(answers)
        self._debts = Debts()
        self._nap_s = self._usual_s = 0.0
        self._doubtful, self._late_then = False, 0
        self._late_axes: set[int] = set()

    def collect(self, inputs: Inputs, synced_s: float, give_up_s: float) -> None:
        """Fill `inputs` with the answers to a SYNC.

        Args:
            inputs: To be filled in; values without a fresh answer stay.
            synced_s: When it was sent (`time.monotonic`).
            give_up_s: When to be done with waiting.
        """
        if self._doubtful and self._counts.late == self._late_then:
            self._debts.forget_lost()  # nothing has come since: it was lost after all
        self._doubtful = False
        self._nap(synced_s, give_up_s)
        all_came = self._fill(synced_s, give_up_s)
        if self._debts:
            all_came = self._settle(synced_s, give_up_s, all_came)
        inputs.fresh[:] = self._answers.all_fresh
        if not all_came:
            self._miss(inputs)
            self._late_then = self._counts.late
            inputs.late[:] = [axis in self._late_axes for axis in range(len(inputs.late))]
        self._late_axes.clear()
        self._answers.memory[:] = b"".join(self._came)  # type: ignore[arg-type]
        self._answers.unpack(inputs)

    def idle(self, until_s: float) -> None:
        """Handle frames between two cycles, until that time of `time.monotonic`."""
        port = self._port
        while port.wait(until_s):
            raw = port.receive(0.0)
            if raw is None:
                continue
            slot = self._slot_of(raw[:_HEAD_BYTES])
            if slot is None:
                self._watch.heard(raw)
            else:
                self._debts.came_between(slot)
                self._was_owed(slot)

    def _nap(self, synced_s: float, give_up_s: float) -> None:
        """Sleep while answers come: one wake-up for all of them, not one for each."""
        now = time.monotonic()
        nap_s = synced_s + min(self._nap_s, MOST_NAP_SHARE * (give_up_s - synced_s)) - now
        if nap_s > LEAST_NAP_S:
            time.sleep(nap_s)

    def _fill(self, synced_s: float, give_up_s: float) -> bool:
        """Take one answer for every slot; whether all came."""
        came, take, slot_of = self._came, self._take, self._slot_of
        came[:] = self._none_came
        left, takes = len(came), 0
        while left:
            frames, takes = take(), takes + 1
            if not frames and not self._port.wait(give_up_s):
                return False
            for raw in frames:
                slot = slot_of(raw[:_HEAD_BYTES])
                if slot is None:
                    self._watch.heard(raw)
                elif came[slot] is None:
                    came[slot] = raw
                    left -= 1
                    if self._debts.watched:
                        self._debts.came(slot, time.monotonic())
                else:
                    self._second(slot, raw)
        if not self._debts:  # else they may be older than they seem
            self._learn(takes > 1, synced_s)
        return True

    def _learn(self, too_short: bool, synced_s: float) -> None:
        """How long answers take, and how long a nap is to be."""
        self._usual_s = max(time.monotonic() - synced_s, USUAL_FADES * self._usual_s)
        if too_short:
            self._nap_s = self._nap_s * NAP_LONGER or time.monotonic() - synced_s
        else:
            self._nap_s *= NAP_SHORTER

    def _settle(self, synced_s: float, give_up_s: float, all_came: bool) -> bool:
        """Whether the answers are those to this SYNC, where earlier ones are owed.

        The second is waited for as long as there is time. When none comes, the owed one was lost
        if this one came as soon as answers usually do, and if others had answered before: when
        none had, all are slow rather than lost.
        """
        debts, soon_s = self._debts, synced_s + SOON_TIMES * self._usual_s + SOON_S
        if all_came:
            soon, none_answered = time.monotonic() <= soon_s, len(debts) == len(self._came)
            self._take_more(give_up_s)
            if soon and not none_answered:
                debts.forget_lost()
            self._doubtful = soon and bool(debts)
        if debts.watched:
            debts.confirm(soon_s)
        return all_came and not debts

    def _take_more(self, give_up_s: float) -> None:
        """Handle frames as long as answers are missing."""
        while self._debts:
            raw = self._port.receive(give_up_s)
            if raw is None:
                break
            slot = self._slot_of(raw[:_HEAD_BYTES])
            if slot is None:
                self._watch.heard(raw)
            else:
                self._second(slot, raw)

    def _second(self, slot: int, raw: bytes) -> None:
        """Another frame for a slot that has one: the newest is that of this cycle."""
        if self._debts.watched:
            self._debts.came(slot, time.monotonic())
        self._was_owed(slot)
        self._came[slot] = raw

    def _was_owed(self, slot: int) -> None:
        """Count a frame as late if one was owed, else as doubled."""
        if self._debts.pay(slot):
            self._is_late(slot)
        else:
            self._watch.doubled(self._answers.axis(slot))

    def _is_late(self, slot: int) -> None:
        self._counts.late += 1
        self._late_axes.add(self._answers.axis(slot))

    def _miss(self, inputs: Inputs) -> None:
        """Fill empty slots with earlier data, and note which answers are missing."""
        answers, came = self._answers, self._came
        owed = set(self._debts.slots)
        for slot, raw in enumerate(came):
            if raw is not None and slot not in owed:
                continue
            if raw is None:
                self._debts.owe(slot)
            else:  # that of an earlier cycle: one is paid, this one is owed
                self._is_late(slot)
            self._counts.missing += 1
            came[slot] = bytes(answers.memory[slot * FRAME.size : (slot + 1) * FRAME.size])
            inputs.fresh[answers.axis(slot)] = False


CONFIRMED = 5
"""Cycles in a row with one answer each, soon after the SYNC, that show that the rest was lost."""

STRICT_FROM = 2
"""Answers owed from which on nothing is taken for fresh before they have come or are shown lost."""


class Debts:
    """Answers that had not come when their cycle was over.

    One that is owed alone may be a frame that was lost: the next cycle shows it. Where several are
    owed a drive or a computer stood still, and the first that come belong to older SYNCs. Such a
    slot is strict until all have come, or until its drive has answered `CONFIRMED` times in a row
    as if nothing were left.
    """

    def __init__(self) -> None:
        self._owed: dict[int, int] = {}
        self._single: dict[int, int] = {}
        self._came: dict[int, tuple[int, float]] = {}

    def __bool__(self) -> bool:
        return bool(self._owed)

    def __len__(self) -> int:
        return len(self._owed)

    @property
    def slots(self) -> list[int]:
        """Slots that owe answers."""
        return list(self._owed)

    @property
    def watched(self) -> bool:
        """Whether any slot is strict: all its frames are passed to `came`."""
        return bool(self._single)

    def owe(self, slot: int) -> None:
        """The answer to the SYNC of a cycle that is over has not come."""
        owed = self._owed[slot] = self._owed.get(slot, 0) + 1
        if owed >= STRICT_FROM:
            self._single.setdefault(slot, 0)

    def pay(self, slot: int) -> bool:
        """An answer of an earlier cycle has come; False when none was owed."""
        owed = self._owed.pop(slot, 0)
        if owed > 1:
            self._owed[slot] = owed - 1
        elif slot in self._single:
            del self._single[slot]
        return owed > 0

    def forget_lost(self) -> None:
        """Those that are owed alone were lost."""
        for slot in self.slots:
            if slot not in self._single:
                del self._owed[slot]

    def came(self, slot: int, now_s: float) -> None:
        """A frame has come while the answers to a SYNC were waited for."""
        number, first_s = self._came.get(slot, (0, now_s))
        self._came[slot] = number + 1, first_s

    def came_between(self, slot: int) -> None:
        """A frame has come when its cycle was over: answers are late, none of them was lost."""
        if slot in self._single:
            self._single[slot] = 0

    def confirm(self, soon_s: float) -> None:
        """A cycle is over: strict slots that answered it once, and soon, may have lost the rest.

        Args:
            soon_s: Until when answers usually come, in the time of `came`.
        """
        for slot, in_a_row in list(self._single.items()):
            number, first_s = self._came.get(slot, (0, 0.0))
            once = number == 1 and first_s <= soon_s
            self._single[slot] = in_a_row + 1 if once else 0
            if self._single[slot] >= CONFIRMED:
                del self._single[slot], self._owed[slot]
        self._came.clear()


SILENCE_S = 0.3
"""Device time after which a heartbeat of 100 ms is overdue [s]."""

LOOK_S = 0.01
RX_OVERFLOW = 0x01
_BOOT_UP = 0


class NodeWatch:
    """Handles frames that are no process data, and overdue heartbeats.

    Args:
        nodes: Of our drives.
        tpdos: COB-IDs of their process data.
        counts: Where malformed and foreign frames and overflows are counted.
        notify: Gets every frame but the bus' own errors.
        late_cycles: Cycles in a row in which the bus may have no room for our frames, or in which a
            node may answer twice.

    Attributes:
        counts: As given.
        cycle: The present one, written by the exchange.
        look_at: Device time at which `look` is to be called again [s].
    """

    def __init__(
        self,
        nodes: Sequence[int],
        tpdos: Container[int],
        counts: Counts,
        notify: Notify | None,
        late_cycles: int = 3,
    ) -> None:
        self._tpdos, self.counts, self._notify = tpdos, counts, notify
        self._heartbeats = {HEARTBEAT_COB_ID + node: axis for axis, node in enumerate(nodes)}
        self._emergencies = {EMCY_COB_ID + node: axis for axis, node in enumerate(nodes)}
        self._answers = frozenset(SDO_ANSWER_COB_ID + node for node in nodes)
        self._news, self._watching = News(), False
        self._heard_s = [0.0] * len(nodes)
        self._silent: set[int] = set()
        self._device_s = self.look_at = 0.0
        self.cycle = -1
        self._nodes, self._late_cycles = tuple(nodes), late_cycles
        self._overflowing, self._doubling = InARow(), [InARow() for _ in nodes]
        self._masters = MasterWatch(nodes)

    def watch(self, on: bool) -> None:
        """Whether overdue heartbeats and boot-ups are news, from now on."""
        self._watching = on
        self._heard_s = [self._device_s] * len(self._heard_s)
        self._silent.clear()

    def take_news(self) -> News | None:
        """Return news since the last call; None if there are none."""
        if not self._news.any:
            return None
        news, self._news = self._news, News()
        return news

    def heard(self, raw: bytes) -> None:
        """A frame that is no process data of ours as mapped."""
        can_id, length, data = FRAME.unpack(raw)
        if can_id & ERROR:
            self._bus_error(can_id, data)
            return
        if can_id in self._heartbeats:
            self._heartbeat(self._heartbeats[can_id], data)
        elif can_id in self._emergencies:
            self._emergency(self._emergencies[can_id], data)
        elif can_id in self._tpdos:
            self.counts.malformed += 1
        elif can_id not in self._answers:
            self.counts.foreign += 1
            self._foreign(can_id, data)
        if self._notify is not None:
            self._notify(can_id, data[:length], time.time())

    def look(self, device_s: float) -> None:
        """Note axes whose heartbeat is overdue, at a device time [s]."""
        self._device_s, self.look_at = device_s, device_s + LOOK_S
        if not self._watching:
            return
        for axis, heard_s in enumerate(self._heard_s):
            if device_s - heard_s > SILENCE_S and axis not in self._silent:
                self._silent.add(axis)
                self._news.silent.append(axis)

    def overflow(self) -> None:
        """Count a frame of the present cycle for which there was no room."""
        self.counts.overflows += 1
        most = self._late_cycles
        if self._overflowing.in_cycle(self.cycle) > most:
            self._news.bus_error = (
                f"the bus had no room for our frames in more than {most} cycles in a row"
            )

    def doubled(self, axis: int) -> None:
        """An answer of an axis came twice in the present cycle, and none was owed."""
        self.counts.doubled += 1
        if self._doubling[axis].in_cycle(self.cycle) > self._late_cycles:
            self._tell(f"two nodes answer as node {self._nodes[axis]}")

    def _foreign(self, can_id: int, data: bytes) -> None:
        if problem := self._masters.heard(can_id, data):
            self._tell(problem)

    def _tell(self, problem: str) -> None:
        """The first of a cycle, while the arm is driven."""
        if self._watching and not self._news.bus_error:
            self._news.bus_error = problem

    def _heartbeat(self, axis: int, data: bytes) -> None:
        self._heard_s[axis] = self._device_s
        self._silent.discard(axis)
        if self._watching and data[0] == _BOOT_UP:
            self._news.booted.append(axis)

    def _emergency(self, axis: int, data: bytes) -> None:
        code = int.from_bytes(data[:2], "little")
        self._news.emergencies.append(Emergency(axis, code, data[2], data[3:8]))

    def _bus_error(self, can_id: int, data: bytes) -> None:
        if can_id & ERROR_BUS_OFF:
            self._news.bus_error = "our CAN controller has gone off the bus (bus-off)"
        elif can_id & ERROR_CONTROLLER and data[1] & (TX_OVERFLOW | RX_OVERFLOW):
            self.overflow()


@dataclass(slots=True)
class Counts:
    """Counts of errors on the bus; `str` has them in words, empty if there are none.

    Attributes:
        missing: TPDOs that had not come when their cycle was over.
        late: TPDOs of them that came after the next SYNC.
        doubled: TPDOs that came twice in a cycle.
        malformed: TPDOs of another length than mapped.
        foreign: Frames that none of our drives sends.
        overflows: Frames for which there was no room in a transmit or receive queue.
    """

    missing: int = 0
    late: int = 0
    doubled: int = 0
    malformed: int = 0
    foreign: int = 0
    overflows: int = 0

    def __str__(self) -> str:
        counts = (
            ("answers (TPDOs) missing", self.missing),
            ("of them late", self.late),
            ("doubled", self.doubled),
            ("of another length than mapped", self.malformed),
            ("frames of nodes that are not ours", self.foreign),
            ("without room in a queue", self.overflows),
        )
        return ", ".join(f"{number} {what}" for what, number in counts if number)


class InARow:
    """Counts cycles in a row in which something happens."""

    def __init__(self) -> None:
        self._last, self._number = -2, 0

    def in_cycle(self, cycle: int) -> int:
        """It happens in a cycle, perhaps again; in how many in a row by now."""
        if cycle != self._last:
            self._number = self._number + 1 if cycle == self._last + 1 else 1
            self._last = cycle
        return self._number


LISTEN_S = 0.3
"""Wall time for which the bus is listened to before anything is sent [s]."""

LISTEN_INSIDE_S = 0.03
"""The same on a bus that reaches no other process [s]."""

ALLOWED_S = 0.05
"""Wall time for which the SYNC of a quick stop from outside may come [s]."""

ANOTHER = "another master is on the bus"
HINT = "end it first: another hil, a PLC, a drive maker's tool, a drive that produces SYNC (1005h)"


def require_no_master(
    port: FramePort, nodes: Sequence[int], master_id: int, lasts_s: float = LISTEN_S
) -> None:
    """Listen, and send nothing.

    Args:
        port: To the bus.
        nodes: Of our drives.
        master_id: Of our heartbeat.
        lasts_s: Wall time [s].

    Raises:
        RobotConnectionError: Another master commands these drives, or uses our node id.
    """
    beat = HEARTBEAT_COB_ID + master_id
    names = commanding(nodes) | {beat: f"the heartbeat of node {master_id}, our own ({beat:03X}h)"}
    heard: dict[str, int] = {}
    until_s = time.monotonic() + lasts_s
    while time.monotonic() < until_s:
        raw = port.receive(until_s)
        if raw is not None and (name := names.get(FRAME.unpack(raw)[0])):
            heard[name] = heard.get(name, 0) + 1
    if heard:
        told = ", ".join(f"{number} × {name}" for name, number in heard.items())
        raise RobotConnectionError(f"{ANOTHER}: {told} within {lasts_s:g} s", hint=HINT)


class MasterWatch:
    """Notices frames of another master while the arm is driven.

    A stop from outside (`stop_directly`) is quick stops and a SYNC; that is no
    second master, and the axes themselves tell that they stop.

    Args:
        nodes: Of our drives.
    """

    def __init__(self, nodes: Sequence[int]) -> None:
        self._names = commanding(nodes)
        self._allowed_until_s = 0.0

    def heard(self, can_id: int, data: bytes) -> str:
        """Return what is wrong with a frame of another sender; empty if nothing is."""
        name = self._names.get(can_id)
        if name is None:
            return ""
        now = time.monotonic()
        if can_id != SYNC_COB_ID and int.from_bytes(data[:2], "little") == QUICK_STOP:
            self._allowed_until_s = now + ALLOWED_S
            return ""
        if can_id == SYNC_COB_ID and now < self._allowed_until_s:
            return ""
        return f"{ANOTHER}: {name} was not sent by us"


def commanding(nodes: Sequence[int]) -> dict[int, str]:
    """COB-ID of SYNC and of all commands to these nodes → how to call it."""
    names = {SYNC_COB_ID: f"SYNC ({SYNC_COB_ID:03X}h)"}
    for number in range(1, len(RPDO_COB_IDS) + 1):
        for node in nodes:
            can_id = rpdo_cob_id(number, node)
            names[can_id] = f"RPDO{number} of node {node} ({can_id:03X}h)"
    return names


CELSIUS_PER_COUNT = 0.1

_EXPEDITED, _EXPEDITED_MASK = 0x42, 0xE2
"""First byte of an SDO answer to an upload that holds the value itself (CiA 301, 7.2.4.3.5)."""

_ANSWER = struct.Struct("<BHBh")


class Temperatures:
    """Listens for one object.

    Args:
        nodes: Node ids, in the order of the axes.
        index: Of the object, INTEGER16 in 0.1 °C; 0 where there is none.

    Attributes:
        celsius: (n,) as last heard [°C], NaN before.
    """

    def __init__(self, nodes: Sequence[int], index: int) -> None:
        self._axes = {SDO_ANSWER_COB_ID + node: axis for axis, node in enumerate(nodes)}
        self._index = index
        self.celsius: FloatArray = np.full(len(nodes), np.nan)

    def heard(self, can_id: int, data: bytes) -> None:
        """Handle a frame; only answers with that object matter."""
        axis = self._axes.get(can_id)
        if axis is None or not self._index or len(data) < _ANSWER.size:
            return
        command, index, sub, count = _ANSWER.unpack_from(data)
        if command & _EXPEDITED_MASK == _EXPEDITED and (index, sub) == (self._index, 0):
            self.celsius[axis] = count * CELSIUS_PER_COUNT


STOP_TIMES, STOP_APART_S = 3, 0.002
"""How often quick stop is sent, and how far apart [s]: a frame may be lost, a queue full for a
moment, and who commands at the same time is overruled."""


def stop_directly(options: Options) -> bool:
    """Stop all axes without the process that drives them; from any thread, within milliseconds.

    A drive that has got one quick stop brakes and switches itself off (605Ah = 2); set-points that
    another master still sends do not take it back.

    Args:
        options: Of the arm: its bus and nodes, and what its process data look like.

    Returns:
        Whether it is on the bus, at least once as a whole. An adapter that only one program can
        open is still taken while the process that drives the arm lives.
    """
    went = False
    try:
        bus = open_bus(options.bus, within_s=0.0)
        with ExitStack() as leaving:
            leaving.callback(bus.shutdown)
            port = port_of(bus)
            for again in range(STOP_TIMES):
                if again:
                    time.sleep(STOP_APART_S)
                sent = [port.send(frame) for frame in quick_stop_frames(options)]
                went = went or all(sent)
    except HilError:
        return False
    return went


def quick_stop_frames(options: Options) -> Iterator[bytes | memoryview]:
    """The commands of all axes, and the SYNC with which they are applied."""
    n, modes = len(options.nodes), {name: code for code, name in MODE_NAMES.items()}
    outputs = Outputs.idle(n)
    outputs.controlword[:] = [QUICK_STOP] * n
    outputs.mode[:] = [modes[options.trajectory_mode]] * n
    commands = Commands(MAPPINGS[options.mapping], options.nodes)
    commands.pack(outputs)
    yield from commands.frames[:n]  # RPDO 1 has the controlword
    yield pack_frame(SYNC_COB_ID, b"")
