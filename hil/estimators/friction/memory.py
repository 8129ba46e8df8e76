"""Dahl's friction state along a path, for all samples at once.

A joint that turns round does not meet full friction at once: its contacts bend first. Dahl (1968)
lets a state z in [−1, 1] relax towards the sign of the motion with the distance travelled,
dz = (sign(dq) − z)·|dq|/x₀, so that over a step dq it is z ← s + (z − s)·exp(−|dq|/x₀). It depends
on the path alone, never on time: a joint at rest keeps what it had when it stopped. Several
lengths x₀ side by side, each with a coefficient of its own, make any curve of reversal (in the
limit a Prandtl–Ishlinskii or Maxwell-slip model).

Every step is an affine map of z, and affine maps can be composed in pairs: the whole path takes
log₂ N passes over arrays instead of a loop over samples.
"""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray
from hil.data import AT_REST, Dataset


def dahl_states(steps: FloatArray, length: FloatArray) -> FloatArray:
    """State after every step of a path that begins with state 0.

    Args:
        steps: (N, n) way of each joint since the sample before [rad].
        length: (n,) distance in which the state comes round, x₀ [rad].
    """
    kept = np.exp(-np.abs(steps) / length)
    return _composed(kept, np.sign(steps) * (1.0 - kept))


def dahl_slopes(steps: FloatArray, length: FloatArray, states: FloatArray) -> FloatArray:
    """(N, n) derivative of `states` = `dahl_states(steps, length)` by log(length).

    With a = exp(−|dq|/x₀) the derivative obeys z'ₖ = aₖ z'ₖ₋₁ + (zₖ₋₁ − sₖ) aₖ |dqₖ|/x₀.
    """
    way = np.abs(steps) / length
    kept = np.exp(-way)
    before = np.vstack([np.zeros_like(states[:1]), states[:-1]])
    return _composed(kept, (before - np.sign(steps)) * kept * way)


def advanced(state: FloatArray, step: FloatArray, length: FloatArray) -> FloatArray:
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


def _composed(factor: FloatArray, term: FloatArray) -> FloatArray:
    """zₖ = factorₖ zₖ₋₁ + termₖ from z = 0 along axis 0 (Hillis & Steele 1986, inclusive scan)."""
    a, b = factor.copy(), term.copy()
    shift = 1
    while shift < len(b):
        b[shift:] += a[shift:] * b[:-shift]
        a[shift:] *= a[:-shift].copy()
        shift *= 2
    return b
