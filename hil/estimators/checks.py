"""Checks of the data before a fit; each check raises one `FitError` with a remedy.

The checks detect data of a different robot, values that are not finite, motor currents without
drive gains, joints that never moved, parameters that the data do not determine, and efforts that no
drive can produce, such as a parser error or a flipped bit in an otherwise good recording. `Needs`
contains the data requirements that can be checked before a robot moves; a planned run is checked
against `Needs` too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hil.arms import arm_names
from hil.core import DataError, FitError, FloatArray
from hil.data import PREPARED, Dataset, require_finite
from hil.dynamics import RobotModel

NO_EFFORT = 1e-12
"""Effort magnitude that counts as zero; smaller than any sensor resolution in any unit."""

STILL_RAD = 1e-3
"""Position range below which a joint counts as not moved [rad]."""


@dataclass(frozen=True, slots=True)
class Needs:
    """Minimum data requirements of a fit or a study.

    The method `Needs.require` raises an error for data that do not meet the requirements. A motion
    program is refused before the robot moves if its recording would not meet the data requirements.

    Attributes:
        least: Minimum counts of the data, with the keys `samples`, `dwells`, `poses` or
            `trajectories`.
        gains: Whether data with motor currents must contain known drive gains.
        effort: Required effort kind, `current` or `torque`; empty if both are accepted.
    """

    least: Mapping[str, int] = field(default_factory=dict)
    gains: bool = False
    effort: str = ""

    def also(self, other: Needs) -> Needs:
        """Return one set of requirements that includes both sets of requirements."""
        words = {**self.least, **other.least}
        most = {what: max(self.least.get(what, 0), other.least.get(what, 0)) for what in words}
        return Needs(most, self.gains or other.gains, self.effort or other.effort)

    def shortages(self, have: Mapping[str, int]) -> list[str]:
        """Return one message for every count that is below its minimum.

        Args:
            have: Available counts of the data, with the same keys as `least`. Counts that are
                missing in `have` are not checked.
        """
        return [
            f"{have[what]} {what} are too few: at least {need} are needed"
            for what, need in self.least.items()
            if have.get(what, need) < need
        ]

    def require(self, **have: int) -> None:
        """Raise if an available count is below its required minimum.

        Raises:
            FitError: An available count is below its required minimum.
        """
        if short := self.shortages(have):
            raise FitError(
                "; ".join(short),
                hint="record more: a longer program, more waypoints or trajectories, more sources",
            )


def gains_fault(
    effort_kind: str, gains: Sequence[float] | FloatArray | None, joint_names: Sequence[str]
) -> tuple[str, str] | None:
    """Return why efforts cannot be converted to torques, and the remedy; None if they can be.

    Args:
        effort_kind: Kind of the effort, `current` or `torque`.
        gains: (n,) drive gains [N·m/A]; None or empty if unknown.
        joint_names: Names of the n joints.
    """
    if effort_kind == "torque":
        return None
    if gains is None or not len(gains):
        return (
            "the effort is a motor current [A], but the drive gains [N·m/A] are unknown, so it "
            "cannot be converted to torque",
            "add drive_gains_nm_a and drive_gains_source to the import map or the station",
        )
    wrong = [
        f"{name} has {gain:g}"
        for name, gain in zip(joint_names, gains, strict=False)
        if not (np.isfinite(gain) and gain > 0)
    ]
    if not wrong:
        return None
    return (
        f"drive gains [N·m/A] must be finite and above 0, but {', '.join(wrong)}",
        "correct drive_gains_nm_a of the import map or the station; if a current has the "
        "opposite sign, give its effort the scale -1 in the import map",
    )


def torque_scale(dataset: Dataset) -> FloatArray:
    """Return (n,) the torque per unit of effort.

    The torque per unit of effort is 1 for torques and the drive gain [N·m/A] for currents.

    Raises:
        FitError: The effort is a current and its drive gains are unknown or invalid.
    """
    fault = gains_fault(dataset.effort_kind, dataset.drive_gains, dataset.joint_names)
    if fault is not None:
        raise FitError(fault[0], hint=fault[1])
    if dataset.effort_kind == "torque":
        return np.ones(dataset.n_joints)
    return np.asarray(dataset.drive_gains, dtype=np.float64)


def require_robot(dataset: Dataset, robot: RobotModel) -> None:
    """Raise if the data are of a different robot than the model.

    Raises:
        FitError: Data and model differ in the number or order of their joints, or name different
            built-in arms.
    """
    if dataset.n_joints != robot.n:
        raise FitError(
            f"the data have {dataset.n_joints} joints, the robot model {robot.name} has {robot.n}",
            hint="choose the model of the robot that the data were recorded on (--robot)",
        )
    ours, theirs = dataset.joint_names, tuple(robot.joint_names)
    if set(ours) == set(theirs) and ours != theirs:
        raise FitError(
            f"the data list the joints as {', '.join(ours)}, the model as {', '.join(theirs)}",
            hint="import the recording again with the joint order of the model",
        )
    built_in = set(arm_names())
    if {dataset.robot, robot.name} <= built_in and dataset.robot != robot.name:
        raise FitError(
            f"the data were recorded on a {dataset.robot}, but the model is a {robot.name}",
            hint=f"use --robot {dataset.robot}",
        )


def require_clean(dataset: Dataset, columns: Sequence[str]) -> None:
    """Raise if a required column contains NaN or infinity, or if the effort is 0 throughout.

    The filtered columns of a prepared dataset are checked too.

    Raises:
        FitError: A value is not finite, or no effort was measured.
    """
    filtered = [name for name in PREPARED if name in dataset.columns]
    for name in (*columns, *filtered):
        try:
            require_finite(name, dataset[name])
        except DataError as error:
            raise FitError(error.message, hint=error.hint) from error
    if "effort" in columns and len(dataset) and not np.any(np.abs(dataset["effort"]) > NO_EFFORT):
        raise FitError(
            "the effort is 0 in every row and joint, so none was measured",
            hint="check the columns of `effort` in the import map, or the quantity that the "
            "driver reads",
        )


def require_motion(dataset: Dataset, joints: Sequence[int] | None = None) -> None:
    """Raise if a joint does not move during the whole dataset.

    Args:
        dataset: Dataset with at least one row.
        joints: Indices of the joints that must move, from 0; all joints by default.

    Raises:
        FitError: The position of a joint never changed.
    """
    q = dataset["q"]
    chosen = range(dataset.n_joints) if joints is None else joints
    still = [j for j in chosen if np.ptp(q[:, j]) < STILL_RAD]
    if still:
        names = ", ".join(dataset.joint_names[j] for j in still)
        raise FitError(
            f"{names} never moved in the training data, so the parameters cannot be separated",
            hint="add a recording in which every joint moves",
        )


def require_varied(change: FloatArray, span: FloatArray, names: Sequence[str]) -> None:
    """Raise if a column of the regressor has the same value at every pose.

    Args:
        change: (p,) observed change of each regressor column over the data.
        span: (p,) largest possible change of each regressor column.
        names: Names of the p parameters.

    Raises:
        FitError: A regressor column is constant, so its parameter cannot be separated from the
            offset.
    """
    constant = [name for name, c, s in zip(names, change, span, strict=True) if c <= STILL_RAD * s]
    if constant:
        raise FitError(
            f"the regressor of {', '.join(constant[:3])} is the same at every pose, so the "
            "parameter cannot be separated from the offset",
            hint="record poses that differ in more joints, and not all by the same angles",
        )


def require_rank(
    rank: int, condition: float, names: Sequence[str], regressor: FloatArray, highest: float = 1e7
) -> None:
    """Raise if the data leave parameters undetermined; the message names the least determined ones.

    Args:
        rank: Number of parameter directions that the data excite.
        condition: Condition number of the column-scaled regressor.
        names: Names of the p parameters.
        regressor: Matrix (m, p) with the same Gram matrix as the regressor.
        highest: Condition number above which a parameter direction counts as not excited.

    Raises:
        FitError: The rank is below p, or the condition number is too high.
    """
    if rank == len(names) and condition <= highest:
        return
    length = np.linalg.norm(regressor, axis=0)
    scaled = regressor / np.where(length > 0, length, 1.0)
    weakest = np.abs(np.linalg.svd(scaled, full_matrices=True)[2][-1])
    weakest[length == 0] = np.inf
    worst = ", ".join(names[i] for i in np.argsort(-weakest)[:3])
    raise FitError(
        f"the data determine only {rank} of {len(names)} parameters "
        f"(condition number {condition:.2g}); least determined: {worst}",
        hint="record motions that excite more: larger amplitudes, more joints at once, "
        "more trajectories or poses",
    )


def require_sizes(model: object, **sizes: int) -> None:
    """Raise if a fitted array from a model file has the wrong number of values.

    Args:
        model: Fitted model with an attribute for each name in `sizes`, followed by `_`.
        **sizes: Required number of values by attribute name, without the final `_`.

    Raises:
        ValueError: An array has the wrong number of values; the message names the array.
    """
    for name, size in sizes.items():
        have = np.size(getattr(model, f"{name}_"))
        if have != size:
            raise ValueError(f"{name}: {have} values where the robot needs {size}")


TIMES_LIMIT = 10.0
"""Multiple of a joint's torque limit that no real effort exceeds, even in a collision."""

