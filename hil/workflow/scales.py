"""What the weighing dwells of one load add up to, and how that compares with the first load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FloatArray, StructArray
from hil.dynamics import Balance, static_columns, static_parameters
from hil.planning import Step
from hil.robot import Capabilities, Status

if TYPE_CHECKING:
    from hil.dynamics import RobotModel, Weighed

FRICTION_LEFT = 0.05
"""Share of half the difference between the two approaches by which their mean errs (standard
deviation); measured on the mock, see docs/explanation/weighing.md."""

CHANGE_LEFT = 0.5
"""Share of what that half difference has changed by since the first load: friction that one side
alone has lost or gained moves the mean as well, and the arm has become warmer."""

LEAST_NM = 0.01
"""Least standard deviation of a torque [N·m]: a simulation without noise has none."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """The settled samples of one dwell: mean `torque` (n,) [N·m], `variance` (n,) of that mean."""

    torque: FloatArray
    variance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LoadReading:
    """One load at all poses, both approaches put together.

    Attributes:
        torque: (P, n) mean of the two approaches [N·m].
        half_difference: (P, n) of the two approaches: friction [N·m].
        variance: (n,) of `torque`: what friction leaves, and noise [N²·m²].
    """

    torque: FloatArray
    half_difference: FloatArray
    variance: FloatArray


def gains_of(robot: Capabilities) -> FloatArray | float:
    """What turns this robot's efforts into torques: (n,) drive gains [N·m/A], or 1."""
    return np.array(robot.drive_gains) if robot.effort_kind == "current" else 1.0


def reading_of(rows: StructArray, gains: FloatArray | float, settle_rad_s: float) -> Reading:
    """What the settled rows of a dwell say; `gains` (n,) turns efforts into torques.

    Raises:
        DataError: They say nothing that could be relied on.
    """
    usable = rows[(rows["status"] & (Status.MASKED | Status.FAULT)) == 0]
    effort: FloatArray = usable["effort"] * gains
    if not len(usable) or not np.isfinite(effort).all():
        raise DataError(
            "the robot reported no usable effort",
            hint="see whether the drives are on and their effort is recorded",
        )
    if np.abs(usable["qd"]).max() >= settle_rad_s:
        raise DataError(
            "the arm did not come to rest",
            hint="see whether the arm is held, or its noise at rest too large to tell",
        )
    return Reading(effort.mean(axis=0), effort.var(axis=0) / len(usable))


def load_reading(readings: Mapping[tuple[int, int], Reading]) -> LoadReading:
    """The readings of one load by pose and approach (±1), put together."""
    poses = sorted({pose for pose, _ in readings})
    below, above = ([readings[pose, sign] for pose in poses] for sign in (1, -1))
    up, down = (np.array([one.torque for one in side]) for side in (below, above))
    noise = np.mean([one.variance for one in (*below, *above)], axis=0) / 2
    half: FloatArray = (up - down) / 2
    friction = np.mean((FRICTION_LEFT * half) ** 2, axis=0)
    return LoadReading((up + down) / 2, half, friction + noise)


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """A load as weighed, beside what was declared.

    Attributes:
        declared: The load.
        first_kg: Declared mass of the first load, which it is weighed against.
        weighed_kg: Its mass if its centre of mass is where it was declared to be.
        deviation_kg: Standard deviation of that.
        free_kg: Its mass wherever its centre is.
        free_deviation_kg: Standard deviation of that.
        shift_m: (3,) how far the centre of mass is from there, flange frame; NaN without a load.
        shift_deviation_m: Standard deviation along `shift_m`.
        declared_nm, found_nm: (P, n) torque beyond that of the first load.
    """

    declared: Payload
    first_kg: float
    weighed_kg: float
    deviation_kg: float
    free_kg: float
    free_deviation_kg: float
    shift_m: FloatArray
    shift_deviation_m: float
    declared_nm: FloatArray
    found_nm: FloatArray

    @property
    def distance_m(self) -> float:
        """Length of `shift_m`; 0 without a load, which has no centre of mass."""
        return 0.0 if self.declared.is_empty else float(np.linalg.norm(self.shift_m))


def _deviation(first: LoadReading, this: LoadReading) -> FloatArray:
    """(P, n) standard deviation of the difference of two loads' torques, gains left out [N·m]."""
    change = CHANGE_LEFT * (this.half_difference - first.half_difference)
    variance = first.variance + this.variance + change**2
    return np.asarray(np.sqrt(np.maximum(variance, LEAST_NM**2)))


def compare(
    model: RobotModel,
    steps: Sequence[Step],
    loads: tuple[Payload, Payload],
    readings: tuple[LoadReading, LoadReading],
) -> Comparison:
    """Weigh a load against the first one.

    Args:
        model: The arm, mounted as it is.
        steps: The weighing dwells of either load, in order.
        loads: The first load and the one to be weighed, as declared.
        readings: Of these.
    """
    first, load = loads
    at = {step.pose: step.motion.q_end for step in steps if step.motion is not None}
    columns = static_columns(model, np.array([at[pose] for pose in sorted(at)]))
    declared = columns @ (static_parameters(load) - static_parameters(first))
    found: FloatArray = readings[1].torque - readings[0].torque
    deviation = _deviation(*readings)
    # What turns out heavier than declared comes with the gain errors of what it is.
    torque = np.where(np.abs(found) > np.abs(declared), found, declared)
    seen: Weighed = Balance(columns, torque, deviation, load.com).weigh(found - declared)
    per_kg = np.nan if load.is_empty else 1 / load.mass
    return Comparison(
        declared=load,
        first_kg=first.mass,
        weighed_kg=load.mass + seen.mass,
        deviation_kg=seen.mass_deviation,
        free_kg=load.mass + seen.free_mass,
        free_deviation_kg=seen.free_mass_deviation,
        shift_m=seen.moment * per_kg,
        shift_deviation_m=seen.moment_deviation * per_kg,
        declared_nm=declared,
        found_nm=found,
    )
