"""Drive gains from loads of known mass: torque per motor current, joint by joint.

The arm stands in the same poses with and without a known load. What the load adds to a joint's
torque follows from its mass, its centre and the positions; what it adds to the current is
measured. Everything else cancels in the difference: the arm's own gravity, offsets, and the
friction that a dwell is left with, which the same pose approached the same way leaves nearly alike.

Friction that grows with the transmitted torque does not cancel: approached from below, a joint
holds a few percent of the load by friction, from above as many percent more by current. The mean of
both approaches is free of it; with one approach only, it stays in the gain and a note says so.

Currents carry the noise, torques are exact. Torque regressed on current would give gains that are
too small; so the torques serve as instruments (two-stage least squares): for eq. 16 differenced,
Δτ = K₁·Δi + K₂·Δ(i²·sign i), they are Δτ itself and Δ(τ̂·abs(τ̂)) of the robot model's own τ̂.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from hil.core import BoolArray, FitError, FloatArray
from hil.data import Dataset, dwells_of
from hil.dynamics import RobotModel
from hil.estimators.checks import require_clean, require_robot
from hil.estimators.gain_lines import gain_lines, listed
from hil.estimators.gain_pairs import GainPairs, paired
from hil.estimators.least_squares import instrumental
from hil.estimators.plausible import require_plausible

LEAST_POSES = 5
LEAST_TORQUE = 0.01
"""Torques below this [N·m] are rounding of the load's geometry."""

NO_TORQUE = (
    "the loads add no torque about its axis: it is vertical, or goes through their centres of mass"
)

MOST_ERROR = 0.05
"""Relative standard error of a gain beyond which it is not called determined. A gain that passes is
twenty standard errors away from 0."""

NOT_POSITIVE = (
    "the current falls where the loads' torque rises: the current or the joint counts in the other "
    "direction than the robot model, or the mass or centre of a load is wrong"
)

MOST_BEND_ERROR = 0.03
"""Standard error of K₂·i at the largest current, as a share of the gain; beyond it K₂ says nothing
about a drive, which bends by a few percent."""


