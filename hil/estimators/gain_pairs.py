"""Dwells at the same pose, approached the same way, under different loads.

An arm whose controller gives way stands a little lower with a load, and its own weight then pulls
differently, always in the same sense. The robot model says by how much, so that is taken into
account; at `SAME_POSE_RAD` it is up to 3 % of what a load adds, and masses that are a tenth wrong
leave a tenth of that.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hil.arms import Payload
from hil.core import FitError, FloatArray, IntArray
from hil.data import Dataset, series_means
from hil.dynamics import RobotModel

SAME_POSE_RAD = 0.01
"""Positions further apart are another pose."""

ONE_SIDED = (
    "poses were not approached from both sides: friction that grows with the load is part of the "
    "gains, a few percent of them; record with approach: both"
)


@dataclass(frozen=True, slots=True, eq=False)
class GainPairs:
    """What a load adds to the lightest one, a row per pose and load (approaches averaged).

    Attributes:
        torque: (N, n) by the load's mass and centre, and by the arm's weight where the load made
            it stand elsewhere [N·m].
        current: (N, n) measured [A].
        square: (N, n) the same of i²·sign(i) [A²].
        instrument: (N, n) the same of τ·abs(τ), τ by the robot model at rest [N²·m²].
        pose: (N,) number of the pose.
        added: (n,) the most that the loads themselves add [N·m].
        largest: (n,) largest current [A].
        masses: The loads [kg], ascending.
        both_sides: Whether every row is the mean of both approaches.
        notes: For people.
    """

    torque: FloatArray
    current: FloatArray
    square: FloatArray
    instrument: FloatArray
    pose: IntArray
    added: FloatArray
    largest: FloatArray
    masses: tuple[float, ...]
    both_sides: bool
    notes: tuple[str, ...]


def paired(dwells: Dataset, robot: RobotModel) -> GainPairs:
    """Pair the dwells of each heavier load with those of the lightest one.

    Raises:
        FitError: All dwells are under the same load.
    """
    loads = sorted({c.payload for c in dwells.conditions}, key=lambda load: (load.mass, load.com))
    if len(loads) < 2:
        have = f"{loads[0].mass:g} kg" if loads else "no dwells"
        raise FitError(
            f"gains need the same poses under at least two loads, the data have {have} only",
            hint="give the spec two `loads`, or fit both recordings together",
        )
    q, current = (series_means(dwells, dwells[name]) for name in ("q", "effort"))
    levels = np.stack([_torque(robot, q, load) for load in loads])
    number = {load: k for k, load in enumerate(loads)}
    load = np.array([number[c.payload] for c in dwells.conditions])
    own = levels[load, np.arange(len(load))]
    whole = own + robot.gravity(q)
    values = np.stack(
        [whole, current, current * np.abs(current), whole * np.abs(whole), own], axis=1
    )
    at = _poses(q)
    rows, poses, sides = _differences(dwells, at, load, values)
    # Approached from both sides: +1 and −1. Where nobody knows, a pose has the approach 0 only.
    both = 2 in sides
    kept = [k for k, count in enumerate(sides) if count == (2 if both else 1)]
    stacked = np.array([rows[k] for k in kept]).reshape(-1, 5, dwells.n_joints)
    torque, amps, square, instrument, by_load = stacked.transpose(1, 0, 2)
    masses = tuple(load.mass for load in loads)
    pose = np.array([poses[k] for k in kept], dtype=np.int64)
    added, largest = (np.max(np.abs(x), axis=0, initial=0.0) for x in (by_load, current))
    notes = (*(() if both else (ONE_SIDED,)), *_left_out(set(at), set(pose.tolist()), both))
    return GainPairs(torque, amps, square, instrument, pose, added, largest, masses, both, notes)


def _left_out(measured: set[int], used: set[int], both: bool) -> Iterator[str]:
    """A note when there are poses that tell nothing."""
    lost = len(measured - used)
    if lost:
        sides = "from both sides " if both else "the same way "
        yield (
            f"{lost} of {len(measured)} poses are left out: they were not approached {sides}with "
            "the lightest and with a heavier load"
        )


def _differences(
    dwells: Dataset, poses: list[int], load: IntArray, values: FloatArray
) -> tuple[list[FloatArray], list[int], list[int]]:
    """Per pose and heavier load: difference of `values`, pose, and how many approaches."""
    at: dict[tuple[int, int], dict[int, int]] = {}
    for series, (pose, condition) in enumerate(zip(poses, dwells.conditions, strict=True)):
        # Of a dwell that was measured again in a later attempt, the last one counts.
        at.setdefault((pose, condition.approach), {})[int(load[series])] = series
    found: dict[tuple[int, int], list[FloatArray]] = {}
    for (pose, _), under in at.items():
        for heavier in sorted(under.keys() - {0} if 0 in under else ()):
            rise = values[under[heavier]] - values[under[0]]
            found.setdefault((pose, heavier), []).append(rise)
    rows = [np.mean(each, axis=0) for each in found.values()]
    return rows, [pose for pose, _ in found], [len(each) for each in found.values()]


def _poses(q: FloatArray) -> list[int]:
    """Number of the pose each dwell is at; recordings of different loads number theirs apart."""
    known = np.empty_like(q)
    numbers: list[int] = []
    count = 0
    for where in q:
        near = np.flatnonzero(np.max(np.abs(known[:count] - where), axis=1) < SAME_POSE_RAD)
        if not len(near):
            known[count], near, count = where, np.array([count]), count + 1
        numbers.append(int(near[0]))
    return numbers


def _torque(robot: RobotModel, q: FloatArray, load: Payload) -> FloatArray:
    if load.is_empty:
        return np.zeros_like(q)
    still = np.zeros_like(q)
    return robot.payload_effort(load, q, still, still)
