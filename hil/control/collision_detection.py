"""Detection of collisions of an arm with its surroundings, based only on a fitted model.

The collision detection has three parts: observer, thresholds and detector. The `MomentumObserver`
estimates external torques without accelerations (De Luca & Mattone 2005, Haddadin, De Luca &
Albu-Schäffer 2017). The residual of the observer also contains the prediction errors of the model:
the `CollisionThresholds` bound these errors while joints move, and the `RestMargin` bounds the
torque that friction can hide while a joint is static. If the residual exceeds the sum of threshold
and rest margin with the same sign for the debounce time, the torque has an external cause
(`CollisionDetector`). Haddadin et al. 2017, section V-A, call this method detection with isolation.
The reported joint does not always belong to the link that was hit, because a force on a link loads
every joint between the base and this link.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from hil.arms import Payload
from hil.control.hand_guiding import resting_friction
from hil.core import DataError, FitError, FloatArray, SpecError
from hil.data import Conditions, Dataset
from hil.estimators import (
    STANDSTILL,
    RobotEstimator,
    SpeedBands,
    load_of,
    number,
    require_torque,
)
from hil.export import rigid_parameters

TIME_S = 1e-6
"""Accuracy of the time stamps of samples [s]."""


@dataclass(frozen=True, slots=True)
class Collision:
    """Detected external torque on a joint.

    Attributes:
        joint: Name of the joint; if several joints exceed their thresholds, the joint that exceeds
            its threshold most.
        index: Index of the joint in the model.
        time_s: Time of the detection on the clock of the samples [s].
        since_s: Time at which the residual of the joint first exceeded the threshold [s].
        torque: Residual of the joint [N·m], positive if the joint is pushed forwards.
        threshold: Threshold that the residual exceeds [N·m].
    """

    joint: str
    index: int
    time_s: float
    since_s: float
    torque: float
    threshold: float


class CollisionDetector:
    """Detector of collisions, sample by sample.

    Args:
        model: Fitted model with a rigid body. A load that is not part of `payload` acts like an
            external torque.
        payload: Payload that is mounted, declared or identified.
        thresholds: Detection thresholds; by default derived from the uncertainty of the model, see
            `CollisionThresholds`.

    Attributes:
        thresholds: Detection thresholds, including the observer gain and the debounce time.

    Raises:
        FitError: The model has no rigid body, or cannot predict torques.
        SpecError: The thresholds belong to different joints.
    """

    def __init__(
        self,
        model: RobotEstimator,
        payload: Payload | None = None,
        *,
        thresholds: CollisionThresholds | None = None,
    ) -> None:
        self.thresholds = thresholds or CollisionThresholds.of(model)
        if self.thresholds.joint_names != model.joint_names_:
            raise SpecError(
                f"the thresholds are for the joints {', '.join(self.thresholds.joint_names)}, "
                f"the model is for {', '.join(model.joint_names_)}",
                hint="calibrate the thresholds with this model",
            )
        self._observer = MomentumObserver(model, payload, gain=self.thresholds.gain)
        self._margin = RestMargin(self.thresholds.resting)
        n = self._observer.n
        self._sign, self._since = np.zeros(n), np.full(n, np.inf)
        self._told = False

    @property
    def residual(self) -> FloatArray:
        """External torque (n,) [N·m]; the returned view changes with every sample."""
        return self._observer.residual

    def update(
        self, t: float, q: FloatArray, qd: FloatArray, effort: FloatArray
    ) -> Collision | None:
        """Return a collision when it is first detected, otherwise None.

        None is also returned while the same collision continues.

        Args:
            t: Time of the sample [s].
            q: (n,) measured positions [rad].
            qd: (n,) velocities [rad/s].
            effort: (n,) effort in the unit of the model, current [A] or torque [N·m].

        Raises:
            DataError: A value is not finite or has a wrong shape, or the time does not advance.
        """
        residual = self._observer.update(t, q, qd, effort)
        limit = self.thresholds.at(qd) + self._margin.update(t, qd)
        sign = np.where(np.abs(residual) > limit, np.sign(residual), 0.0)
        self._since[sign != self._sign] = t
        self._sign = sign
        pushed = (sign != 0.0) & (t - self._since >= self.thresholds.debounce_s - TIME_S)
        if not np.any(pushed):
            # The same contact continues as long as the residual of any joint exceeds its threshold.
            self._told = self._told and bool(np.any(sign))
            return None
        if self._told:
            return None
        self._told = True
        j = int(np.argmax(np.where(pushed, np.abs(residual) / limit, 0.0)))
        name = self._observer.joint_names[j]
        return Collision(
            name, j, float(t), float(self._since[j]), float(residual[j]), float(limit[j])
        )


QUANTILE = 6.0
"""Detection threshold in standard deviations of the model.

