"""What must hold before a fit: one clear error each, with its remedy.

Every check raises `FitError` with what is missing and how to get it, so that no fit ends in numbers
that mean nothing: data of another robot, values that are not finite, currents without drive gains,
joints that never moved, parameters that the data leave open, and efforts that no drive can have
made (a parser's slip or a flipped bit in a recording that is good otherwise). What can be known
before a robot moves stands in `Needs`, which a run is checked against too.
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
"""Not even the resolution of a sensor, in any unit."""

STILL_RAD = 1e-3
"""A joint whose position spans less than this never moved."""


@dataclass(frozen=True, slots=True)
class Needs:
    """What a fit or a study cannot do without.

    Stated once: `require` refuses data that have less, and a program is refused before it moves
    if its recording would have less.

    Attributes:
        least: Fewest `samples`, `dwells`, `poses` or `trajectories`, by these words.
        gains: Whether motor currents must come with drive gains.
        effort: `current` or `torque` if no other effort will do; empty for either.
    """

    least: Mapping[str, int] = field(default_factory=dict)
    gains: bool = False
    effort: str = ""

    def also(self, other: Needs) -> Needs:
        """Return what both need together."""
        words = {**self.least, **other.least}
        most = {what: max(self.least.get(what, 0), other.least.get(what, 0)) for what in words}
        return Needs(most, self.gains or other.gains, self.effort or other.effort)

    def shortages(self, have: Mapping[str, int]) -> list[str]:
        """Return one message for every amount that is too small; amounts not in `have` pass.

        Args:
            have: Count by the words of `least`.
        """
        return [
            f"{have[what]} {what} are too few: at least {need} are needed"
            for what, need in self.least.items()
            if have.get(what, need) < need
        ]

    def require(self, **have: int) -> None:
        """Raise if an amount is too small.

        Raises:
            FitError: An amount is too small.
        """
        if short := self.shortages(have):
            raise FitError(
                "; ".join(short),
                hint="record more: a longer program, more waypoints or trajectories, more sources",
            )


def gains_fault(
    effort_kind: str, gains: Sequence[float] | FloatArray | None, joint_names: Sequence[str]
) -> tuple[str, str] | None:
    """Return why efforts cannot be converted to torques, and the remedy; None if they can.

    Args:
        effort_kind: `current` or `torque`.
        gains: (n,) drive gains [N·m/A]; None or empty if unknown.
        joint_names: Length n.
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
    """(n,) torque per unit of the recorded effort: 1 for torques, the drive gains for currents.

    Raises:
        FitError: The effort is a current and its drive gains are unknown or cannot be.
    """
    fault = gains_fault(dataset.effort_kind, dataset.drive_gains, dataset.joint_names)
    if fault is not None:
        raise FitError(fault[0], hint=fault[1])
    if dataset.effort_kind == "torque":
        return np.ones(dataset.n_joints)
    return np.asarray(dataset.drive_gains, dtype=np.float64)


