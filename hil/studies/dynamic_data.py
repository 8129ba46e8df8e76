"""What a study of dynamic identification takes from a run: filtered trajectories."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hil.core import BoolArray, DataError, FloatArray
from hil.data import (
    CLOCK,
    MAX_NYQUIST_FRACTION,
    Dataset,
    FilterSettings,
    Split,
    downsample,
    groups,
    paper_sample_split,
    prepare,
    sample_rate,
    split,
)
from hil.dynamics import RobotModel
from hil.estimators import Needs, require_robot, torque_scale

NEEDS = Needs({"trajectories": 3}, gains=True)
"""Trajectories to fit on, for methods that choose something, and to judge on."""

SHARES = (0.6, 0.2, 0.2)
"""Of the samples, to train, validate and test on: the PINN paper, section IV."""

OF_TWELVE = (7, 2, 3)
"""Trajectories to train, validate and test on, the same shares in whole trajectories."""

MOVING_RAD_S = 0.05
"""A joint that is faster is away from its reversals."""

REVERSAL_S = 0.05
"""A sample so close to a change of a joint's direction belongs to that reversal."""

MOVING, REVERSAL = "joint_moving", "joint_reversal"
"""Columns (N, n), 1 where a joint does so and 0 elsewhere: they survive any split."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectories:
    """A run as a study of dynamics sees it.

    Attributes:
        data: Filtered, with the columns `MOVING` and `REVERSAL`.
        thinned: Its rows that are kept.
        filters: As it was filtered and thinned, for estimators.
        scale: (n,) torque per unit of effort.
        recorded_hz, kept_hz: Sample rates before and after.
        notes: What is not as in the paper.
    """

    data: Dataset
    thinned: Dataset
    filters: FilterSettings
    scale: FloatArray
    recorded_hz: float
    kept_hz: float
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """What one split gives: to fit on, left for choices, and to judge on."""

    train: Dataset
    validation: Dataset
    test: Dataset


def trajectories_of(
    whole: Dataset, robot: RobotModel, cutoff_hz: float, rate_hz: float
) -> Trajectories:
    """The trajectories of a run, filtered at their own rate before samples are left out.

    Args:
        whole: The run.
        robot: Model of its arm.
        cutoff_hz: Of the fifth-order Butterworth filter, forwards and backwards.
        rate_hz: Samples kept per second, as nearly as whole steps allow.

    Raises:
        FitError: There are too few trajectories, or the robot is another.
        DataError: The cut-off is too high for the recorded rate, or for the samples kept.
    """
    require_robot(whole, robot)
    data = whole.of_kind("trajectory")
    found = len(groups(data, "trajectory"))
    NEEDS.require(trajectories=found)
    recorded = sample_rate(data["t"][slice(*data.offsets[:2])])
    every = max(1, round(recorded / rate_hz))
    _require_below(cutoff_hz, recorded, every)
    cut = dict.fromkeys(("velocity", "acceleration", "effort"), cutoff_hz)
    filters = FilterSettings.model_validate({"unit": "hz", "every": every, **cut})
    filtered = marked(prepare(data, filters))
    thinned = downsample(filtered, filters)
    notes = [] if found == sum(OF_TWELVE) else [f"{found} trajectories; the paper has twelve"]
    if recorded < 0.99e3:
        notes.append(f"recorded at {recorded:.0f} Hz; the paper at 1000 Hz")
    rates = (recorded, recorded / every)
    return Trajectories(filtered, thinned, filters, torque_scale(data), *rates, tuple(notes))


def highest_cutoff(data: Dataset, rate_hz: float) -> float:
    """The highest cut-off [Hz] that `trajectories_of` takes for these trajectories, to a tenth."""
    recorded = sample_rate(data["t"][slice(*data.offsets[:2])])
    every = max(1, round(recorded / rate_hz))
    return _floor(0.5 * MAX_NYQUIST_FRACTION * recorded / every)


def _require_below(cutoff_hz: float, recorded_hz: float, every: int) -> None:
    """Refuse a cut-off that filter or thinning would, but as the parameter of the study."""
    kept, highest = (_floor(0.5 * MAX_NYQUIST_FRACTION * recorded_hz / n) for n in (every, 1))
    if cutoff_hz <= kept * (1 + CLOCK):
        return
    thinned = f", of which rate_hz keeps {recorded_hz / every:.4g} a second" if every > 1 else ""
    more = f", or up to {highest:g} Hz with a higher rate_hz" if every > 1 else ""
    raise DataError(
        f"cutoff_hz is {cutoff_hz:g} Hz: too high for data recorded at "
        f"{recorded_hz:.4g} Hz{thinned}",
        hint=f"choose at most {kept:g} Hz{more}",
    )


def _floor(hz: float) -> float:
    """To a tenth that may be asked for; rates out of time stamps are off in the last digits."""
    return math.floor(10.0 * hz * (1.0 + 1e-9)) / 10.0


def paper_parts(of: Trajectories, seed: int) -> Parts:
    """60/20/20 % of the samples kept, drawn one by one: neighbours in time land on all sides."""
    return Parts(*paper_sample_split(of.thinned, SHARES, seed))


def honest_parts(of: Trajectories, seed: int) -> Parts:
    """The same shares of whole trajectories: 7, 2 and 3 of twelve; fits leave rows out."""
    outer = held_out(of, seed)
    chosen_by = max(1, round(OF_TWELVE[1] * _twelfths(of)))
    inner = split(outer.train, "trajectory", chosen_by, seed)
    return Parts(inner.train, inner.test, outer.test)


def held_out(of: Trajectories, seed: int) -> Split:
    """Whole trajectories to judge on, 3 of twelve, and the others."""
    return split(of.data, "trajectory", max(1, round(OF_TWELVE[2] * _twelfths(of))), seed)


def _twelfths(of: Trajectories) -> float:
    return len(groups(of.data, "trajectory")) / sum(OF_TWELVE)


def marked(data: Dataset) -> Dataset:
    """With the columns that say where each joint moves and where it turns round."""
    moving = np.abs(data["qd_f"]) > MOVING_RAD_S
    reversal = np.zeros_like(moving)
    for start, stop in pairwise(data.offsets.tolist()):
        rows = slice(start, stop)
        reversal[rows] = near_reversals(data["t"][rows], data["qd_f"][rows])
    flags = {MOVING: moving, REVERSAL: reversal}
    return data.with_columns(**{name: flag.astype(np.float64) for name, flag in flags.items()})


def near_reversals(t: FloatArray, qd: FloatArray) -> BoolArray:
    """(N, n) where a joint changes direction within `REVERSAL_S`.

    Args:
        t: (N,) increasing [s].
        qd: (N, n) filtered velocity.
    """
    found = np.zeros(qd.shape, dtype=bool)
    for j in range(qd.shape[1]):
        moves = np.flatnonzero(qd[:, j])  # a standstill on the way is part of the reversal
        turned = np.diff(np.sign(qd[moves, j])) != 0
        turns = t[moves[1:][turned]]
        if len(turns):
            after = np.searchsorted(turns, t)
            before, behind = np.clip([after - 1, after], 0, len(turns) - 1)
            gap = np.minimum(np.abs(t - turns[before]), np.abs(t - turns[behind]))
            found[:, j] = gap <= REVERSAL_S
    return found
