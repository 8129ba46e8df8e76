"""Computation of Dahl's friction state from the path of a joint.

A joint that reverses does not reach full friction immediately, because its contacts bend first.
Dahl (1968) describes the bending of the contacts by a state z in [−1, 1] that relaxes towards the
sign of the motion with the travelled distance: dz = (sign(dq) − z)·|dq|/x₀. A step dq therefore
changes z to s + (z − s)·exp(−|dq|/x₀), with s = sign(dq). The state depends on the path alone and
not on time; a joint at rest keeps its state. Several lengths x₀, each with a separate coefficient,
can describe any reversal curve (in the limit a Prandtl–Ishlinskii or Maxwell-slip model).

The friction state is computed by the cheapest of four methods:

- `dahl_states` computes the friction states of a recording. Every step of a path is an affine map
  of z; because affine maps can be composed in pairs, the whole path takes log₂ N passes over arrays
  instead of a loop over samples.
- `Pieces` is for a search over the length x₀. Between two reversals, the state has a closed form;
  an evaluation therefore takes one exponential per sample and a loop over reversals.
- `states_at_rest` computes the states of a static arm from the last points of the path into the
  pose.
- `advanced` computes the state sample by sample (`hil.estimators.streaming`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.data import AT_REST, Dataset


def dahl_states(steps: FloatArray, length: FloatArray) -> FloatArray:
    """Return (N, n) the state after every step of a path that begins with the state 0.

    Args:
        steps: (N, n) displacement of each joint since the previous sample [rad].
        length: (n,) relaxation length x₀ of the state [rad].
    """
    kept = np.exp(-np.abs(steps) / length)
    return _composed(kept, np.sign(steps) * (1.0 - kept))


def _composed(factor: FloatArray, term: FloatArray) -> FloatArray:
    """Return the solution of zₖ = factorₖ zₖ₋₁ + termₖ along axis 0, starting from z = 0.

    The solution is computed by the inclusive scan of Hillis & Steele (1986).
    """
    a, b = factor.copy(), term.copy()
    shift = 1
    while shift < len(b):
        b[shift:] += a[shift:] * b[:-shift]
        a[shift:] *= a[:-shift].copy()
        shift *= 2
    return b


def path_steps(dataset: Dataset) -> FloatArray:
    """Return (N, n) the displacement of each joint since the previous sample [rad].

    The displacement is 0 at the first sample of a series. The displacements are the integrals of
    the filtered velocity of the prepared dataset. Measured positions are not used, because their
    noise is a random walk for the state and would erase the memory at rest. If the measured
    velocity of a joint is exactly 0, as controllers report for a held joint, the displacement is 0
    too.
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
    """Return the friction state after one more step.

    All arguments are (n,) or broadcast together.
    """
    sign, kept = np.sign(step), np.exp(-np.abs(step) / length)
    return np.asarray(sign + (state - sign) * kept)


def carried_step(q: FloatArray, last: FloatArray | None, qd: FloatArray) -> FloatArray:
    """Return the displacement since the last sample of a stream [rad], in the shape of the inputs.

    Noise of the measured position would erase the memory of the friction state. A displacement is
    therefore only used if it has the sign of the velocity, and is 0 if the velocity is exactly 0.
    """
    if last is None:
        return np.zeros_like(q)
    way = q - last
    return np.where(way * qd > 0.0, way, 0.0)


def states_at_rest(paths: FloatArray, lengths_rad: Sequence[float]) -> list[FloatArray]:
    """Return (D, n) Dahl's state of a static joint for each length, between −1 and 1.

    Args:
        paths: (D, K, n) positions relative to the rest position [rad]. Every joint slides at the
            start of its path and ends at the rest position 0.
        lengths_rad: Relaxation lengths of the states [rad].
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
    """Path of one joint with N steps, divided into G pieces without reversal.

    In a piece of the path with direction s, the state is z = s + (z₀ − s)·exp(−way/x₀).

    Attributes:
        direction: (G,) direction of each piece: +1, −1, or 0 for a series without motion.
        length: (G,) length of each piece [rad].
        fresh: (G,) mask of the pieces that are the first of a series; their initial state is 0.
        number: (N,) index of the piece to which every step belongs.
        way: (N,) distance travelled since the start of the piece, including the step [rad].
    """

    direction: FloatArray
    length: FloatArray
    fresh: BoolArray
    number: IntArray
    way: FloatArray

    @classmethod
    def of(cls, steps: FloatArray, series: tuple[slice, ...]) -> Pieces:
        """Return the pieces of the steps (N,) [rad] of all series."""
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
        """Return the same path for an evaluation after every k-th step only."""
        return replace(self, number=self.number[::k].copy(), way=self.way[::k].copy())

    def state(self, length: float) -> tuple[FloatArray, FloatArray]:
        """Return Dahl's state (N,) after every step, and its derivative ∂/∂log(length)."""
        begin, slope = self._beginnings(length)
        gap = begin - self.direction
        share = self.way / length
        kept = np.exp(-share)
        state = self.direction[self.number] + gap[self.number] * kept
        return state, (slope[self.number] + gap[self.number] * share) * kept

    def _beginnings(self, length: float) -> tuple[FloatArray, FloatArray]:
        """Return (G,) the friction state at the start of every piece, and its derivative."""
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
    """Return the signs (N,) with each 0 replaced by the previous sign of the series, if any."""
    known = np.where((sign != 0) | starts, np.arange(len(sign)), 0)
    return np.asarray(sign[np.maximum.accumulate(known)])