DEVIATIONS = 20.0
"""Minimum distance of an outlier from the median, in robust standard deviations.

The outlier check does not detect efforts in a wrong unit, such as milliamperes, because all of them
are too large together.
"""

LEAST_GAIN = 0.1
"""Lower bound of a drive gain behind the gear [N·m/A], used if no gain is declared."""

UNKNOWN_LIMIT_NM = 1e4
"""Assumed torque limit [N·m] of joints without a declared limit; above that of any real arm."""

IMPOSSIBLE = {
    **{"q": 1e6, "qd": 1e6, "effort": 1e12},
    **dict(zip(PREPARED, (1e6, 1e6, 1e9, 1e12), strict=True)),
}
"""Largest physically possible magnitude of each recorded column.

Positions are in rad, velocities in rad/s, accelerations in rad/s² and efforts in any unit.
"""

NORMAL = 1.4826
"""Ratio of standard deviation to median absolute deviation for a normal distribution."""


def require_plausible(dataset: Dataset, robot: RobotModel) -> None:
    """Raise if some effort samples of a recording are physically impossible.

    A single impossible sample changes every parameter of a least-squares fit, and no other check
    detects such a sample.

    Raises:
        FitError: The effort of a joint exceeds ten times its limit and is far from all other
            samples, or a position, velocity or effort exceeds its physically possible range.
    """
    _require_possible(dataset)
    effort = dataset["effort"]
    wild = np.abs(effort) > TIMES_LIMIT * _limit(dataset, robot)
    for joint in np.flatnonzero(wild.any(axis=0)):
        own = effort[:, joint]
        middle = np.median(own)
        deviation = NORMAL * np.median(np.abs(own - middle))
        bad = np.flatnonzero(wild[:, joint] & (np.abs(own - middle) > DEVIATIONS * deviation))
        if len(bad):
            series = dataset.conditions[int(dataset.series_index()[bad[0]])]
            raise FitError(
                f"{len(bad)} effort sample(s) of {dataset.joint_names[joint]} are impossible: the "
                f"first, {own[bad[0]]:.3g} {dataset.effort_unit} in series {series.id}, exceeds "
                f"{TIMES_LIMIT:g} times the maximum effort of the joint",
                hint="leave the series out; for an imported file give the effort a `limit` in the "
                "import map and import it with --drop-bad-rows",
            )


def _require_possible(dataset: Dataset) -> None:
    for name, most in IMPOSSIBLE.items():
        if name not in dataset.columns:
            continue
        # `require_clean` reports values that are not finite.
        values = np.abs(dataset[name])
        for row, joint in np.argwhere(np.isfinite(values) & (values > most))[:1]:
            series = dataset.conditions[int(dataset.series_index()[row])]
            raise FitError(
                f"{name} of {dataset.joint_names[joint]} has the impossible value "
                f"{dataset[name][row, joint]:.3g} (row {row + 1}, series {series.id})",
                hint="check the columns and units of the import map, or leave the series out",
            )


def _limit(dataset: Dataset, robot: RobotModel) -> FloatArray:
    """Return (n,) the effort limit of each joint, in the effort unit of the data."""
    known = np.isfinite(robot.effort_max) & (robot.effort_max > 0)
    torque = np.where(known, robot.effort_max, UNKNOWN_LIMIT_NM)
    if dataset.effort_kind == "torque":
        return torque
    gains = LEAST_GAIN if dataset.drive_gains is None else dataset.drive_gains
    return np.asarray(torque / gains)
