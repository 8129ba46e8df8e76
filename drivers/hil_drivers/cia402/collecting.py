"""Takes the answers to a SYNC, and tells late ones from those that never came."""

from __future__ import annotations

import time

from hil_drivers.cia402.bursts import receiving
from hil_drivers.cia402.contracts import Inputs
from hil_drivers.cia402.debts import Debts
from hil_drivers.cia402.node_watch import NodeWatch
from hil_drivers.cia402.pdo_frames import Answers
from hil_drivers.cia402.ports import FramePort

LEAST_NAP_S = 2e-5
MOST_NAP_SHARE = 0.5
NAP_LONGER, NAP_SHORTER = 1.05, 0.99
"""A nap that was too short becomes longer, one that was not shorter: five of six are long enough,
and a single slow cycle changes little."""

SOON_TIMES, SOON_S = 2.0, 5e-4
"""An answer comes soon when it takes no longer than so many times what is usual, and this."""

USUAL_FADES = 0.995
"""Usual is what the slowest of the last few hundred cycles took, those with debts apart."""

_HEAD_BYTES, _FRAME_BYTES = 5, 16


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
            inputs: What is not fresh keeps its values.
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
        """Take what comes between two cycles, until that `time.monotonic`."""
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
        nobody had, all are slow rather than lost.
        """
        debts, soon_s = self._debts, synced_s + SOON_TIMES * self._usual_s + SOON_S
        if all_came:
            soon, nobody = time.monotonic() <= soon_s, len(debts) == len(self._came)
            self._take_more(give_up_s)
            if soon and not nobody:
                debts.forget_lost()
            self._doubtful = soon and bool(debts)
        if debts.watched:
            debts.confirm(soon_s)
        return all_came and not debts

    def _take_more(self, give_up_s: float) -> None:
        """Take what comes as long as anything is owed."""
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
        """Fill empty slots with what was there before, and keep in mind who owes what."""
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
            came[slot] = bytes(answers.memory[slot * _FRAME_BYTES : (slot + 1) * _FRAME_BYTES])
            inputs.fresh[answers.axis(slot)] = False
