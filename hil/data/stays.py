"""Dwells and moves in a recording that has no plan, found while the rows come.

`hil.data.dwells` finds the dwells of a whole recording; this numbers rows before they are written,
so that the recording of a robot that somebody else drives has the segments a plan would give it:
even ones move, odd ones stand still.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import BoolArray, FloatArray, StructArray
from hil.data.dwells import DwellRule

LEAVES_AT = 2.0
"""A stay ends at this many times the speed at which it begins: noise must not end it."""

FOUND_FILE = "found.json"
"""What the run directory of a passive recording holds in place of a plan."""

MOST_HELD = 1000
"""Rows; a robot whose clock stands still must not have all of them held back."""

SAME_POSE_RAD = 0.01
TRAJECTORY_S = 10.0
"""A motion that goes on for so long is a trajectory, if most of the motion is of that kind [s]."""


class StayFinder:
    """Gives every row the number of its segment; rows that may become a stay are held back.

    Args:
        rule: When an arm counts as standing still.
    """

    def __init__(self, rule: DwellRule | None = None) -> None:
        self._rule = rule or DwellRule()
        self._segment = 0
        self._stood: FloatArray | None = None
        self._held: StructArray | None = None

    def feed(self, rows: StructArray) -> StructArray:
        """Rows whose segment is known, those that were held back first.

        Args:
            rows: (N,) state rows in order; their `segment` is overwritten.
        """
        if self._held is not None:
            rows = np.concatenate((self._held, rows))
            self._held = None
        speed = np.abs(rows["qd"]).max(axis=1)
        at = 0
        while at < len(rows):
            end = (
                self._end_of_stay(rows, speed, at) if self._stands else self._move(rows, speed, at)
            )
            if end is None:
                break
            at = end
        if at < len(rows):
            self._held = rows[at:].copy()
        return rows[:at]

    def flush(self) -> StructArray | None:
        """What was held back, at the end of the recording; it belongs to the last motion."""
        held, self._held = self._held, None
        if held is not None:
            held["segment"] = self._segment
        return held

    @property
    def _stands(self) -> bool:
        return self._stood is not None

    def _end_of_stay(self, rows: StructArray, speed: FloatArray, at: int) -> int | None:
        """Where the stay ends; None when all rows from `at` may already be of the next motion."""
        assert self._stood is not None
        away = np.abs(rows["q"][at:] - self._stood).max(axis=1) > self._rule.drift
        left = np.flatnonzero((speed[at:] > LEAVES_AT * self._rule.speed) | away)
        over = bool(len(left))
        end = at + int(left[0]) if over else len(rows)
        # A motion that begins gently began before it was noticed: a dwell's last rows must rest.
        slow = np.flatnonzero(speed[at:end] < self._rule.speed)
        rest = at + int(slow[-1]) + 1 if len(slow) else at
        if over or end - rest < MOST_HELD:
            end = rest
        rows["segment"][at:end] = self._segment
        if over:
            self._segment, self._stood = self._segment + 1, None
            return end
        return end if end > at else None

    def _move(self, rows: StructArray, speed: FloatArray, at: int) -> int | None:
        """Where the motion from `at` ends, or the slow rows begin that are not judged yet.

        None when those begin at `at` itself.
        """
        slow = speed[at:] < self._rule.speed
        begins = at + int(np.argmax(slow)) if slow.any() else len(rows)
        rows["segment"][at:begins] = self._segment
        if begins == len(rows):
            return begins
        length = self._slow_rows(rows, slow[begins - at :], begins)
        if self._long_enough(rows, begins, begins + length):
            self._segment, self._stood = self._segment + 1, rows["q"][begins + length - 1].copy()
            rows["segment"][begins : begins + length] = self._segment
            return begins + length
        if begins + length == len(rows) and length < MOST_HELD:
            return begins if begins > at else None
        rows["segment"][begins : begins + length] = self._segment
        return begins + length

    def _slow_rows(self, rows: StructArray, slow: BoolArray, begin: int) -> int:
        """How many slow rows from `begin` stay within the drift of the first, one at least."""
        q = rows["q"][begin : begin + len(slow)]
        ends = ~slow | (np.abs(q - q[0]).max(axis=1) > self._rule.drift)
        return int(np.argmax(ends)) if ends.any() else len(slow)

    def _long_enough(self, rows: StructArray, begin: int, end: int) -> bool:
        lasted = rows["device_time"][end - 1] - rows["device_time"][begin]
        return bool(end - begin >= self._rule.samples and lasted >= self._rule.min_s - 1e-9)


@dataclass(slots=True)
class _Found:
    """One segment, as far as it has been seen."""

    begin_s: float
    end_s: float
    q_end: FloatArray


class FoundSteps:
    """What the segments of a recording turned out to be; told row by row, asked at the end."""

    def __init__(self) -> None:
        self._found: dict[int, _Found] = {}

    def add(self, rows: StructArray) -> None:
        """Take note of (N,) rows of `StayFinder`, in order."""
        if not len(rows):
            return
        edges = np.flatnonzero(np.diff(rows["segment"])) + 1
        for piece in np.split(rows, edges):
            number, last = int(piece["segment"][0]), piece[-1]
            end_s, q_end = float(last["device_time"]), np.array(last["q"])
            known = self._found.setdefault(
                number, _Found(float(piece[0]["device_time"]), 0.0, q_end)
            )
            known.end_s, known.q_end = end_s, q_end

    def steps(self) -> list[dict[str, Any]]:
        """The steps in the form of a plan document, index by index."""
        count = max(self._found, default=-1) + 1
        lasted = {n: f.end_s - f.begin_s for n, f in self._found.items() if not n % 2}
        long = {n for n, seconds in lasted.items() if seconds >= TRAJECTORY_S}
        if sum(lasted[n] for n in long) <= 0.5 * sum(lasted.values()):
            long = set()
        out: list[dict[str, Any]] = []
        poses: list[FloatArray] = []
        for index in range(count):
            step: dict[str, Any] = {"index": index, "kind": "move", "load": 0}
            if index % 2 and index in self._found:
                q = self._found[index].q_end
                step |= {"kind": "dwell", "pose": _pose(q, poses)}
                step |= {"approach": side} if (side := self._approach(index)) else {}
            elif index in long:
                number = sum(1 for other in long if other < index)
                step |= {"kind": "trajectory", "trajectory": number}
            out.append(step)
        return out

    def counts(self) -> dict[str, int]:
        """How many there are of each kind; a recording that begins at rest has no first motion."""
        kinds = Counter(step["kind"] for step in self.steps() if step["index"] in self._found)
        return dict(sorted(kinds.items()))

    def _approach(self, index: int) -> int:
        """+1 or −1 when every joint came from below or above to a stay, else 0."""
        before = self._found.get(index - 2)
        if before is None:
            return 0
        way = self._found[index].q_end - before.q_end
        return int((way > 0).all()) - int((way < 0).all())


def _pose(q: FloatArray, poses: list[FloatArray]) -> int:
    """Number of the pose: the same as before where the arm has stood before."""
    for number, known in enumerate(poses):
        if np.abs(known - q).max() < SAME_POSE_RAD:
            return number
    poses.append(q)
    return len(poses) - 1
