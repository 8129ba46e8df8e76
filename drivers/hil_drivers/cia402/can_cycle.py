"""Cyclic exchange over CAN: SYNC, RPDOs, the answering TPDOs, and all other received frames.

docs/explanation/can-cycle.md describes when each frame is on the wire and how frames are counted.
This module does not use the PDO code of a CANopen library, because that code is too slow for a
cycle (`benchmarks/can.py`). All commands of a cycle are packed into one block of memory and sent
with one system call. All answers of a cycle are received with one system call and unpacked
together. The file contains the following parts, in this order:

- `CanCyclic` implements `Cyclic` on CAN. `CanCyclic` sends `Commands` and reads `Answers`.
- `Collector` receives the answers to a SYNC. A drive's answer does not contain the number of its
  SYNC. If answers of earlier cycles are missing, the collector uses later frames to decide whether
  an answer is late or fresh; `Debts` counts the missing answers.
- `NodeWatch` handles every frame that is not process data: heartbeats, boot-ups, emergencies, bus
  errors. `MasterWatch` detects another master on the bus. `require_no_master` listens for another
  master before the first frame is sent.
- `Temperatures` reads motor temperatures from received SDO answers. The driver and a replay of its
  log process the same frames, so a temperature has the same cycle in the run and in the replay.
- `stop_directly` sends a quick stop from a process that does not own the bus, as a last resort.
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
"""Period of the master's heartbeat, in device time [s]."""

PUMP_S = 0.01
"""Longest wait for a frame in one round of `pump` [s]."""

SLACK_SHARE, MOST_SLACK_S = 0.5, 0.002
"""Limits of the retry time while the transmit queue is full: share of the answer time, and [s]."""

MARKER = struct.Struct("<iH")
"""Layout of the master's marker frame: segment (int32) and status (uint16)."""

Notify = Callable[[int, bytes, float], None]
_OPERATIONAL = b"\x05"

_HEAD_BYTES = 5
"""Length of the CAN identifier and the data length in a frame [bytes]; both identify a slot."""

_HEAD = FRAME.size - MOST_BYTES


class CanCyclic:
    """Implementation of `hil_drivers.cia402.bus.Cyclic` over a frame port.

    Args:
        port: Port that sends and receives 16-byte frames (`hil_drivers.cia402.can_channel`).
        mapping: PDO mapping of every axis.
        nodes: Node ids, in the order of the axes.
        period_s: Duration of a cycle in device time [s].
        master_id: Node id of the master's heartbeat and marker.
        notify: Callback for every frame that is not process data: `canopen.Network.notify` (COB-ID,
            data, Unix time). The callback `notify` runs in the thread that calls the method.
        log: Callback for every sent or received frame, with the Unix time [s] and the 16 bytes of
            the frame.
        late_cycles: Tolerated number of consecutive cycles in which the transmit queue is full, or
            in which a node answers twice.

    Attributes:
        counts: Numbers of bus errors since the bus was opened.
        sync_time: Unix time of the last SYNC [s].
        sent: (R, n, 8) RPDO bytes that were sent with the last SYNC: a view of the send buffer,
            which the next exchange overwrites.
        answered: (T, n, 8) TPDO bytes of the last cycle: a view of the receive buffer, which the
            next exchange overwrites.
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
        """Exchange the process data of one cycle; see `Cyclic`.

        Every call of `exchange` fills and returns the same `Inputs` object.
        """
        self._begin(outputs, give_up_s)
        self._collector.collect(self._inputs, self._synced_s, give_up_s)
        return self._inputs

    def idle(self, until_s: float) -> None:
        """See `Cyclic`."""
        self._collector.idle(until_s)

    def pump(self, until_s: float) -> None:
        """Handle frames until a time limit and send the master's heartbeat; see `Cyclic`."""
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
        """Switch the reporting of the drives' overdue heartbeats and boot-ups as news on or off."""
        self._watch.watch(on)

    def _begin(self, outputs: Outputs, give_up_s: float) -> None:
        """Send all frames of a cycle; SYNC is the first of the cyclic frames."""
        self._commands.pack(outputs)
        if (announced := (outputs.segment, outputs.status)) != self._announced:
            self._announced = announced
            self._send(pack_frame(self._marker_id, MARKER.pack(*announced)))
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
    """Command frames (RPDOs) of one cycle.

    Args:
        mapping: PDO mapping of the arm.
        nodes: Node ids of the arm, in the order of the axes.

    Attributes:
        frames: Views of 16 bytes each, in the order in which the frames are sent.
        data: (R, n, 8) data bytes of the frames.
    """

    def __init__(self, mapping: Mapping, nodes: Sequence[int]) -> None:
        pdos, n = mapping.rpdos, len(nodes)
        self._memory = bytearray(FRAME.size * n * len(pdos))
        self._heads = [
            (rpdo_cob_id(pdo.number, node), pdo.length) for pdo in pdos for node in nodes
        ]
        self._packing = struct.Struct("<" + "".join(("IB3x" + _codes(pdo)) * n for pdo in pdos))
        self._fields = [[entry.name for entry in pdo.entries] for pdo in pdos]
        # Identifiers and lengths never change, so they are written into the list only once.
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
        """Write the outputs into the frames."""
        values = self._values
        for name, places in self._places:
            values[places] = getattr(outputs, name)
        self._packing.pack_into(self._memory, 0, *values)


