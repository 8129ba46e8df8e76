"""Friction of an arm at rest as columns: what a joint's way into the pose has left in its gears.

A joint that slides has friction −F·sign(q̇). When it stops, the bristles of Dahl's model (1968) stay
bent, and a slide back by some tenths of a millirad unbends them: with length x the state follows
y ← s + (y − s)·exp(−|Δq|/x), s = sign(Δq), from the positions alone. Several lengths side by side
describe contacts that let go one after the other; their shares are linear parameters. Each share
may grow with the torque the gear transmits and change with temperature.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from hil.core import FloatArray
from hil.data import QD, Q
from hil.estimators.friction_memory import states_at_rest

SMOOTHED = 7
"""Points of a path that a local parabola is fitted to: the encoder's noise is a tenth of what the
slide back is, and Dahl's states would take every noisy step for a small motion."""

GAIN = "gain"


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """Arms at rest, one row each, and how they came there.

    Attributes:
        load: (D, n) torque that gravity and payload take [N·m], as far as it is known beforehand.
        direction: (D, n) +1 from below, −1 from above, 0 unknown.
        paths: (D, K, 2, n) see `hil.data.approach_path`; 0 where unknown.
        warmer: (D, n) joint temperatures less their mean in training [K]; 0 where unknown.
    """

    load: FloatArray
    direction: FloatArray
    paths: FloatArray
    warmer: FloatArray


def coulomb_terms(rest: Rest) -> dict[str, FloatArray]:
    """Dry friction with the sign of the approach, the whole of it and nothing else."""
    return {"coulomb": rest.direction}


def drive_terms(q: FloatArray, load: FloatArray, gear_ratio: float | None) -> dict[str, FloatArray]:
    """Columns (N, n) by name of what the drives do to the current, friction or not.

    Args:
        q: (N, n) where [rad].
        load: (N, n) torque borne [N·m].
        gear_ratio: Motor turns per joint turn, for the ripple of the gear; None for no ripple.

    Returns:
        `gain` (τ: the error of a joint's drive gain beside the other joints'), `square` (τ·|τ|:
        eq. 16 solved for the current, to first order), `ripple…`.
    """
    terms = {GAIN: load, "square": load * np.abs(load)}
    for turns in (1, 2) if gear_ratio is not None else ():
        phase = turns * (gear_ratio or 0.0) * q
        terms |= {f"ripple{turns}_sin": np.sin(phase), f"ripple{turns}_cos": np.cos(phase)}
    return terms


def memory_terms(rest: Rest, lengths_rad: Sequence[float]) -> dict[str, FloatArray]:
    """Columns (D, n) by name: `coulomb` and `memory1…`, and how they go with load and temperature.

    Args:
        rest: What is known of the arms.
        lengths_rad: Lengths x of Dahl's states [rad].
    """
    states = states_at_rest(smooth(rest.paths[:, :, Q]), lengths_rad)
    named = {"coulomb": rest.direction}
    named |= {f"memory{k + 1}": state for k, state in enumerate(states)}
    terms = {}
    for name, state in named.items():
        terms[name] = state
        terms[f"{name}_load"] = state * np.abs(rest.load)
        terms[f"{name}_temperature"] = state * rest.warmer
    return terms


def correction_features(rest: Rest) -> FloatArray:
    """(n, D, F) inputs of the linear correction of each joint.

    Its own path, position and velocity point by point, the position also times its load; and of
    all joints the load, the load with the joint's own direction, the load with its magnitude, and
    the temperature with its own direction: what stopping one joint does to the others.
    """
    position, speed = smooth(rest.paths[:, :, Q], 1), rest.paths[:, :, QD]
    magnitude = np.abs(rest.load)
    shared = np.hstack([rest.load, rest.load * magnitude])
    found = []
    for j in range(rest.load.shape[1]):
        own, side = position[:, :, j], rest.direction[:, [j]]
        columns = (own, speed[:, :, j], own * magnitude[:, [j]], shared)
        found.append(np.hstack([*columns, side * magnitude, side * rest.warmer]))
    return np.stack(found)


def smooth(paths: FloatArray, points: int = SMOOTHED) -> FloatArray:
    """(D, K, n) paths as local parabolas through `points` neighbours have them."""
    if points < 3:
        return paths
    smoothed: FloatArray = savgol_filter(paths, points, 2, axis=1)
    return smoothed
