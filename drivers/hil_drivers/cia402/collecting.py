"""Takes the answers to a SYNC, and tells late ones from those that never came."""

from __future__ import annotations

import time

from hil_drivers.cia402.bursts import receiving
from hil_drivers.cia402.contracts import Inputs
from hil_drivers.cia402.node_watch import NodeWatch
from hil_drivers.cia402.pdo_frames import Answers
from hil_drivers.cia402.ports import FramePort

LEAST_NAP_S = 2e-5
MOST_NAP_SHARE = 0.5
NAP_LONGER, NAP_SHORTER = 1.05, 0.99
"""A nap that was too short becomes longer, one that was not shorter: five of six are long enough,
and a single slow cycle changes little."""

SOON_TIMES, SOON_S = 4.0, 5e-4
"""An answer comes soon when it takes no longer than so many times what is usual, and this."""

_HEAD_BYTES, _FRAME_BYTES = 5, 16


class Collector:
    """The slots of one cycle, filled as frames come.

    Which SYNC an answer belongs to is not written on it. Where one is owed from an earlier cycle,
    the first that comes is that one if a second follows, or if answers are slow just now; it is
    this cycle's again when nothing more has come by the next SYNC.

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
        self._owed: dict[int, int] = {}
        self._nap_s = 0.0
        self._doubtful, self._late_then = False, 0

    def collect(self, inputs: Inputs, synced_s: float, give_up_s: float) -> None:
        """Fill `inputs` with the answers to a SYNC.

        Args:
            inputs: What is not fresh keeps its values.
            synced_s: When it was sent (`time.monotonic`).
            give_up_s: When to be done with waiting.
        """
        if self._doubtful and self._counts.late == self._late_then:
            self._owed.clear()  # nothing has come since: it was lost after all
        self._doubtful = False
        self._nap(synced_s, give_up_s)
        all_came = self._fill(synced_s, give_up_s)
        if self._owed:
            all_came = all_came and self._settle(synced_s, give_up_s)
        inputs.fresh[:] = self._answers.all_fresh
        if not all_came:
            self._miss(inputs)
            self._late_then = self._counts.late
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
                else:
                    self._second(slot, raw)
        if takes > 1:
            self._nap_s = self._nap_s * NAP_LONGER or time.monotonic() - synced_s
        else:
            self._nap_s *= NAP_SHORTER
        return True

    def _settle(self, synced_s: float, give_up_s: float) -> bool:
        """Whether the answers are those to this SYNC, where earlier ones are owed.

        The second is waited for as long as there is time. When none comes, the owed one was lost
        if this one came as soon as answers usually do, and if others had answered before: when
        nobody had, all are slow rather than lost.
        """
        now, nobody = time.monotonic(), len(self._owed) == len(self._came)
        while self._owed:
            raw = self._port.receive(give_up_s)
            if raw is None:
                break
            slot = self._slot_of(raw[:_HEAD_BYTES])
            if slot is None:
                self._watch.heard(raw)
            else:
                self._second(slot, raw)
        soon_s = synced_s + SOON_TIMES * self._nap_s + SOON_S
        if now <= soon_s and not nobody:
            self._owed.clear()
        self._doubtful = bool(self._owed)
        return not self._owed

    def _second(self, slot: int, raw: bytes) -> None:
        """Another frame for a slot that has one: the newest is that of this cycle."""
        self._was_owed(slot)
        self._came[slot] = raw

    def _was_owed(self, slot: int) -> None:
        """Count a frame as late if one was owed, else as doubled."""
        owed = self._owed.pop(slot, 0)
        if not owed:
            self._counts.doubled += 1
            return
        self._counts.late += 1
        if owed > 1:
            self._owed[slot] = owed - 1

    def _miss(self, inputs: Inputs) -> None:
        """Fill empty slots with what was there before, and keep in mind who owes what."""
        answers, came = self._answers, self._came
        for slot in list(self._owed):
            if came[slot] is not None:  # answers are slow: it is that of an earlier cycle
                self._was_owed(slot)
                came[slot] = None
        missing = [slot for slot, raw in enumerate(came) if raw is None]
        self._counts.missing += len(missing)
        for slot in missing:
            self._owed[slot] = self._owed.get(slot, 0) + 1
            came[slot] = bytes(answers.memory[slot * _FRAME_BYTES : (slot + 1) * _FRAME_BYTES])
            inputs.fresh[answers.axis(slot)] = False
