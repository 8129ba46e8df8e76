"""How much of a residual is the model's own error.

Two answers. Without further data: the model's own uncertainty (`sigma_`, or the conformal bands of
`residual`) times a quantile. Errors of models are no normal noise: they come in peaks where joints
turn round, so the quantile is what peaks on the mock need, and promises nothing. The observer
smooths a part of the noise that `sigma_` holds, never the slow errors; its gain is not counted in.

With motions without contact: what the observer itself shows of them, noise, gain and debounce
included. Every other motion says how the joints compare, the others how far all thresholds have to
be raised: the split-conformal quantile of the motions' peaks (Vovk et al. 2005). A motion to come
that is exchangeable with them then alarms with a probability of at most `false_alarms`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from hil.control.momentum_observer import GAIN, MomentumObserver
from hil.control.rest_margin import RestMargin, resting_friction
from hil.core import FitError, FloatArray, SpecError
from hil.data import Conditions, Dataset
from hil.estimators import RobotEstimator, SpeedBands, load_of, number

QUANTILE = 6.0
"""Deviations. Motions without load reach 3.2 on the mock, declared loads and rests need more."""

DEBOUNCE_S = 0.015
"""Three samples at 125 Hz."""

FALSE_ALARMS = 0.1


@dataclass(frozen=True, eq=False)
class CollisionThresholds:
    """A threshold per joint.

    Attributes:
        joint_names: n of them.
        level: (n,) [N·m]; in `quantile` deviations where `bands` say the deviation.
        resting: (n,) dry friction [N·m], which is added while a joint stands.
        gain: K of the observer they hold for [1/s].
        debounce_s: How long they have to be exceeded [s].
        false_alarms: Largest probability of an alarm in a motion without contact, on average over
            calibrations; None where nothing is promised.
        bands: Of a model whose uncertainty depends on speed.
        per_effort: (n,) torque per unit of the bands.
    """

    joint_names: tuple[str, ...]
    level: FloatArray
    resting: FloatArray
    gain: float
    debounce_s: float
    false_alarms: float | None = None
    bands: SpeedBands | None = None
    per_effort: FloatArray | None = None

    @classmethod
    def of(
        cls,
        model: RobotEstimator,
        *,
        quantile: float = QUANTILE,
        gain: float = GAIN,
        debounce_s: float = DEBOUNCE_S,
    ) -> Self:
        """Those of a model's own uncertainty.

        Args:
            model: Fitted.
            quantile: How many standard deviations are no collision.
            gain: K of the observer [1/s].
            debounce_s: How long they have to be exceeded [s].

        Raises:
            SpecError: A setting is out of its range.
        """
        _require(gain, debounce_s)
        many = number("quantile", quantile, above=0.0)
        bands = getattr(model, "bands_", None)
        scale = model.torque_scale_
        level = many * (model.sigma_ * scale if bands is None else np.ones_like(scale))
        rest = resting_friction(model)
        return cls(model.joint_names_, level, rest, gain, debounce_s, None, bands, scale)

    @classmethod
    def calibrated(
        cls,
        model: RobotEstimator,
        dataset: Dataset,
        *,
        false_alarms: float = FALSE_ALARMS,
        gain: float = GAIN,
        debounce_s: float = DEBOUNCE_S,
    ) -> Self:
        """Those of motions without contact, which the model has not learned from.

        Args:
            model: Fitted.
            dataset: Measured; one series is one motion, with its own declared load.
            false_alarms: See the attribute; 2·(1/false_alarms − 1) motions are needed.
            gain: K of the observer [1/s].
            debounce_s: How long a threshold has to be exceeded [s].

        Raises:
            SpecError: A setting is out of its range.
            FitError: There are too few motions.
            DataError: The data are of another robot, or not finite.
        """
        _require(gain, debounce_s)
        rate = _share(false_alarms)
        model.require_match(dataset)
        motions = [slices for slices in dataset.slices() if slices[1].stop > slices[1].start]
        rank = _rank(len(motions), rate)
        rest = resting_friction(model)
        peaks = np.array(
            [_peaks(model, dataset, *motion, rest, gain, debounce_s) for motion in motions]
        )
        compared, judged = peaks[0::2], peaks[1::2]
        shape = np.maximum(compared.max(axis=0), 1e-9)
        level = shape * np.sort((judged / shape).max(axis=1))[rank - 1]
        return cls(model.joint_names_, level, rest, gain, debounce_s, rate)

    def at(self, qd: FloatArray) -> FloatArray:
        """(n,) thresholds [N·m] of joints that move with velocities (n,) [rad/s]."""
        level = self.level
        if self.bands is not None and self.per_effort is not None:
            level = level * self.bands.deviation(qd) * self.per_effort
        return level


def _peaks(
    model: RobotEstimator,
    dataset: Dataset,
    condition: Conditions,
    rows: slice,
    rest: FloatArray,
    gain: float,
    debounce_s: float,
) -> FloatArray:
    """(n,) the highest thresholds that one motion would have alarmed at [N·m]."""
    observer = MomentumObserver(model, load_of(condition), gain=gain)
    t = dataset["t"][rows]
    samples = zip(t, *(dataset[name][rows] for name in ("q", "qd", "effort")), strict=True)
    residual = np.array([observer.update(*sample).copy() for sample in samples])
    margin = RestMargin(rest)
    hidden = [margin.update(*sample) for sample in zip(t, dataset["qd"][rows], strict=True)]
    residual = np.sign(residual) * np.maximum(np.abs(residual) - hidden, 0.0)
    period = float(np.median(np.diff(t))) if len(t) > 1 else debounce_s
    count = min(math.ceil(debounce_s / period - 1e-6) + 1, len(residual))
    held = np.lib.stride_tricks.sliding_window_view(residual, count, axis=0)
    lasting = np.maximum(held.min(axis=-1), -held.max(axis=-1))
    return np.asarray(np.maximum(lasting.max(axis=0), 0.0))


def _rank(motions: int, rate: float) -> int:
    """Which of the judged motions' peaks, in ascending order, is the conformal quantile."""
    judged = motions // 2
    rank = math.ceil((judged + 1) * (1.0 - rate) - 1e-9)
    if rank > judged:
        raise FitError(
            f"{motions} motions without contact cannot promise an alarm in at most "
            f"{rate:g} of the motions to come",
            hint=f"record {2 * math.ceil(1.0 / rate - 1.0 - 1e-9)}, or ask for less",
        )
    return rank


def _require(gain: float, debounce_s: float) -> None:
    number("gain", gain, above=0.0)
    number("debounce_s", debounce_s, at_least=0.0)


def _share(false_alarms: float) -> float:
    rate = number("false_alarms", false_alarms, above=0.0)
    if rate >= 1.0:
        raise SpecError(
            f"false_alarms is {rate:g}, but must be below 1", hint="say 0.1 for one motion in ten"
        )
    return rate