@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """Torque per current of every joint, NaN where the loads do not tell.

    Attributes:
        joint_names: Length n.
        gain: (n,) torque the loads add per current they add [N·m/A]: what a linear model needs.
        gain_error: (n,) its standard error, clustered by pose, given exact loads.
        k1, k1_error: (n,) K₁ of eq. 16, the gain at no current [N·m/A].
        k2, k2_error: (n,) K₂ of eq. 16 [N·m/A²].
        reasons: Why a joint's gain is not determined; empty where it is.
        masses: The loads [kg].
        poses: How many poses were compared.
        both_sides: Whether each was approached from both sides.
        declared: (n,) gains the recording declares, or None.
        notes: What else to know, for people.
    """

    method: ClassVar[str] = "known-loads"

    joint_names: tuple[str, ...]
    gain: FloatArray
    gain_error: FloatArray
    k1: FloatArray
    k1_error: FloatArray
    k2: FloatArray
    k2_error: FloatArray
    reasons: tuple[str, ...]
    masses: tuple[float, ...]
    poses: int
    both_sides: bool
    declared: FloatArray | None
    notes: tuple[str, ...] = ()

    @property
    def determined(self) -> BoolArray:
        """(n,) which gains the loads tell."""
        return np.array([not reason for reason in self.reasons], dtype=bool)

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil gains --json`; what is not determined is null."""
        return {
            "method": self.method,
            "joint_names": list(self.joint_names),
            "gain_nm_a": listed(self.gain),
            "gain_error_nm_a": listed(self.gain_error),
            "k1_nm_a": listed(self.k1),
            "k1_error_nm_a": listed(self.k1_error),
            "k2_nm_a2": listed(self.k2),
            "k2_error_nm_a2": listed(self.k2_error),
            "not_determined": {
                name: reason
                for name, reason in zip(self.joint_names, self.reasons, strict=True)
                if reason
            },
            "masses_kg": list(self.masses),
            "poses": self.poses,
            "both_sides": self.both_sides,
            "declared_nm_a": None if self.declared is None else listed(self.declared),
            "yaml": self.yaml_lines(),
            "notes": list(self.notes),
        }

    def yaml_lines(self) -> list[str]:
        """`drive_gains_nm_a` and its source for a station or an import map.

        Joints that were not determined keep the gain the recording declares.
        """
        masses = ", ".join(f"{mass:g}" for mass in self.masses)
        source = f"calibrated with {masses} kg at {self.poses} poses"
        return gain_lines(self.joint_names, self.gain, self.reasons, self.declared, source)


def calibrate_gains(dataset: Dataset, robot: RobotModel) -> Gains:
    """Drive gains from dwells at the same poses under at least two loads of known mass.

    Args:
        dataset: Motor currents; each series' *declared* load is taken as exact.
        robot: Kinematics say what torque a load makes. Masses serve as instruments, and where a
            pose under load is a little off, for what that changes.

    Raises:
        FitError: The efforts are no currents, not finite, of another robot or cannot be; or there
            are not two loads at five poses that were approached the same way.
    """
    if dataset.effort_kind != "current":
        raise FitError(
            f"drive gains are torque per current, the data hold a {dataset.effort_kind}",
            hint="record motor currents",
        )
    require_robot(dataset, robot)
    require_clean(dataset, ("t", "q", "effort"))
    require_plausible(dataset, robot)
    pairs = paired(dwells_of(dataset), robot)
    poses = len(set(pairs.pose.tolist()))
    if poses < LEAST_POSES:
        raise FitError(
            f"{poses} poses with two loads and the same approach are too few: gains need at least "
            f"{LEAST_POSES}, better 40",
            hint="run experiments/ur5_gains.yaml, or the same dwell program with each load",
        )
    joints = [_of_joint(pairs, j) for j in range(dataset.n_joints)]
    return Gains(
        joint_names=dataset.joint_names,
        gain=np.array([joint.gain for joint in joints]),
        gain_error=np.array([joint.gain_error for joint in joints]),
        k1=np.array([joint.k1 for joint in joints]),
        k1_error=np.array([joint.k1_error for joint in joints]),
        k2=np.array([joint.k2 for joint in joints]),
        k2_error=np.array([joint.k2_error for joint in joints]),
        reasons=tuple(joint.reason for joint in joints),
        masses=pairs.masses,
        poses=poses,
        both_sides=pairs.both_sides,
        declared=dataset.drive_gains,
        notes=pairs.notes,
    )


class _Joint(NamedTuple):
    gain: float = np.nan
    gain_error: float = np.nan
    k1: float = np.nan
    k1_error: float = np.nan
    k2: float = np.nan
    k2_error: float = np.nan
    reason: str = ""


def _of_joint(pairs: GainPairs, j: int) -> _Joint:
    torque, most = pairs.torque[:, j], float(pairs.added[j])
    if most < LEAST_TORQUE:
        return _Joint(reason=NO_TORQUE)
    current = pairs.current[:, j, None]
    line = instrumental(current, torque, torque[:, None], pairs.pose)
    gain, error = float(line.coefficients[0]), float(line.std_error[0])
    if not error < MOST_ERROR * abs(gain):
        told = f"{gain:.3g} ± {error:.2g} N·m/A"
        return _Joint(
            reason=f"the loads add at most {most:.2g} N·m, too little against friction: {told}"
        )
    if gain <= 0:
        return _Joint(reason=f"{gain:.3g} ± {error:.2g} N·m/A is not above 0: {NOT_POSITIVE}")
    both = np.column_stack([current, pairs.square[:, j]])
    bent = instrumental(both, torque, np.column_stack([torque, pairs.instrument[:, j]]), pairs.pose)
    (k1, k2), (k1_error, k2_error) = bent.coefficients.tolist(), bent.std_error.tolist()
    if not k2_error * pairs.largest[j] < MOST_BEND_ERROR * gain:
        return _Joint(gain, error)
    return _Joint(gain, error, k1, k1_error, k2, k2_error)