class Answers:
    """Answer frames (TPDOs) of one cycle: one slot per frame, ordered by PDO, then by axis.

    Args:
        mapping: PDO mapping of the arm.
        nodes: Node ids of the arm, in the order of the axes.

    Attributes:
        slots: Dictionary from the first five bytes of a frame (identifier, length) to the slot of
            the frame.
        memory: Buffer with the frames in the order of the slots, 16 bytes per frame.
        data: (T, n, 8) data bytes of the frames.
        cob_ids: COB-IDs of all slots.
        all_fresh: List for `Inputs.fresh` in a cycle in which all answers were received.
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
        """Return the number of the axis that fills a slot."""
        return slot % self._n

    def unpack(self, inputs: Inputs) -> None:
        """Unpack the values of all slots into the inputs."""
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
"""Factors by which the sleep time after SYNC grows if it was too short, and else shrinks.

With the factors 1.05 and 0.99 about five of six sleeps are long enough, and a single slow cycle
changes the sleep time only little.
"""

SOON_TIMES, SOON_S = 2.0, 5e-4
"""Limit of the answer time of a prompt answer: multiple of the usual time, plus a time [s]."""

USUAL_FADES = 0.995
"""Factor by which the usual answer time decays in each cycle.

The usual answer time is the answer time of the slowest of the last few hundred cycles. Cycles in
which answers of earlier cycles were missing are not used.
"""


class Collector:
    """Receiver that assigns the frames of one cycle to slots.

    A drive's answer does not contain the number of its SYNC. If one answer of an earlier cycle is
    missing, the collector waits for a second answer of the same drive. If a second answer follows,
    or if answers are slow at that time, the first answer belongs to the earlier cycle. The first
    answer belongs to the present cycle if the answer was prompt and no further answer is received
    before the next SYNC. If several answers of a slot are missing, `Debts` applies a stricter rule.

    Args:
        port: Source of the frames.
        answers: Slots of the answers.
        watch: Handler of all frames that are not process data; also counts errors.
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
        """Receive the answers to a SYNC and write their values into `inputs`.

        Args:
            inputs: Object into which the values are written; values of axes without a fresh answer
                are not changed.
            synced_s: Time at which SYNC was sent (`time.monotonic`) [s].
            give_up_s: Latest time at which the wait for answers ends (`time.monotonic`) [s].
        """
        if self._doubtful and self._counts.late == self._late_then:
            self._debts.forget_lost()  # no late answer followed: the missing one is lost
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
        """Handle frames that arrive between two cycles, until a time of `time.monotonic` [s]."""
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
        """Sleep while answers arrive, so that the thread wakes only one time for all answers."""
        now = time.monotonic()
        nap_s = synced_s + min(self._nap_s, MOST_NAP_SHARE * (give_up_s - synced_s)) - now
        if nap_s > LEAST_NAP_S:
            time.sleep(nap_s)

    def _fill(self, synced_s: float, give_up_s: float) -> bool:
        """Receive one answer per slot; return whether all slots received an answer."""
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
        if not self._debts:  # else an answer may belong to an earlier cycle
            self._learn(takes > 1, synced_s)
        return True

    def _learn(self, too_short: bool, synced_s: float) -> None:
        """Adapt the usual answer time and the sleep time after SYNC to this cycle."""
        self._usual_s = max(time.monotonic() - synced_s, USUAL_FADES * self._usual_s)
        if too_short:
            self._nap_s = self._nap_s * NAP_LONGER or time.monotonic() - synced_s
        else:
            self._nap_s *= NAP_SHORTER

    def _settle(self, synced_s: float, give_up_s: float, all_came: bool) -> bool:
        """Return whether all answers belong to the present SYNC after answers were missing.

        The method waits until `give_up_s` for second answers. If no second answer is received, the
        missing answer counts as lost, provided that the present answer was prompt and that no
        answer was missing in at least one slot. If answers of all slots are missing, probably all
        drives are slow.
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
        """Handle frames until the time limit while answers of earlier cycles are missing."""
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
        """Handle a second frame for a slot: the newest frame belongs to this cycle."""
        if self._debts.watched:
            self._debts.came(slot, time.monotonic())
        self._was_owed(slot)
        self._came[slot] = raw

    def _was_owed(self, slot: int) -> None:
        """Count a frame as late if an earlier answer of its slot was missing, else as doubled."""
        if self._debts.pay(slot):
            self._is_late(slot)
        else:
            self._watch.doubled(self._answers.axis(slot))

    def _is_late(self, slot: int) -> None:
        self._counts.late += 1
        self._late_axes.add(self._answers.axis(slot))

    def _miss(self, inputs: Inputs) -> None:
        """Fill slots without an answer with earlier data, and count the missing answers."""
        answers, came = self._answers, self._came
        owed = set(self._debts.slots)
        for slot, raw in enumerate(came):
            if raw is not None and slot not in owed:
                continue
            if raw is None:
                self._debts.owe(slot)
            else:  # late answer of an earlier cycle: now this cycle's answer is missing
                self._is_late(slot)
            self._counts.missing += 1
            came[slot] = bytes(answers.memory[slot * FRAME.size : (slot + 1) * FRAME.size])
            inputs.fresh[answers.axis(slot)] = False


CONFIRMED = 5
"""Number of consecutive cycles with one prompt answer that prove missing answers to be lost."""

STRICT_FROM = 2
"""Number of missing answers from which a slot counts as strict.

