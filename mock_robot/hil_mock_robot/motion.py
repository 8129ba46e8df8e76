"""What the mock's controller accepts, plays back sample by sample, and brakes."""

from __future__ import annotations

import numpy as np

from hil.core import CommandRefused, FloatArray, IntArray
from hil.robot import Limits, Segment, Status

START_TOLERANCE_RAD = 1e-4
REST_TOLERANCE_RAD_S = 1e-3
RELATIVE_TOLERANCE = 1e-6
"""Planners reach a limit exactly, up to rounding."""
BRAKING_SHARE = 0.5
"""Share of the acceleration limit used to stop."""
LEAST_BRAKING_S = 0.05


class Motion:
    """The commanded set-points: one segment at a time, then holding where it ended.

    Args:
        limits: Joint limits that segments must keep.
        rate_hz: Samples per second.
        q: (n,) position held at first [rad].
    """

    def __init__(self, limits: Limits, rate_hz: float, q: FloatArray) -> None:
        self._limits, self._rate = limits, rate_hz
        self._path = _at_rest(q)[None]
        self._cursor = 1
        self._prepared: Segment | None = None
        self._braking = 0.0
        self.segment = -1

    @property
    def moving(self) -> bool:
        """Whether set-points are left to play."""
        return self._cursor < len(self._path)

    def prepare(self, segment: Segment) -> None:
        """Check the segment and keep it for `start`.

        Raises:
            CommandRefused: It leaves the limits, or does not begin at rest where the arm will be.
        """
        problems = _problems(segment, self._limits, self._rate, self._path[-1, 0])
        if problems:
            raise CommandRefused(
                f"segment {segment.index} ({segment.kind}): " + "; ".join(problems),
                hint="plan the segment from the present q_target and inside the robot's limits",
            )
        self._prepared = segment

    def start(self) -> None:
        """Begin the prepared segment.

        Raises:
            CommandRefused: Nothing is prepared, or the last segment is still running.
        """
        if self._prepared is None:
            raise CommandRefused("start without a prepared segment", hint="call prepare() first")
        if self.moving:
            raise CommandRefused(
                f"segment {self.segment} is still running",
                hint="read until the status says HOLDING, or stop()",
            )
        segment, self._prepared = self._prepared, None
        self._path = np.stack((segment.q, segment.qd, segment.qdd), axis=1).astype(np.float64)
        self._path[-1, 1:] = 0.0
        self._cursor, self._braking, self.segment = 0, 0.0, segment.index

    def take(self, count: int) -> tuple[FloatArray, IntArray]:
        """Up to `count` set-points (k, 3, n) and their status bits (k,).

        They never run past the end of a segment; at rest the last set-point repeats. The sample
        that reaches the last set-point is HOLDING already.
        """
        if not self.moving:
            held = np.repeat(self._path[-1:], count, axis=0)
            return held, np.full(count, int(Status.HOLDING))
        rows = self._path[self._cursor : self._cursor + count]
        self._cursor += len(rows)
        status = np.full(len(rows), int(Status.MOVING))
        if not self.moving:
            status[-1] = int(Status.HOLDING)
        return rows, status

    def brake(self, share: float = BRAKING_SHARE) -> None:
        """Come to rest on the rest of the path: time slows down, the way stays the planned one.

        An arm that brakes as hard already goes on doing so: stopping again prolongs nothing.

        Args:
            share: Of the acceleration limit.
        """
        self._prepared = None
        if not self.moving or self._braking >= share:
            return
        # Before its first sample a segment still is where the last one ended.
        passed = max(self._cursor - 1, 0)
        limit = share * self._limits.qdd_max
        self._replace(_slowed(self._path[passed:], self._rate, limit))
        self._braking = share

    def coast(self, q: FloatArray, qd: FloatArray) -> None:
        """Come to rest from a state (n,), (n,) that no path led to (torque control, a fault)."""
        self._prepared = None
        duration = _braking_time(qd, BRAKING_SHARE * self._limits.qdd_max)
        t = np.arange(1, np.ceil(duration * self._rate) + 1)[:, None] / self._rate
        left = np.clip(1 - t / duration, 0.0, None)
        done = np.minimum(t, duration)
        q_path = q + qd * (done - done**2 / (2 * duration))
        qdd = np.where(left > 0, -qd / duration, 0.0)
        self._replace(np.stack((q_path, qd * left, qdd), axis=1))

    def _replace(self, path: FloatArray) -> None:
        path[-1, 1:] = 0.0
        self._path, self._cursor, self._braking = path, 0, 0.0