The residual of motions without payload reaches 3.2 standard deviations on the mock robot; the
residual of motions with declared payloads and of static phases reaches more.
"""

DEBOUNCE_S = 0.015
"""Debounce time [s], which is three samples at 125 Hz."""

FALSE_ALARMS = 0.1

GAIN = 40.0
"""Observer gain K [1/s]; 63 % of an external torque is visible after 25 ms."""


@dataclass(frozen=True, eq=False)
class CollisionThresholds:
    """Threshold per joint, which bounds the residual that prediction errors of the model cause.

    The thresholds can be determined by two methods. Without further data (`of`), the threshold of a
    joint is the uncertainty of the model (`sigma_`, or the conformal bands of `residual`) times a
    quantile. Prediction errors are not normally distributed, because they have peaks where joints
    reverse: the quantile is chosen for the peaks on the mock robot and guarantees no false-alarm
    rate. The observer reduces a part of the noise contained in `sigma_` but not the slow prediction
    errors; the threshold does not depend on the observer gain.

    With data of motions without contact (`calibrated`), the thresholds are computed from the
    residuals of the observer, including noise, gain and debounce time. One half of the motions
    without contact determines the ratio between the thresholds of the joints. The other half of the
    motions determines the common scale of the thresholds: the split-conformal quantile of the peaks
    of the motions (Vovk et al. 2005). A future motion that is exchangeable with these calibration
    motions then causes a false alarm with a probability of at most `false_alarms`.

    Attributes:
        joint_names: Names of the n joints.
        level: (n,) thresholds while joints move [N·m]; in standard deviations if `bands` is set.
        resting: (n,) dry friction [N·m], added to the threshold while a joint is static.
        gain: Observer gain K for which the thresholds are valid [1/s].
        debounce_s: Time for which the residual must exceed a threshold [s].
        false_alarms: Maximum false-alarm rate per motion without contact, on average over
            calibrations; None if no rate is guaranteed.
        bands: Speed-dependent uncertainty of the model; None if the uncertainty is constant.
        per_effort: (n,) torque per unit of the effort in which the bands are expressed.
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
        """Return thresholds that follow from the uncertainty of a model.

        Args:
            model: Fitted model.
            quantile: Threshold in standard deviations of the model.
            gain: Observer gain K [1/s].
            debounce_s: Time for which the residual must exceed a threshold [s].

        Raises:
            SpecError: A setting is outside its allowed range.
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
        """Return thresholds from motions without contact that are not in the training data.

        Args:
            model: Fitted model.
            dataset: Measured data; each series is one motion, with its declared payload.
            false_alarms: Maximum false-alarm rate, see the attribute; at least 2·(1/false_alarms −
                1) motions are required.
            gain: Observer gain K [1/s].
            debounce_s: Time for which the residual must exceed a threshold [s].

        Raises:
            SpecError: A setting is outside its allowed range.
            FitError: The data contain too few motions.
            DataError: The data belong to a different robot, or are not finite.
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
        """Return thresholds (n,) [N·m] at joint velocities (n,) [rad/s]."""
        level = self.level
        if self.bands is not None and self.per_effort is not None:
            level = level * self.bands.deviation(qd) * self.per_effort
        return level


def _require(gain: float, debounce_s: float) -> None:
    number("gain", gain, above=0.0)
    number("debounce_s", debounce_s, at_least=0.0)


def _share(false_alarms: float) -> float:
    rate = number("false_alarms", false_alarms, above=0.0)
    if rate >= 1.0:
        raise SpecError(
            f"false_alarms is {rate:g}, but must be below 1", hint="use 0.1 for one motion in ten"
        )
    return rate


def _rank(motions: int, rate: float) -> int:
    """Return the rank of the conformal quantile among the ascending peaks of the motions.

    Only the motions in the second half of the calibration data are ranked.
    """
    judged = motions // 2
    rank = math.ceil((judged + 1) * (1.0 - rate) - 1e-9)
    if rank > judged:
        raise FitError(
            f"{motions} motions without contact cannot guarantee an alarm in at most "
            f"{rate:g} of future motions",
            hint=f"record {2 * math.ceil(1.0 / rate - 1.0 - 1e-9)}, or ask for less",
        )
    return rank


def _peaks(
    model: RobotEstimator,
    dataset: Dataset,
    condition: Conditions,
    rows: slice,
    rest: FloatArray,
    gain: float,
    debounce_s: float,
) -> FloatArray:
    """Return the highest thresholds (n,) at which one motion would have caused an alarm [N·m]."""
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


ACCELERATION_S = 0.015
"""Time constant of the filtered acceleration used for friction [s]; corresponds to the cutoff of
11 Hz in fits."""

GAP_S = 0.1
"""Maximum pause between two samples over which the momentum is tracked [s]."""


