"""Efforts no drive can have made: a parser's slip or a flipped bit, in a recording that is good."""

from __future__ import annotations

import numpy as np

from hil.core import FitError, FloatArray
from hil.data import PREPARED, Dataset
from hil.dynamics import RobotModel

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
        # What is not finite is told elsewhere.
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
    found: FloatArray = torque / gains
    return found