def _at_rest(q: FloatArray) -> FloatArray:
    return np.stack((q, np.zeros_like(q), np.zeros_like(q)))


def _braking_time(qd: FloatArray, deceleration: FloatArray) -> float:
    return max(LEAST_BRAKING_S, float(np.max(np.abs(qd) / deceleration)))


def _slowed(path: FloatArray, rate: float, deceleration: FloatArray) -> FloatArray:
    """The path (M, 3, n) from its row 0 on, played ever slower until it stands still.

    The pace falls linearly from 1 to 0, so a joint at speed v decelerates by v / duration.
    """
    duration = _braking_time(path[0, 1], deceleration)
    t = np.minimum(np.arange(1, np.ceil(duration * rate) + 1) / rate, duration)
    pace = 1 - t / duration
    progress = (t - t**2 / (2 * duration)) * rate
    q, qd, qdd = _between_samples(path, np.minimum(progress, len(path) - 1), rate)
    pace = pace[:, None]
    return np.stack((q, qd * pace, qdd * pace**2 - qd / duration), axis=1)


def _between_samples(
    path: FloatArray, at: FloatArray, rate: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cubic interpolation of a path at fractional rows `at`; accelerations are linear."""
    row = np.minimum(at.astype(np.int64), max(len(path) - 2, 0))
    after = np.minimum(row + 1, len(path) - 1)
    s = (at - row)[:, None]
    q0, v0, a0 = path[row, 0], path[row, 1] / rate, path[row, 2]
    q1, v1, a1 = path[after, 0], path[after, 1] / rate, path[after, 2]
    quadratic, cubic = 3 * (q1 - q0) - 2 * v0 - v1, v0 + v1 - 2 * (q1 - q0)
    q = q0 + s * (v0 + s * (quadratic + s * cubic))
    qd = (v0 + s * (2 * quadratic + 3 * s * cubic)) * rate
    return q, qd, a0 + s * (a1 - a0)


def _problems(segment: Segment, limits: Limits, rate: float, start: FloatArray) -> list[str]:
    """Everything that speaks against a segment."""
    shape = segment.q.shape
    if (
        shape[1:] != start.shape
        or shape[0] < 1
        or not shape == segment.qd.shape == segment.qdd.shape
    ):
        return [f"q, qd, qdd must all be (N, {len(start)}), not {shape}"]
    if not all(np.isfinite(a).all() for a in (segment.q, segment.qd, segment.qdd)):
        return ["a set-point is not a finite number"]
    found = _range_problems(segment, limits, rate)
    gap = np.abs(segment.q[0] - start)
    if gap.max() > START_TOLERANCE_RAD:
        j = int(gap.argmax())
        found.append(f"joint {j + 1} starts {np.degrees(gap[j]):.3f}° away from where the arm is")
    # The first set-point is one period after rest, so it may already carry one period's speed.
    first = np.abs(segment.qd[0]) - limits.qdd_max / rate
    if max(first.max(), np.abs(segment.qd[-1]).max()) > REST_TOLERANCE_RAD_S:
        found.append("it must start and end at rest")
    if segment.kind == "hold" and shape[0] != 1:
        found.append("a hold has one set-point")
    return found


def _range_problems(segment: Segment, limits: Limits, rate: float) -> list[str]:
    wide = 1 + RELATIVE_TOLERANCE
    span = RELATIVE_TOLERANCE * (limits.q_max - limits.q_min)
    steps = np.abs(np.diff(segment.q, axis=0)) * rate
    checks = (
        ("leaves its position range", (segment.q < limits.q_min - span).any(axis=0)),
        ("leaves its position range", (segment.q > limits.q_max + span).any(axis=0)),
        ("exceeds its speed limit", (np.abs(segment.qd) > limits.qd_max * wide).any(axis=0)),
        ("jumps faster than its speed limit", (steps > limits.qd_max * wide).any(axis=0)),
        (
            "exceeds its acceleration limit",
            (np.abs(segment.qdd) > limits.qdd_max * wide).any(axis=0),
        ),
    )
    return [f"joint {j + 1} {what}" for what, bad in checks for j in np.flatnonzero(bad)]