class MomentumObserver:
    """Momentum observer of a fitted model with a rigid body, sample by sample.

    Source: De Luca & Mattone 2005 (eq. 12), Haddadin, De Luca & Albu-Schäffer 2017 (section IV-E).
    The momentum p = M(q) q̇ satisfies dp/dt = τ + τ_ext + Cᵀq̇ − g − friction. The residual r of
    the observer is defined as

        r = K (p(t) − p(0) − ∫ (τ + Cᵀq̇ − g − friction + r) dt)

    The residual r equals τ_ext after a first-order filter with time constant 1/K and needs no
    acceleration. A friction model that depends on the gear torque uses a filtered acceleration; in
    the rigid-body terms, the filtered acceleration cancels.

    Args:
        model: Fitted model; the stream of the model provides the friction.
        payload: Payload that is mounted, declared or identified.
        gain: Observer gain K [1/s].

    Attributes:
        residual: (n,) external torque [N·m], positive if the torque pushes a joint forwards; always
            the same array object.

    Raises:
        FitError: The model has no rigid body, or cannot predict torques.
        SpecError: `gain` is not a number above 0.
    """

    def __init__(
        self, model: RobotEstimator, payload: Payload | None = None, *, gain: float = GAIN
    ) -> None:
        require_torque(model)
        self._gain = number("gain", gain, above=0.0)
        self._robot, self._scale = model.robot_, model.torque_scale_
        self._stream = model.stream(payload)
        own = rigid_parameters(model)
        load = payload or Payload()
        self._parameters = own if load.is_empty else self._robot.loaded_parameters(own, load)
        self.joint_names = model.joint_names_
        self.residual: FloatArray = np.zeros(self.n)
        self._acceleration = np.zeros(self.n)
        # Two rows: the motion, and the same pose at rest; their difference does not contain
        # gravity.
        self._motion = np.zeros((3, 2, self.n))
        self._time = -math.inf
        self._before: tuple[FloatArray, FloatArray, FloatArray] | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    def update(self, t: float, q: FloatArray, qd: FloatArray, effort: FloatArray) -> FloatArray:
        """Return the residual (n,) [N·m] after a sample at time t [s].

        The argument `effort` is in the unit of the model.

        After a pause between samples of more than `GAP_S` seconds, the residual restarts from 0.

        Raises:
            DataError: A value is not finite or has a wrong shape, or the time does not advance.
        """
        self._require_sample(t, q, qd, effort)
        dt, self._time = t - self._time, t
        if dt > GAP_S:
            self._before = None
            self.residual[:], self._acceleration[:] = 0.0, 0.0
        elif self._before is not None:
            share = 1.0 - math.exp(-dt / ACCELERATION_S)
            self._acceleration += share * ((qd - self._before[2]) / dt - self._acceleration)
        p, rate = self._momentum_and_rate(q, qd, effort)
        if self._before is not None:
            external = (p - self._before[0]) / dt - 0.5 * (rate + self._before[1])
            self.residual += (1.0 - math.exp(-self._gain * dt)) * (external - self.residual)
        self._before = p, rate, np.array(qd, dtype=np.float64)
        return self.residual

    def _momentum_and_rate(
        self, q: FloatArray, qd: FloatArray, effort: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the momentum (n,), and τ + Cᵀq̇ − g − friction (n,)."""
        a = self._acceleration
        expected = self._stream.step(q, qd, a)
        self._motion[0], self._motion[1, 0], self._motion[2, 0] = q, qd, a
        moving, resting = self._robot.torque(self._parameters, *self._motion)
        p, gradient = self._robot.momentum(self._parameters, *self._motion[:2, :1])
        missing = (effort - expected) * self._scale
        return p[0], missing + (moving - resting) + gradient[0]

    def _require_sample(self, t: float, *values: FloatArray) -> None:
        for name, row in zip(("position", "velocity", "effort"), values, strict=True):
            if np.shape(row) != (self.n,) or not np.all(np.isfinite(row)):
                raise DataError(
                    f"at {t} s the {name} is {row}, but must be {self.n} finite numbers",
                    hint="stop the arm: its sensor values are invalid",
                )
        if not math.isfinite(t) or t <= self._time:
            raise DataError(
                f"a sample at {t} s follows a sample at {self._time} s",
                hint="pass each sample once, in the order of time",
            )


FADES_S = 0.1
"""Time constant with which the rest margin decreases after a joint starts to move [s].

The time constant covers the reversal of friction and the delay of the observer.
"""


class RestMargin:
    """Additional threshold for joints that are static or were static a short time before.

    The additional threshold is the dry friction of the joint.

    A static joint holds any torque up to its dry friction, and the held torque changes without
    visible motion: the integral part of a controller changes slowly, a gear creeps. No motion model
    predicts this held torque, so that the threshold is higher while a joint is static and for a
    short time afterwards.

    Args:
        level: (n,) dry friction [N·m].
    """

    def __init__(self, level: FloatArray) -> None:
        self._level = level
        self._share = np.ones_like(level)
        self._time: float | None = None

    def update(self, t: float, qd: FloatArray) -> FloatArray:
        """Return the rest margin (n,) [N·m] after a sample at time t [s] and velocity qd."""
        passed = 0.0 if self._time is None else t - self._time
        self._time = t
        self._share *= math.exp(-passed / FADES_S)
        self._share[np.abs(qd) < STANDSTILL] = 1.0
        margin: FloatArray = self._level * self._share
        return margin
