"""Plan of a passive recording: dwells and motions are detected while the rows are received.

A robot that a different program moves is recorded without a plan. The class `Segmenter` numbers the
rows of a passive recording before they are written, so that the recording has segments as with a
plan: even segments are motions, odd segments are dwells. The class `DetectedSteps` converts the
segments to the steps of a plan; its document replaces `plan.json` in the run directory.

If the rows of a whole recording are available, `hil.data.dwells_of` detects dwells instead. This
module and `hil.data.dwells_of` use the same rule, `hil.data.RestRule`.
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
"""Name of the file with the detected plan, which replaces `plan.json` in the run directory."""

PASSIVE_PLAN_FORMAT = 1


class Segmenter:
    """Numbering of rows by segment; rows that are possibly the start of a dwell are buffered.

    Args:
        rule: Criterion for counting an arm as static.
    """

    def __init__(self, rule: RestRule | None = None) -> None:
        self._rule = rule or RestRule()
        self._segment = 0
        self._rest_pose: FloatArray | None = None  # pose of the dwell that contains the newest rows
        self._held_back: StructArray | None = None

    def feed(self, rows: StructArray) -> StructArray:
        """Return the rows whose segment is known, starting with the buffered rows.

        Args:
            rows: (N,) state rows in order; the field `segment` of the rows is overwritten.
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
        """Return the rows that are still buffered at the end, as part of the last motion."""
        rows, self._held_back = self._held_back, None
        if rows is not None:
            rows["segment"] = self._segment
        return rows

    def _dwell(self, rows: StructArray, speed: FloatArray, at: int) -> int | None:
        """Return the index at which the dwell ends.

        The returned index is None if all rows from `at` possibly belong to the next motion.
        """
        assert self._rest_pose is not None
        away = np.abs(rows["q"][at:] - self._rest_pose).max(axis=1) > self._rule.drift
        left = np.flatnonzero((speed[at:] > LEAVES_AT * self._rule.speed) | away)
        over = bool(len(left))
        end = at + int(left[0]) if over else len(rows)
        # A slow motion is detected late, so the last rows of the dwell must be static.
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
        """Return the index at which the motion from `at` ends.

        If a slow row is undecided, the index of the first undecided row is returned.

        The returned index is None if the row `at` itself is undecided.
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
        """Return the number of slow rows from `begin` within the drift limit, at least one."""
        q = rows["q"][begin : begin + len(slow)]
        ends = ~slow | (np.abs(q - q[0]).max(axis=1) > self._rule.drift)
        return int(np.argmax(ends)) if ends.any() else len(slow)


LEAVES_AT = 2.0
"""Ratio of the speed that ends a dwell to the speed that begins a dwell; noise must not end a
dwell."""

MOST_HELD_BACK = 1000
"""Maximum number of buffered rows, a limit for the case that the clock of the robot has stopped."""


@dataclass(slots=True)
class _Segment:
    """Begin, end and last position of a segment, for the rows received so far."""

    begin_s: float
    end_s: float
    q_end: FloatArray


class DetectedSteps:
    """Converter of the segments of a recording to steps of a plan; read at the end."""

    def __init__(self) -> None:
        self._segments: dict[int, _Segment] = {}

    def add(self, rows: StructArray) -> None:
        """Add rows (N,) that `Segmenter` has numbered, in order."""
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
        """Return the steps in the form of a plan document, sorted by index."""
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
        """Return the number of detected steps of each kind.

        If a recording begins with a static arm, its first step has no rows and is not counted.
        """
        kinds = Counter(step["kind"] for step in self.steps() if step["index"] in self._segments)
        return dict(sorted(kinds.items()))

    def document(self, *, name: str, robot: Mapping[str, Any], payload: Payload) -> dict[str, Any]:
        """Return the detected steps as a plan document without set-points.

        Args:
            name: Name of the recording.
            robot: Robot description in the start document.
            payload: Mounted payload.
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
        """Return +1 or −1 if all joints approached a dwell from below or from above, else 0."""
        before = self._segments.get(index - 2)
        if before is None:
            return 0
        way = self._segments[index].q_end - before.q_end
        return int((way > 0).all()) - int((way < 0).all())


TRAJECTORY_S = 10.0
"""Minimum duration of a motion that counts as a trajectory [s].

Long motions count as trajectories only if they make up most of the motion time.
"""

SAME_POSE_RAD = 0.01


def _pose_number(q: FloatArray, poses: list[FloatArray]) -> int:
    """Return the identifier of a pose; a pose that was visited before keeps its identifier."""
    for number, known in enumerate(poses):
        if np.abs(known - q).max() < SAME_POSE_RAD:
            return number
    poses.append(q)
    return len(poses) - 1
