"""Dahl's friction state: what a joint's way so far has left in its gears.

A joint that turns round does not meet full friction at once: its contacts bend first. Dahl (1968)
lets a state z in [−1, 1] relax towards the sign of the motion with the distance travelled, dz =
(sign(dq) − z)·|dq|/x₀, so that over a step dq it is z ← s + (z − s)·exp(−|dq|/x₀), s = sign(dq). It
depends on the path alone, never on time: a joint at rest keeps what it had when it stopped. Several
lengths x₀ side by side, each with a coefficient of its own, make any curve of reversal (in the
limit a Prandtl–Ishlinskii or Maxwell-slip model).

The same state is evaluated in four ways, each where it is the cheapest:

- `dahl_states` for a recording. Every step is an affine map of z, and affine maps can be composed
  in pairs: the whole path takes log₂ N passes over arrays instead of a loop over samples.
- `Pieces` for a search over the length x₀. Between two reversals the state has a closed form,
  whatever the steps, so that a trial costs one exponential per sample and a loop over reversals.
- `states_at_rest` for arms that stand, from the last few points of their way into the pose.
- `advanced` for one sample after the other (`hil.estimators.streaming`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.data import AT_REST, Dataset


def dahl_states(steps: FloatArray, length: FloatArray) -> FloatArray:
    """State after every step of a path that begins with state 0.

    Args:
        steps: (N, n) way of each joint since the sample before [rad].
        length: (n,) distance in which the state comes round, x₀ [rad].
    """
    kept = np.exp(-np.abs(steps) / length)
    return _composed(kept, np.sign(steps) * (1.0 - kept))


def _composed(factor: FloatArray, term: FloatArray) -> FloatArray:
    """zₖ = factorₖ zₖ₋₁ + termₖ from z = 0 along axis 0 (Hillis & Steele 1986, inclusive scan)."""
    a, b = factor.copy(), term.copy()
    shift = 1
    while shift < len(b):
        b[shift:] += a[shift:] * b[:-shift]
        a[shift:] *= a[:-shift].copy()
        shift *= 2
    return b


def path_steps(dataset: Dataset) -> FloatArray:
    """(N, n) way of each joint since the sample before, 0 where a series begins [rad].

    The prepared dataset's filtered velocity is summed up: position noise, a random walk for the
    state, would wear the memory away at rest. Controllers report a velocity of exactly 0 for a
    joint that holds; there the path stands still as well.
    """
    steps = np.zeros_like(dataset["q"])
    for condition, rows in dataset.slices():
        if condition.kind in AT_REST or rows.stop - rows.start < 2:
            continue
        speed = dataset["qd_f"][rows]
        if "qd" in dataset.columns:
            speed = np.where(dataset["qd"][rows] == 0.0, 0.0, speed)
        dt = np.diff(dataset["t"][rows])
        steps[rows][1:] = 0.5 * (speed[1:] + speed[:-1]) * dt[:, None]
    return steps


def advanced(state: FloatArray, step: FloatArray, length: FloatArray | float) -> FloatArray:
    """The state after one more step; all (n,) or broadcast alike."""
    sign, kept = np.sign(step), np.exp(-np.abs(step) / length)
    return np.asarray(sign + (state - sign) * kept)


def carried_step(q: FloatArray, last: FloatArray | None, qd: FloatArray) -> FloatArray:
    """Way since the last sample in a stream [rad]; shaped as its inputs.

    Noise of positions would wear the memory away: only what goes with the velocity counts, and
    nothing while it is exactly 0.
    """
    if last is None:
        return np.zeros_like(q)
    way = q - last
    return np.where(way * qd > 0.0, way, 0.0)


def states_at_rest(paths: FloatArray, lengths_rad: Sequence[float]) -> list[FloatArray]:
    """Dahl's state (D, n) at rest for each length, between −1 and 1.

    Args:
        paths: (D, K, n) positions relative to the place of rest [rad]; every joint slides when its
            path begins, and comes to 0 at the end.
        lengths_rad: Lengths [rad].
    """
    steps = np.diff(np.concatenate([paths, np.zeros_like(paths[:, :1])], axis=1), axis=1)
    found = []
    for length in lengths_rad:
        state = -np.sign(paths[:, 0])
        for k in range(steps.shape[1]):
            state = advanced(state, steps[:, k], length)
        found.append(state)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """A joint's way of N steps in G pieces without reversal.

    Within a piece travelled in direction s the state is z = s + (z₀ − s)·exp(−way/x₀).

    Attributes:
        direction: (G,) +1, −1, or 0 for a series without any motion.
        length: (G,) of each piece [rad].
        fresh: (G,) true where a series begins, whose state is 0.
        number: (N,) the piece of every step.
        way: (N,) travelled since the piece began, the step included [rad].
    """

    direction: FloatArray
    length: FloatArray
    fresh: BoolArray
    number: IntArray
    way: FloatArray

    @classmethod
    def of(cls, steps: FloatArray, series: tuple[slice, ...]) -> Pieces:
        """Those of the steps (N,) [rad] of all series."""
        starts = np.zeros(len(steps), dtype=bool)
        starts[[rows.start for rows in series]] = True
        direction = _held(np.sign(steps), starts)
        begins = starts.copy()
        begins[1:] |= direction[1:] != direction[:-1]
        first = np.flatnonzero(begins)
        number = np.cumsum(begins) - 1
        travelled = np.cumsum(np.abs(steps))
        way = travelled - (travelled[first] - np.abs(steps[first]))[number]
        last = np.append(first[1:], len(steps))[: len(first)] - 1
        return cls(direction[first], way[last], starts[first], number, way)

    def every(self, k: int) -> Pieces:
        """The same way, known after every k-th step only."""
        return replace(self, number=self.number[::k].copy(), way=self.way[::k].copy())

    def state(self, length: float) -> tuple[FloatArray, FloatArray]:
        """Dahl's state (N,) after every step and its derivative by log(length)."""
        begin, slope = self._beginnings(length)
        gap = begin - self.direction
        share = self.way / length
        kept = np.exp(-share)
        state = self.direction[self.number] + gap[self.number] * kept
        return state, (slope[self.number] + gap[self.number] * share) * kept

    def _beginnings(self, length: float) -> tuple[FloatArray, FloatArray]:
        """(G,) state at the beginning of every piece, and its derivative."""
        share = self.length / length
        kept = np.exp(-share)
        begin, slope = np.zeros(len(kept)), np.zeros(len(kept))
        z = dz = 0.0
        rows = zip(self.fresh.tolist(), self.direction.tolist(), share.tolist(), kept.tolist(),
                   strict=True)  # fmt: skip
        for g, (fresh, s, x, a) in enumerate(rows):
            if fresh:
                z = dz = 0.0
            begin[g], slope[g] = z, dz
            z, dz = s + (z - s) * a, (dz + (z - s) * x) * a
        return begin, slope


def _held(sign: FloatArray, starts: BoolArray) -> FloatArray:
    """Signs (N,) with 0 replaced by what was before it in the series, if anything was."""
    known = np.where((sign != 0) | starts, np.arange(len(sign)), 0)
    return np.asarray(sign[np.maximum.accumulate(known)])