In a strict slot no answer counts as fresh until the missing answers of the slot were received or
are proved to be lost.
"""


class Debts:
    """Account of the answers that were not received before the end of their cycle.

    If one answer of a slot is missing, the frame of that answer was possibly lost; the next cycle
    shows whether the frame was late instead. If several answers of a slot are missing, a drive or
    the computer was delayed, and the first answers received belong to older SYNCs. A slot with
    several missing answers is strict until all missing answers were received, or until the drive of
    the slot has answered exactly once and promptly in `CONFIRMED` consecutive cycles.
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
        """Numbers of the slots with missing answers."""
        return list(self._owed)

    @property
    def watched(self) -> bool:
        """Whether at least one slot is strict; if True, every answer must be passed to `came`."""
        return bool(self._single)

    def owe(self, slot: int) -> None:
        """Add one missing answer to a slot at the end of a cycle."""
        owed = self._owed[slot] = self._owed.get(slot, 0) + 1
        if owed >= STRICT_FROM:
            self._single.setdefault(slot, 0)

    def pay(self, slot: int) -> bool:
        """Remove a late answer from a slot's missing answers; return False if none is missing."""
        owed = self._owed.pop(slot, 0)
        if owed > 1:
            self._owed[slot] = owed - 1
        elif slot in self._single:
            del self._single[slot]
        return owed > 0

    def forget_lost(self) -> None:
        """Remove the missing answers of all slots that are not strict: their frames are lost."""
        for slot in self.slots:
            if slot not in self._single:
                del self._owed[slot]

    def came(self, slot: int, now_s: float) -> None:
        """Count a frame of a slot that was received during the wait for the answers to a SYNC."""
        number, first_s = self._came.get(slot, (0, now_s))
        self._came[slot] = number + 1, first_s

    def came_between(self, slot: int) -> None:
        """Restart the count of a strict slot, because a frame arrived between cycles.

        A frame that arrives between two cycles proves that answers of its drive are late, not lost.
        """
        if slot in self._single:
            self._single[slot] = 0

    def confirm(self, soon_s: float) -> None:
        """Update the strict slots at the end of a cycle.

        A slot that received exactly one prompt answer in each of `CONFIRMED` consecutive cycles is
        no longer strict, and the missing answers of this slot count as lost.

        Args:
            soon_s: Latest time at which an answer counts as prompt, on the clock of `came` [s].
        """
        for slot, in_a_row in list(self._single.items()):
            number, first_s = self._came.get(slot, (0, 0.0))
            once = number == 1 and first_s <= soon_s
            self._single[slot] = in_a_row + 1 if once else 0
            if self._single[slot] >= CONFIRMED:
                del self._single[slot], self._owed[slot]
        self._came.clear()