def require_robot(dataset: Dataset, robot: RobotModel) -> None:
    """Refuse data of another robot than the model's.

    Raises:
        FitError: The joints differ in number or order, or both name different built-in arms.
    """
    if dataset.n_joints != robot.n:
        raise FitError(
            f"the data have {dataset.n_joints} joints, the robot model {robot.name} has {robot.n}",
            hint="choose the robot model the data were recorded on (--robot)",
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
    """Refuse NaN and infinity in the columns a fit uses, and an effort that is 0 throughout.

    Those of a dataset that was prepared already are looked at too.

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
            hint="look at the columns of `effort` in the import map, or at what the driver reads",
        )


def require_motion(dataset: Dataset, joints: Sequence[int] | None = None) -> None:
    """Refuse data in which a joint stands still from beginning to end.

    Args:
        dataset: At least one row.
        joints: Those that have to move, from 0; all by default.

    Raises:
        FitError: A joint never moved.
    """
    q = dataset["q"]
    chosen = range(dataset.n_joints) if joints is None else joints
    still = [j for j in chosen if np.ptp(q[:, j]) < STILL_RAD]
    if still:
        names = ", ".join(dataset.joint_names[j] for j in still)
        raise FitError(
            f"{names} never moved in the training data, so its parameters cannot be told apart",
            hint="add a recording in which every joint moves",
        )


def require_varied(change: FloatArray, span: FloatArray, names: Sequence[str]) -> None:
    """Refuse columns of a regressor that are the same at every pose.

    Args:
        change: (p,) by how much each column changes over the data.
        span: (p,) by how much it can change.
        names: Length p.

    Raises:
        FitError: A column is constant, so its parameter cannot be told from the offset.
    """
    constant = [name for name, c, s in zip(names, change, span, strict=True) if c <= STILL_RAD * s]
    if constant:
        raise FitError(
            f"the regressor of {', '.join(constant[:3])} is the same at every pose, so the "
            "parameter cannot be told from the offset",
            hint="record poses that differ in more joints, and not all by the same angles",
        )


def require_rank(
    rank: int, condition: float, names: Sequence[str], regressor: FloatArray, highest: float = 1e7
) -> None:
    """Refuse data that leave parameters undetermined, naming those worst off.

    Args:
        rank: Excited directions.
        condition: Condition number of the column-scaled regressor.
        names: Parameter names, length p.
        regressor: Any matrix (m, p) with the regressor's Gram matrix.
        highest: Condition number above which a direction counts as not excited.

    Raises:
        FitError: The rank is short or the condition number too high.
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
    """Refuse fitted arrays of another size than the model needs; for reading model files.

    Args:
        model: Has an attribute with a `_` behind each name.
        **sizes: Name → values there must be.

    Raises:
        ValueError: An array has another size; the message names it.
    """
    for name, size in sizes.items():
        have = np.size(getattr(model, f"{name}_"))
        if have != size:
            raise ValueError(f"{name}: {have} values where the robot needs {size}")


TIMES_LIMIT = 10.0
"""Beyond this multiple of a joint's torque limit nothing is measured, not even in a collision."""

DEVIATIONS = 20.0
"""An outlier lies this many robust deviations from the median; efforts in another unit, such as
milliamperes, are all too large together and not for this check."""

LEAST_GAIN = 0.1
"""Torque per current [N·m/A] behind the gear where none is declared: less is hardly built."""

UNKNOWN_LIMIT_NM = 1e4
"""For models that declare no torque limit: more than any joint's of an arm."""

IMPOSSIBLE = {
    **{"q": 1e6, "qd": 1e6, "effort": 1e12},
    **dict(zip(PREPARED, (1e6, 1e6, 1e9, 1e12), strict=True)),
}
"""Beyond this nothing is a position [rad], velocity [rad/s], acceleration [rad/s²] or effort, in
whatever unit."""

NORMAL = 1.4826
"""Standard deviation of a normal distribution per median absolute deviation."""


def require_plausible(dataset: Dataset, robot: RobotModel) -> None:
    """Refuse recordings in which some samples of the effort cannot be.

    One of them moves every parameter of a fit by least squares, and nothing else would tell.

    Raises:
        FitError: A joint's effort is beyond ten times its limit and far off all others, or a
            position, velocity or effort is beyond everything.
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
                f"{len(bad)} sample(s) of the effort of {dataset.joint_names[joint]} cannot be: "
                f"the first, {own[bad[0]]:.3g} {dataset.effort_unit} in series {series.id}, is "
                f"beyond {TIMES_LIMIT:g} times what the joint can make",
                hint="leave the series out; for an imported file give the effort a `limit` in the "
                "import map and import it with --drop-bad-rows",
            )


def _require_possible(dataset: Dataset) -> None:
    for name, most in IMPOSSIBLE.items():
        if name not in dataset.columns:
            continue
        # `require_clean` reports what is not finite.
        values = np.abs(dataset[name])
        for row, joint in np.argwhere(np.isfinite(values) & (values > most))[:1]:
            series = dataset.conditions[int(dataset.series_index()[row])]
            raise FitError(
                f"{name} of {dataset.joint_names[joint]} cannot be {dataset[name][row, joint]:.3g} "
                f"(row {row + 1}, series {series.id})",
                hint="look at the columns and units of the import map, or leave the series out",
            )


def _limit(dataset: Dataset, robot: RobotModel) -> FloatArray:
    """(n,) largest effort of each joint, in the unit of the data."""
    known = np.isfinite(robot.effort_max) & (robot.effort_max > 0)
    torque = np.where(known, robot.effort_max, UNKNOWN_LIMIT_NM)
    if dataset.effort_kind == "torque":
        return torque
    gains = LEAST_GAIN if dataset.drive_gains is None else dataset.drive_gains
    return np.asarray(torque / gains)
