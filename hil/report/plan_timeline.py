"""A plan unrolled over time, for drawing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hil.core import FloatArray
from hil.dynamics import load_model
from hil.planning import Plan, Step

PLACES = 2000
"""Flange positions that are drawn at most."""


class Span(NamedTuple):
    """A measuring step: from `begin` to `end` [s], with its approach and number."""

    begin: float
    end: float
    approach: int
    step: Step


@dataclass(frozen=True, eq=False)
class Timeline:
    """Set-points over estimated time.

    Attributes:
        t: (N,) [s].
        q: (N, n) [rad].
        spans: The measuring steps in order.
        duration_s: Of the whole plan.
        rate_hz: Of the plan.
    """

    t: FloatArray
    q: FloatArray
    spans: tuple[Span, ...]
    duration_s: float
    rate_hz: float

    def marks(self, joint: int) -> tuple[FloatArray, FloatArray]:
        """Time [s] and angle [rad] of every dwell of one joint."""
        held = [span for span in self.spans if span.step.kind in ("dwell", "reference")]
        times = np.array([(span.begin + span.end) / 2 for span in held])
        angles = [span.step.motion.q_end[joint] for span in held if span.step.motion]
        return times, np.array(angles)

    def trajectories(self, joint: int, points: int) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Time [s] and angle [rad] of one joint along each trajectory, about `points` of them."""
        for span in self.spans:
            if span.step.kind == "trajectory" and span.step.motion is not None:
                samples = span.step.motion.sample(points / (span.end - span.begin))
                yield span.begin + samples.t, samples.q[:, joint]

    def close_up(self, length_s: float) -> tuple[float, float]:
        """Begin and end [s] of the first trajectory, or of `length_s` from the first dwell on."""
        if not self.spans:
            return 0.0, self.duration_s
        first = next((s for s in self.spans if s.step.kind == "trajectory"), self.spans[0])
        length = max(length_s, first.end - first.begin)
        return max(0.0, first.begin - 1.0), min(self.duration_s, first.begin - 1.0 + length)

    def flange_places(self, plan: Plan) -> FloatArray:
        """(M, 3) flange positions [m] at measured poses, thinned."""
        measured = [span.step.motion for span in self.spans if span.step.motion]
        if not measured:
            return np.empty((0, 3))
        q = np.concatenate([m.sample(plan.rate_hz).q for m in dict.fromkeys(measured)])
        thinned = q[:: max(1, len(q) // PLACES)]
        return load_model(plan.robot_model).flange_pose(thinned)[:, :3, 3]


def timeline_of(plan: Plan) -> Timeline:
    """Unroll `plan`; dwells take their estimated time."""
    times, positions, spans = [np.zeros(1)], [plan.q_start[None]], list[Span]()
    now = 0.0
    for step in plan:
        if step.motion is None:
            continue
        length = plan.step_duration_s(step)
        if step.measures:
            spans.append(Span(now, now + length, step.approach, step))
        samples = step.motion.sample(plan.rate_hz)
        times.append(now + samples.t if len(samples) > 1 else np.array([now + length]))
        positions.append(samples.q)
        now += length
    return Timeline(
        np.concatenate(times), np.concatenate(positions), tuple(spans), now, plan.rate_hz
    )