SILENCE_S = 0.3
"""Device time after which a heartbeat with a period of 100 ms is overdue [s]."""

LOOK_S = 0.01
RX_OVERFLOW = 0x01
_BOOT_UP = 0


class NodeWatch:
    """Handler of frames that are not process data; also detects overdue heartbeats.

    Args:
        nodes: Node ids of the arm's drives.
        tpdos: COB-IDs of the drives' process data.
        counts: Counters for malformed frames, foreign frames and overflows.
        notify: Callback for every frame except error frames of the bus.
        late_cycles: Tolerated number of consecutive cycles in which the transmit queue is full, or
            in which a node answers twice.

    Attributes:
        counts: Counters that were passed to the constructor.
        cycle: Number of the present cycle; the exchange sets this number.
        look_at: Device time at which `look` must be called again [s].
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
        """Switch the reporting of overdue heartbeats and boot-ups as news on or off."""
        self._watching = on
        self._heard_s = [self._device_s] * len(self._heard_s)
        self._silent.clear()

    def take_news(self) -> News | None:
        """Return the news since the last call; None if there are no news."""
        if not self._news.any:
            return None
        news, self._news = self._news, News()
        return news

    def heard(self, raw: bytes) -> None:
        """Handle every frame except process data of the mapped length."""
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
        """Record as news the axes whose heartbeat is overdue at a device time [s]."""
        self._device_s, self.look_at = device_s, device_s + LOOK_S
        if not self._watching:
            return
        for axis, heard_s in enumerate(self._heard_s):
            if device_s - heard_s > SILENCE_S and axis not in self._silent:
                self._silent.add(axis)
                self._news.silent.append(axis)

    def overflow(self) -> None:
        """Count a frame of the present cycle that did not fit into the transmit queue."""
        self.counts.overflows += 1
        most = self._late_cycles
        if self._overflowing.in_cycle(self.cycle) > most:
            self._news.bus_error = (
                f"frames could not be sent on the bus in more than {most} consecutive cycles"
            )

    def doubled(self, axis: int) -> None:
        """Count a second answer of an axis in one cycle, unless an earlier answer was missing."""
        self.counts.doubled += 1
        if self._doubling[axis].in_cycle(self.cycle) > self._late_cycles:
            self._tell(f"two nodes answer as node {self._nodes[axis]}")

    def _foreign(self, can_id: int, data: bytes) -> None:
        if problem := self._masters.heard(can_id, data):
            self._tell(problem)

    def _tell(self, problem: str) -> None:
        """Report a problem while the arm is driven, unless a bus error is already reported."""
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
            self._news.bus_error = "the CAN controller of this computer is off the bus (bus-off)"
        elif can_id & ERROR_CONTROLLER and data[1] & (TX_OVERFLOW | RX_OVERFLOW):
            self.overflow()


@dataclass(slots=True)
class Counts:
    """Numbers of errors on the bus, by kind; `str` returns a text with all numbers above zero.

    Attributes:
        missing: Number of TPDOs that were not received before the end of their cycle.
        late: Number of missing TPDOs that were received after the next SYNC.
        doubled: Number of TPDOs that were received two times in one cycle.
        malformed: Number of TPDOs whose length differs from that of the mapping.
        foreign: Number of frames that no drive of the arm sends.
        overflows: Number of frames that did not fit into a transmit or receive queue.
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
            ("received twice", self.doubled),
            ("of a wrong length", self.malformed),
            ("frames of foreign nodes", self.foreign),
            ("lost in full queues", self.overflows),
        )
        return ", ".join(f"{number} {what}" for what, number in counts if number)


