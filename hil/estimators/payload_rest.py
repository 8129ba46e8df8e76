"""The load at the flange of an arm that holds a few poses: a pair of scales, in seconds.

At rest a load shows its mass m and first moment m·c alone, linearly (`hil.dynamics.weighing`); its
inertia does not show. What is left over by the model of the bare arm is explained by these four, by
generalised least squares over errors of known kinds: drive gains, which err by the same share at
every pose; the model's gravity, likewise; a constant per joint; and what of the friction does not
cancel between two approaches, pose by pose. With a weighing of the bare flange the model's own
errors cancel, and only differences count.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import stats

from hil.arms import Payload
from hil.core import FitError, FloatArray, HilError
from hil.data import Dataset, dwells_of
from hil.dynamics import GAIN_SHARE
from hil.estimators.base import HONEST, RobotEstimator
from hil.estimators.checks import require_clean
from hil.estimators.payload_estimate import Correction, PayloadEstimate
from hil.estimators.rest_balance import STATIC, TARED, RestProblem, point_load
from hil.estimators.rest_readings import RestReadings
from hil.estimators.standstill import require_torque

LEVEL = 0.95

MOST_KG, MOST_M = 5.0, 0.3
"""What is uncertain by more (95 %) is not told at all: such a number would be read as one."""


def estimate_payload_at_rest(
    model: RobotEstimator,
    dataset: Dataset,
    *,
    bare: Dataset | None = None,
    gain_share: float = GAIN_SHARE,
) -> PayloadEstimate:
    """Mass and centre of mass of what hangs at the flange, from poses that the arm held.

    Args:
        model: Fitted to recordings of the same arm whose loads are known.
        dataset: Dwells with one load, or motion with stays in it.
        bare: The same program with nothing mounted: much smaller errors.
        gain_share: Standard deviation of a drive gain [share of it]; torques have no gains.

    Returns:
        An estimate whose inertia is NaN, and its centre too where no load shows or no pose shows
        it. Its errors include those of the gains (so its `by_gain` is 0) and of the model.

    Raises:
        FitError: The arm never rested, the poses do not show the mass, the model does not tell
            torques, or the arm is lighter than the model has it.
        DataError: The data are of another robot or unit, or `bare` of other poses.
    """
    require_torque(model)
    if model.protocol != HONEST:
        raise FitError(
            f"{model.protocol}: such a model cannot tell a load at rest",
            hint="fit without current_term",
        )
    readings = _readings(model, dataset)
    first = None if bare is None else _tare(model, readings, bare)
    problem = RestProblem.of(model, readings, first, gain_share)
    return _told(problem, *problem.solved())


def _readings(model: RobotEstimator, dataset: Dataset) -> RestReadings:
    model.require_match(dataset)
    dwells = dwells_of(dataset)
    if not len(dwells.conditions):
        raise FitError(
            "the arm never rested in this recording, so it says nothing about a load at rest",
            hint="run experiments/ur5_weigh.yaml, or use a model of motion",
        )
    require_clean(dwells, ("t", "q", "effort"))
    return RestReadings.of(dwells)


def _tare(model: RobotEstimator, readings: RestReadings, bare: Dataset) -> RestReadings:
    try:
        return readings.matching(_readings(model, bare))
    except HilError as error:
        of = ", ".join(dict.fromkeys(condition.source for condition in bare.conditions))
        raise type(error)(f"the bare flange ({of}): {error.message}", hint=error.hint) from error


def _told(
    problem: RestProblem, phi: FloatArray, covariance: FloatArray, left: FloatArray
) -> PayloadEstimate:
    n, degrees = left.shape[1], left.size - STATIC
    t = float(stats.t.ppf((1.0 + LEVEL) / 2.0, degrees))
    values, spread = np.full(10, np.nan), np.full((10, 10), np.nan)
    values[0], spread[0, 0] = phi[0], covariance[0, 0]
    _require_mass(phi[0], t * np.sqrt(covariance[0, 0]))
    shows = phi[0] > t * np.sqrt(covariance[0, 0])
    if shows:
        G = np.vstack([np.eye(STATIC)[0], np.eye(STATIC)[1:] / phi[0]])
        G[1:, 0] = -phi[1:] / phi[0] ** 2
        spread[:STATIC, :STATIC] = G @ covariance @ G.T
        known = t * np.sqrt(np.diag(spread)[1:STATIC]) <= MOST_M
        values[1:STATIC] = np.where(known, phi[1:] / phi[0], np.nan)
        spread[:, 1:STATIC][:, ~known], spread[1:STATIC][~known] = np.nan, np.nan
    error = np.sqrt(np.diag(spread))
    scale = problem.model.torque_scale_
    interval = np.column_stack([values - t * error, values + t * error])
    return PayloadEstimate(
        payload=point_load(np.append(phi[0], phi[0] * np.nan_to_num(values[1:STATIC])))
        if shows else Payload(),
        values=values, std_error=error, interval=interval, covariance=spread,
        degrees=np.full(10, float(degrees)), by_gain=np.zeros((10, n)),
        residual=_rms(left / scale), without=_rms(problem.found / scale),
        unit="A" if problem.model.effort_kind_ == "current" else "N·m",
        joint_names=problem.model.joint_names_, friction="rest",
        correction=Correction(np.zeros(n), np.zeros(n)),
        samples=len(left), blocks=len(left), bounded=False,
        notes=tuple(_notes(problem, values, interval, bool(shows))),
        gain_share=problem.gain_share,
    )  # fmt: skip


def _require_mass(mass: float, reach: float) -> None:
    if reach > MOST_KG:
        raise FitError(
            f"these poses do not show the mass: it is uncertain by {reach:.0f} kg",
            hint="hold poses at which gravity turns joints that the load loads: the arm stretched",
        )
    if mass < -reach:
        raise FitError(
            f"the arm is {-mass:.2f} ± {reach:.2f} kg lighter at the flange than the model has it",
            hint="the model, or --bare, must be of the arm without the load",
        )


def _notes(
    problem: RestProblem, values: FloatArray, interval: FloatArray, shows: bool
) -> Iterator[str]:
    yield "an arm at rest does not show a load's inertia: use a recording of motion for that"
    if problem.one_sided:
        poses = f"{problem.one_sided} of {len(problem.found)} poses"
        yield f"{poses} were approached from one side only: their friction is part of the errors"
    if problem.errors is not TARED:
        yield "the same program run with nothing mounted (--bare RUN) makes errors much smaller"
    if not shows:
        return
    axes = [axis for axis, value in zip("xyz", values[1:STATIC], strict=True) if np.isnan(value)]
    if axes:
        yield (
            f"these poses do not show com_{', com_'.join(axes)}: hold poses in which the flange's "
            "axis points in other directions (with it vertical, a centre anywhere on it is alike)"
        )
    if np.all((interval[1:3, 0] <= 0.0) & (interval[1:3, 1] >= 0.0)):
        yield (
            "the centre of mass is on the flange's axis as far as can be told: which way round "
            "the load is mounted does not show"
        )


def _rms(values: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))
