"""The plan of a passive recording: dwells and moves detected while the rows come.

A robot that another program moves is recorded without a plan. `Segmenter` numbers its rows before
they are written, so that the recording has the segments that a plan would give it: even ones move,
odd ones are dwells. `DetectedSteps` sums the segments up as the steps of a plan; its document takes
the place of `plan.json` in the run directory.

Where the rows of a whole recording are at hand, `hil.data.dwells_of` detects dwells instead. Both
use the same rule, `hil.data.RestRule`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import BoolArray, FloatArray, StructArray
from hil.data import RestRule
from hil.planning import DwellRule

PASSIVE_PLAN_FILE = "found.json"
"""File of the run directory that takes the place of `plan.json`."""

PASSIVE_PLAN_FORMAT = 1


class Segmenter:
    """Gives every row the number of its segment; rows that may become a dwell are held back.

    Args:
        rule: When an arm counts as being at rest.
    """

    def __init__(self, rule: RestRule | None = None) -> None:
        self._rule = rule or RestRule()
        self._segment = 0
        self._rest_pose: FloatArray | None = None  # of the dwell that the newest rows belong to
        self._held_back: StructArray | None = None

    def feed(self, rows: StructArray) -> StructArray:
        """Return the rows whose segment is known by now, those held back before them first.

        Args:
            rows: (N,) state rows in order; their `segment` is overwritten.
        """
        if self._held_back is not None:
            rows = np.concatenate((self._held_back, rows))
            self._held_back = None
        speed = np.abs(rows["qd"]).max(axis=1)
        at = 0
        while at < len(rows):
            step = self._move if self._rest_pose is None else self._dwell
            end = step(rows, speed, at)
            if end is None:
                break
            at = end
        if at < len(rows):
            self._held_back = rows[at:].copy()
        return rows[:at]

    def flush(self) -> StructArray | None:
        """Return the rows held back, at the end of a recording: they belong to the last motion."""
        rows, self._held_back = self._held_back, None
        if rows is not None:
            rows["segment"] = self._segment
        return rows

    def _dwell(self, rows: StructArray, speed: FloatArray, at: int) -> int | None:
        """Return where the dwell ends; None if all rows from `at` may be of the next motion."""
        assert self._rest_pose is not None
        away = np.abs(rows["q"][at:] - self._rest_pose).max(axis=1) > self._rule.drift
        left = np.flatnonzero((speed[at:] > LEAVES_AT * self._rule.speed) | away)
        over = bool(len(left))
        end = at + int(left[0]) if over else len(rows)
        # A motion that begins gently began before it was noticed: a dwell's last rows must rest.
        slow = np.flatnonzero(speed[at:end] < self._rule.speed)
        rest = at + int(slow[-1]) + 1 if len(slow) else at
        if over or end - rest < MOST_HELD_BACK:
            end = rest
        rows["segment"][at:end] = self._segment
        if over:
            self._segment, self._rest_pose = self._segment + 1, None
            return end
        return end if end > at else None

    def _move(self, rows: StructArray, speed: FloatArray, at: int) -> int | None:
        """Return where the motion from `at` ends, or the slow rows begin that are undecided.

        None when those begin at `at` itself.
        """
        slow = speed[at:] < self._rule.speed
        begins = at + int(np.argmax(slow)) if slow.any() else len(rows)
        rows["segment"][at:begins] = self._segment
        if begins == len(rows):
            return begins
        end = begins + self._slow_rows(rows, slow[begins - at :], begins)
        lasted = rows["device_time"][end - 1] - rows["device_time"][begins]
        if end - begins >= self._rule.samples and lasted >= self._rule.min_s - 1e-9:
            self._segment, self._rest_pose = self._segment + 1, rows["q"][end - 1].copy()
        elif end == len(rows) and end - begins < MOST_HELD_BACK:
            return begins if begins > at else None
        rows["segment"][begins:end] = self._segment
        return end

    def _slow_rows(self, rows: StructArray, slow: BoolArray, begin: int) -> int:
        """Return how many slow rows from `begin` stay within the drift, at least one."""
        q = rows["q"][begin : begin + len(slow)]
        ends = ~slow | (np.abs(q - q[0]).max(axis=1) > self._rule.drift)
        return int(np.argmax(ends)) if ends.any() else len(slow)


LEAVES_AT = 2.0
"""A dwell ends at this many times the speed at which it begins: noise must not end it."""

MOST_HELD_BACK = 1000
"""Rows; a robot whose clock has stopped must not have all of them held back."""


@dataclass(slots=True)
class _Segment:
    """One segment, as far as its rows have come."""

    begin_s: float
    end_s: float
    q_end: FloatArray


class DetectedSteps:
    """The segments of a recording as the steps of a plan; fed with rows, read at the end."""

    def __init__(self) -> None:
        self._segments: dict[int, _Segment] = {}

    def add(self, rows: StructArray) -> None:
        """Add (N,) rows of `Segmenter`, in order."""
        if not len(rows):
            return
        edges = np.flatnonzero(np.diff(rows["segment"])) + 1
        for piece in np.split(rows, edges):
            number, last = int(piece["segment"][0]), piece[-1]
            end_s, q_end = float(last["device_time"]), np.array(last["q"])
            segment = self._segments.setdefault(
                number, _Segment(float(piece[0]["device_time"]), 0.0, q_end)
            )
            segment.end_s, segment.q_end = end_s, q_end

    def steps(self) -> list[dict[str, Any]]:
        """Return the steps in the form of a plan document, index by index."""
        count = max(self._segments, default=-1) + 1
        lasted = {n: one.end_s - one.begin_s for n, one in self._segments.items() if not n % 2}
        long = {n for n, seconds in lasted.items() if seconds >= TRAJECTORY_S}
        if sum(lasted[n] for n in long) <= 0.5 * sum(lasted.values()):
            long = set()
        out: list[dict[str, Any]] = []
        poses: list[FloatArray] = []
        for index in range(count):
            step: dict[str, Any] = {"index": index, "kind": "move", "load": 0}
            if index % 2 and index in self._segments:
                q = self._segments[index].q_end
                step |= {"kind": "dwell", "pose": _pose_number(q, poses)}
                step |= {"approach": side} if (side := self._approach(index)) else {}
            elif index in long:
                number = sum(1 for other in long if other < index)
                step |= {"kind": "trajectory", "trajectory": number}
            out.append(step)
        return out

    def counts(self) -> dict[str, int]:
        """Return the number of steps of each kind.

        A recording that begins at rest has no first motion, although its first step is one.
        """
        kinds = Counter(step["kind"] for step in self.steps() if step["index"] in self._segments)
        return dict(sorted(kinds.items()))

    def document(self, *, name: str, robot: Mapping[str, Any], payload: Payload) -> dict[str, Any]:
        """Return the steps as a plan document, but without motions.

        Args:
            name: Of the recording.
            robot: As in its start document.
            payload: The mounted load.
        """
        rule = DwellRule(settle_rad_s=RestRule().speed)
        return {
            "hil_found": PASSIVE_PLAN_FORMAT,
            "name": name,
            "robot_model": robot["model"],
            "joint_names": list(robot["joint_names"]),
            "rate_hz": robot["rate_hz"],
            "dwell": {
                "dwell_s": rule.dwell_s,
                "samples": rule.samples,
                "settle_rad_s": rule.settle_rad_s,
                "timeout_s": rule.timeout_s,
            },
            "loads": [
                {
                    "mass_kg": payload.mass,
                    "com_m": list(payload.com),
                    "inertia_kgm2": list(payload.inertia),
                }
            ],
            "steps": self.steps(),
        }

    def _approach(self, index: int) -> int:
        """Return +1 or −1 if every joint came from below or above to a dwell, else 0."""
        before = self._segments.get(index - 2)
        if before is None:
            return 0
        way = self._segments[index].q_end - before.q_end
        return int((way > 0).all()) - int((way < 0).all())


TRAJECTORY_S = 10.0
"""A motion this long is a trajectory, if most of the motion is of that kind [s]."""

SAME_POSE_RAD = 0.01


def _pose_number(q: FloatArray, poses: list[FloatArray]) -> int:
    """Return the number of the pose: the same as before where the arm has been before."""
    for number, known in enumerate(poses):
        if np.abs(known - q).max() < SAME_POSE_RAD:
            return number
    poses.append(q)
    return len(poses) - 1