class InARow:
    """Counter of the consecutive cycles in which an event occurs, such as a full transmit queue."""

    def __init__(self) -> None:
        self._last, self._number = -2, 0

    def in_cycle(self, cycle: int) -> int:
        """Count an event of a cycle and return the number of consecutive cycles with events.

        Several events in the same cycle count as one event.
        """
        if cycle != self._last:
            self._number = self._number + 1 if cycle == self._last + 1 else 1
            self._last = cycle
        return self._number


LISTEN_S = 0.3
"""Wall time during which the driver only listens on the bus, before the first frame is sent [s]."""

LISTEN_INSIDE_S = 0.03
"""Listening time on a bus that reaches no other process [s] (wall time)."""

ALLOWED_S = 0.05
"""Wall time after a quick stop of another sender in which its SYNC is permitted [s]."""

ANOTHER = "another master is on the bus"
HINT = (
    "end the other master first: another hil process, a PLC, a manufacturer's tool, or a drive "
    "that produces SYNC (1005h)"
)


def require_no_master(
    port: FramePort, nodes: Sequence[int], master_id: int, lasts_s: float = LISTEN_S
) -> None:
    """Listen on the bus without sending; raise if another master is active.

    Args:
        port: Port of the bus.
        nodes: Node ids of the arm's drives.
        master_id: Node id of this master's heartbeat.
        lasts_s: Duration of listening in wall time [s].

    Raises:
        RobotConnectionError: Another master commands these drives, or uses this master's node id.
    """
    beat = HEARTBEAT_COB_ID + master_id
    ours = f"heartbeat of this master's node id {master_id} ({beat:03X}h)"
    names = commanding(nodes) | {beat: ours}
    heard: dict[str, int] = {}
    until_s = time.monotonic() + lasts_s
    while time.monotonic() < until_s:
        raw = port.receive(until_s)
        if raw is not None and (name := names.get(FRAME.unpack(raw)[0])):
            heard[name] = heard.get(name, 0) + 1
    if heard:
        frames = ", ".join(f"{number} × {name}" for name, number in heard.items())
        raise RobotConnectionError(f"{ANOTHER}: {frames} within {lasts_s:g} s", hint=HINT)


