"""A control chart per feature, with the joint's temperature as a covariate.

Of a robot that does not change, a feature is a + b·(T − T̄) + noise: a model is never quite right,
and friction is another at another temperature than the model believes. The probes taken after a
model became champion tell a, b and the noise, by Bayesian regression with priors that know how
large these can be; before they have told, limits are wide, and nothing is called a change. A new
probe is compared with what they predict for its temperature: by itself, and in an exponentially
weighted mean with the probes before it, for what creeps. Predictions are Student-t, the noise being
estimated too, and errors that all probes share count as such.

A robot that does not change is called changed with a probability of `false_alarm` at most, all
features together: each gets its share of it, half of that for either chart (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from hil.core import BoolArray, DataError, FloatArray
from hil.models.drift.features import Features

FALSE_ALARM = 0.01
"""Of one probe, all features together."""

REFERENCE = 5
"""Probes after a promotion that tell what the robot is like; they are judged too."""

FORGET = 0.3
"""Weight of the newest probe in the weighted mean."""

PRIORS = {"friction": (0.2, 0.01), "gain": (0.1, 0.005), "offset": (5.0, 0.2), "load": (0.2, 0.01)}
"""Standard deviations of a and of b [1/K]: shares of friction and effort; offsets in standard
deviations of the champion's residual; a load in kg, and in kg·m a tenth of that. Real friction
changes by 0.2 to 1 % per kelvin, and models follow most of it."""

NOISE_DOF = 4.0
"""Probes that the prior of the noise is worth, which is what blocks of the probes say of it."""

LEAST_NOISE = 1e-6
"""Share of the priors below which nothing is told apart."""

LEVER_M = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Charted:
    """What the charts say of the newest probe.

    Attributes:
        deviation: (K,) of the newest probe from what the reference says at its temperature.
        std: (K,) that such a deviation may have.
        p: (K,) how probable one as large is, without a change.
        p_mean: (K,) the same of the weighted mean; `p` while no other is in it.
        mean: (K,) weighted mean of the deviations since the reference.
        limit: (K,) deviation above which a single probe is called changed.
        alarm: (K,) whether it is called so.
        reference: How many probes told.
    """

    deviation: FloatArray
    std: FloatArray
    p: FloatArray
    p_mean: FloatArray
    mean: FloatArray
    limit: FloatArray
    alarm: BoolArray
    reference: int


def charted(
    probes: Sequence[Features], sigma: FloatArray, false_alarm: float = FALSE_ALARM
) -> Charted:
    """Judge the last of some probes, taken one after the other under one champion.

    Args:
        probes: Oldest first; those that were called changed left out, but for the last.
        sigma: (n,) standard deviation of the champion's residual, in effort units.
        false_alarm: Of one probe, all features together, at most.

    Raises:
        DataError: They are of different robots, or there is none.
    """
    if not probes or any(one.names != probes[0].names for one in probes):
        raise DataError(
            "probes of different robots cannot be charted together",
            hint="keep the history of each robot by itself",
        )
    probes = _distinct(probes)
    count = min(REFERENCE, len(probes) - 1)
    values, celsius = (np.array([getattr(one, name) for one in probes]) for name in _ARRAYS)
    centre = np.nan_to_num(np.nanmean(celsius, axis=0)) if np.isfinite(celsius).any() else 0.0
    warm = np.nan_to_num(celsius - centre)
    noise = _noise(probes[: max(count, 1)]) + np.finfo(np.float64).tiny
    told = [
        _feature(values[:, k], warm[:, k], _prior(name, sigma), float(noise[k]), count)
        for k, name in enumerate(probes[0].names)
    ]
    share = false_alarm / len(told) / 2
    deviation, std, dof, mean, mean_std = np.array(told).T
    p, p_mean = _p(deviation, std, dof), _p(mean, mean_std, dof)
    limit = std * student.isf(share / 2, dof)
    alarm = (p < share) | (p_mean < share)
    return Charted(deviation, std, p, p_mean, mean, limit, alarm, count)


def _distinct(probes: Sequence[Features]) -> Sequence[Features]:
    """Without those that say what another says to the last bit: copies, or a mock's same day."""
    *before, newest = probes
    found: dict[bytes, Features] = {}
    for probe in before:
        found.setdefault(probe.values.tobytes(), probe)
    found.pop(newest.values.tobytes(), None)
    return [*found.values(), newest]


def _noise(probes: Sequence[Features]) -> FloatArray:
    """(K,) standard deviation of one probe, by what its blocks say.

    A model's error along a motion is the same in every probe that drives it. What is common to the
    blocks of the same place is therefore no noise, nor is what is common to the blocks of a probe.
    """
    shapes = {one.blocks.shape for one in probes}
    if len(probes) < 2 or len(shapes) > 1:
        return np.asarray(np.sqrt(np.mean([one.std**2 for one in probes], axis=0)))
    blocks = np.array([one.blocks for one in probes])
    count, per, _ = blocks.shape
    rest = blocks - blocks.mean(axis=0) - blocks.mean(axis=1, keepdims=True)
    rest += blocks.mean(axis=(0, 1))
    variance = np.sum(rest**2, axis=(0, 1)) / ((count - 1) * (per - 1)) / per
    return np.asarray(np.sqrt(variance))


_ARRAYS = ("values", "temperature")


def _prior(name: str, sigma: FloatArray) -> FloatArray:
    """Of a and b, in the feature's unit."""
    what = name.rsplit(" ", 1)[1]
    if name.startswith("load "):
        return np.array(PRIORS["load"]) * (1.0 if what == "mass" else LEVER_M)
    # Offsets of joints that are all alike in what they may be, whatever their current.
    return np.array(PRIORS[what]) * (float(np.median(sigma)) if what == "offset" else 1.0)


def _feature(
    values: FloatArray, warm: FloatArray, prior: FloatArray, noise: float, count: int
) -> tuple[float, ...]:
    """Deviation, its std, degrees of freedom, weighted mean and its std, of one feature.

    Values and temperatures (P,) are of all probes, the newest last; the first `count` tell.
    """
    X = np.column_stack([np.ones_like(warm), warm])
    known, y = X[:count], values[:count]
    noise = max(noise, LEAST_NOISE * float(prior[0]))
    # In units of the noise: normal-inverse-gamma, the conjugate prior of a regression.
    precision = np.diag((noise / prior) ** 2)
    spread = np.linalg.inv(precision + known.T @ known)
    centre = spread @ (known.T @ y)
    dof = NOISE_DOF + count
    rest = float(y @ y - centre @ np.linalg.solve(spread, centre)) if count else 0.0
    variance = (NOISE_DOF * noise**2 + max(rest, 0.0)) / dof
    since = slice(count, None)
    away = values[since] - X[since] @ centre
    new = X[-1]
    std = float(np.sqrt(variance * (1.0 + new @ spread @ new)))
    weights = FORGET * (1.0 - FORGET) ** np.arange(len(away))[::-1]
    weights /= np.sum(weights)
    pooled = weights @ X[since]
    mean_std = float(np.sqrt(variance * (weights @ weights + pooled @ spread @ pooled)))
    return float(away[-1]), std, dof, float(weights @ away), mean_std


def _p(value: FloatArray, std: FloatArray, dof: FloatArray) -> FloatArray:
    found: FloatArray = 2.0 * student.sf(np.abs(value) / std, dof)
    return found
