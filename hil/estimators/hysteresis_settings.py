"""What `rigid-hysteresis` takes for granted, and how its parameters are read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.core import DataError, FloatArray, SpecError, did_you_mean
from hil.data import AT_REST, Dataset, FilterSettings, derivative, sample_rate
from hil.dynamics import RobotModel
from hil.estimators.friction.library import CORE, groups

MOTION_HZ, EFFORT_RATIO = 11.0, 1.6
"""Lowest cut-off for velocity and acceleration, and that of the effort over it. An arm's motion has
the same frequencies however often it is sampled. A fit learns from a wider band than it predicts:
ripple shows there. Chosen on four UR10e trajectories, each left out in turn."""

BANDWIDTHS = 5.0
"""A cut-off is at least so many times the bandwidth of the motion, for arms that are quicker."""

ENERGY = 0.999
"""Share of the velocity's energy within its bandwidth."""

MOST_OF_NYQUIST = 0.75


def filters_for(dataset: Dataset) -> FilterSettings:
    """Filters by the bandwidth of the motion that is learnt from.

    Raises:
        DataError: Time does not increase.
    """
    bandwidth, nyquist = 0.0, np.inf
    for condition, rows in dataset.slices():
        if condition.kind not in AT_REST and rows.stop - rows.start > 2:
            t = dataset["t"][rows]
            nyquist = min(nyquist, 0.5 * sample_rate(t))
            # Measured velocity says it best: differences of positions are mostly noise.
            measured = dataset["qd"][rows] if "qd" in dataset.columns else None
            velocity = derivative(dataset["q"][rows], t) if measured is None else measured
            bandwidth = max(bandwidth, _bandwidth(velocity, t))
    most = MOST_OF_NYQUIST * nyquist / EFFORT_RATIO
    motion = round(float(min(max(MOTION_HZ, BANDWIDTHS * bandwidth), most)), 2)
    effort = round(EFFORT_RATIO * motion, 2)
    return FilterSettings(unit="hz", velocity=motion, acceleration=motion, effort=effort)


def _bandwidth(velocity: FloatArray, t: FloatArray) -> float:
    """Frequency below which nearly all of the median joint's velocity (N, n) lies [Hz]."""
    from scipy.signal import welch

    rate = sample_rate(t)
    length = min(len(t), int(4.0 * rate))
    if length < 2:
        raise DataError(
            f"samples at {rate:.3g} Hz are too slow to tell how quick a motion is",
            hint="look at the unit of the time stamps: they have to be seconds",
        )
    frequency, power = welch(velocity, rate, nperseg=length, axis=0)
    share = np.cumsum(power, axis=0) / np.maximum(np.sum(power, axis=0), 1e-300)
    return float(np.median(frequency[np.argmax(share >= ENERGY, axis=0)]))


def group_names(name: str, given: str | Sequence[str]) -> str | tuple[str, ...]:
    """`auto`, or names of groups; the core is always there and need not be named.

    Raises:
        SpecError: There is no such group.
    """
    if given == "auto":
        return "auto"
    known = groups(ripple=True, temperature=True)
    chosen = (given,) if isinstance(given, str) else tuple(given)
    for group in chosen:
        if group not in known:
            words = ["auto", *known]
            raise SpecError(
                f"{name}: there is no group {group!r}",
                hint=did_you_mean(str(group), words) or f"there are {', '.join(words)}",
            )
    return tuple(dict.fromkeys((CORE, *chosen)))


def motor_turns(robot: RobotModel, gear_ratio: float | None) -> FloatArray:
    """(n,) motor turns per joint turn; NaN where nobody knows."""
    if gear_ratio is not None:
        return np.full(robot.n, gear_ratio)
    if robot.arm is None:
        return np.full(robot.n, np.nan)
    return np.asarray(robot.arm.gear_ratio, dtype=np.float64)