class MasterWatch:
    """Detector of frames from another master while the arm is driven.

    A direct stop by another process (`stop_directly`) consists of quick-stop commands and a SYNC.
    The frames of a direct stop do not count as frames of another master: the axes report by
    themselves that they stop.

    Args:
        nodes: Node ids of the arm's drives.
    """

    def __init__(self, nodes: Sequence[int]) -> None:
        self._names = commanding(nodes)
        self._allowed_until_s = 0.0

    def heard(self, can_id: int, data: bytes) -> str:
        """Return why a frame of another sender is a problem; an empty text if it is permitted."""
        name = self._names.get(can_id)
        if name is None:
            return ""
        now = time.monotonic()
        if can_id != SYNC_COB_ID and int.from_bytes(data[:2], "little") == QUICK_STOP:
            self._allowed_until_s = now + ALLOWED_S
            return ""
        if can_id == SYNC_COB_ID and now < self._allowed_until_s:
            return ""
        return f"{ANOTHER}: {name} came from a different sender"


def commanding(nodes: Sequence[int]) -> dict[int, str]:
    """Return the COB-IDs of SYNC and of all RPDOs of these nodes, each with a name for messages."""
    names = {SYNC_COB_ID: f"SYNC ({SYNC_COB_ID:03X}h)"}
    for number in range(1, len(RPDO_COB_IDS) + 1):
        for node in nodes:
            can_id = rpdo_cob_id(number, node)
            names[can_id] = f"RPDO{number} of node {node} ({can_id:03X}h)"
    return names


CELSIUS_PER_COUNT = 0.1

_EXPEDITED, _EXPEDITED_MASK = 0x42, 0xE2
"""First byte of an SDO answer to an expedited upload, and its mask (CiA 301, 7.2.4.3.5)."""

_ANSWER = struct.Struct("<BHBh")


class Temperatures:
    """Collector of the motor temperatures in received SDO answers.

    Args:
        nodes: Node ids, in the order of the axes.
        index: Index of the temperature object, an INTEGER16 in 0.1 °C; 0 if the drives have no such
            object.

    Attributes:
        celsius: (n,) motor temperatures received last [°C]; NaN before the first value.
    """

    def __init__(self, nodes: Sequence[int], index: int) -> None:
        self._axes = {SDO_ANSWER_COB_ID + node: axis for axis, node in enumerate(nodes)}
        self._index = index
        self.celsius: FloatArray = np.full(len(nodes), np.nan)

    def heard(self, can_id: int, data: bytes) -> None:
        """Store the temperature from an SDO answer; ignore all other frames."""
        axis = self._axes.get(can_id)
        if axis is None or not self._index or len(data) < _ANSWER.size:
            return
        command, index, sub, count = _ANSWER.unpack_from(data)
        if command & _EXPEDITED_MASK == _EXPEDITED and (index, sub) == (self._index, 0):
            self.celsius[axis] = count * CELSIUS_PER_COUNT


STOP_TIMES, STOP_APART_S = 3, 0.002
"""Number of quick stops that are sent, and the time between two of them [s].

The repetition helps if a frame is lost, if the transmit queue is full for a moment, or if another
sender commands the drives at the same time.
"""


def stop_directly(options: Options) -> bool:
    """Send a quick stop to all axes without the process that owns the bus.

    The function can be called from any thread and returns within milliseconds. A drive that has
    received one quick stop brakes and switches off (605Ah = 2). Set-points that another master
    still sends do not cancel a quick stop.

    Args:
        options: Options of the arm: bus, node ids, mapping of the process data.

    Returns:
        Whether all frames of at least one quick stop were sent. If only one program can open the
        adapter, the function returns False while the process that drives the arm is running.
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
    """Yield the quick-stop commands of all axes, then the SYNC that applies these commands."""
    n, modes = len(options.nodes), {name: code for code, name in MODE_NAMES.items()}
    outputs = Outputs.idle(n)
    outputs.controlword[:] = [QUICK_STOP] * n
    outputs.mode[:] = [modes[options.trajectory_mode]] * n
    commands = Commands(MAPPINGS[options.mapping], options.nodes)
    commands.pack(outputs)
    yield from commands.frames[:n]  # RPDO 1 contains the controlword
    yield pack_frame(SYNC_COB_ID, b"")
