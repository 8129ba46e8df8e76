"""Collisions of an arm with its surroundings, from a fitted model alone.

Three parts. The `MomentumObserver` sees external torques without accelerations (De Luca & Mattone
2005, Haddadin, De Luca & Albu-Schäffer 2017). Its residual holds the model's errors too: the
`CollisionThresholds` say how much of it those are while joints move, the `RestMargin` what friction
may hide while one stands. What is more than both, with the same sign for the debounce time, comes
from outside (`CollisionDetector`). Haddadin et al. 2017, sec. V-A, call this detection with
isolation: the joint that is named is not always one of the link that was hit, since a force turns
every joint between the base and that link.
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
"""Time stamps are no more exact than this."""


@dataclass(frozen=True, slots=True)
class Collision:
    """A joint that something pushes.

    Attributes:
        joint: Its name; of several, the one that is furthest beyond its threshold.
        index: Its place among the model's joints.
        time_s: When it was told, in the samples' time.
        since_s: When the joint's residual first exceeded the threshold.
        torque: Residual [N·m], positive where the joint is pushed forwards.
        threshold: What it exceeds [N·m].
    """

    joint: str
    index: int
    time_s: float
    since_s: float
    torque: float
    threshold: float


class CollisionDetector:
    """Looks at one sample after the other.

    Args:
        model: Fitted, with a rigid body; a load that is no part of `payload` looks like a push.
        payload: The load that is mounted, declared or identified.
        thresholds: Those of the model's own uncertainty by default, see `CollisionThresholds`.

    Attributes:
        thresholds: As given; the observer's gain and the debounce time are theirs.

    Raises:
        FitError: The model has no rigid body, or cannot tell torques.
        SpecError: The thresholds are of other joints.
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
                f"the thresholds are of {', '.join(self.thresholds.joint_names)}, the model of "
                f"{', '.join(model.joint_names_)}",
                hint="calibrate thresholds with the model that they are for",
            )
        self._observer = MomentumObserver(model, payload, gain=self.thresholds.gain)
        self._margin = RestMargin(self.thresholds.resting)
        n = self._observer.n
        self._sign, self._since = np.zeros(n), np.full(n, np.inf)
        self._told = False

    @property
    def residual(self) -> FloatArray:
        """(n,) external torque [N·m], a view that changes with every sample."""
        return self._observer.residual

    def update(
        self, t: float, q: FloatArray, qd: FloatArray, effort: FloatArray
    ) -> Collision | None:
        """A collision when it becomes one; None while there is none, and while the same goes on.

        Args:
            t: Time of the sample [s].
            q: (n,) positions as measured [rad].
            qd: (n,) velocities [rad/s].
            effort: (n,) in the model's unit, current [A] or torque [N·m].

        Raises:
            DataError: A value is not finite, of another shape, or time does not go on.
        """
        residual = self._observer.update(t, q, qd, effort)
        limit = self.thresholds.at(qd) + self._margin.update(t, qd)
        sign = np.where(np.abs(residual) > limit, np.sign(residual), 0.0)
        self._since[sign != self._sign] = t
        self._sign = sign
        pushed = (sign != 0.0) & (t - self._since >= self.thresholds.debounce_s - TIME_S)
        if not np.any(pushed):
            # The same contact goes on as long as any joint feels it.
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
"""Deviations. Motions without load reach 3.2 on the mock, declared loads and rests need more."""

DEBOUNCE_S = 0.015
"""Three samples at 125 Hz."""

FALSE_ALARMS = 0.1

GAIN = 40.0
"""K [1/s]: a push shows by 63 % after 25 ms."""


@dataclass(frozen=True, eq=False)
class CollisionThresholds:
    """A threshold per joint: how much of a residual is the model's own error.

    Two answers. Without further data (`of`): the model's own uncertainty (`sigma_`, or the
    conformal bands of `residual`) times a quantile. Errors of models are no normal noise: they come
    in peaks where joints turn round, so the quantile is what peaks on the mock need, and promises
    nothing. The observer smooths a part of the noise that `sigma_` holds, never the slow errors;
    its gain is not counted in.

    With motions without contact (`calibrated`): what the observer itself shows of them, noise, gain
    and debounce included. Every other motion says how the joints compare, the others how far all
    thresholds have to be raised: the split-conformal quantile of the motions' peaks (Vovk et al.
    2005). A motion to come that is exchangeable with them then alarms with a probability of at most
    `false_alarms`.

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


ACCELERATION_S = 0.015
"""Time constant of the acceleration that friction is told: about the 11 Hz of fits."""

GAP_S = 0.1
"""Over a longer pause between samples momentum cannot be followed."""


class MomentumObserver:
    """The residual of any fitted model with a rigid body, one sample at a time.

    De Luca & Mattone 2005 (eq. 12), Haddadin, De Luca & Albu-Schäffer 2017 (sec. IV-E). With
    p = M(q) q̇ the momentum obeys dp/dt = τ + τ_ext + Cᵀq̇ − g − friction, so that

        r = K (p(t) − p(0) − ∫ (τ + Cᵀq̇ − g − friction + r) dt)

    is τ_ext through a first-order filter of time constant 1/K. No acceleration is in it. Friction
    that depends on the torque through the gears is told a filtered one; in the rigid body it
    cancels.

    Args:
        model: Fitted; what it says about friction is taken from its stream.
        payload: The load that is mounted, declared or identified.
        gain: K [1/s].

    Attributes:
        residual: (n,) external torque [N·m], positive where it pushes a joint forwards; the same
            array all the time.

    Raises:
        FitError: The model has no rigid body, or cannot tell torques.
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
        # Two rows: the motion, and rest in the same place, whose difference is free of gravity.
        self._motion = np.zeros((3, 2, self.n))
        self._time = -math.inf
        self._before: tuple[FloatArray, FloatArray, FloatArray] | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    def update(self, t: float, q: FloatArray, qd: FloatArray, effort: FloatArray) -> FloatArray:
        """The residual (n,) after a sample at time t [s]; `effort` is in the model's unit.

        After a pause of more than `GAP_S` the residual starts again from 0.

        Raises:
            DataError: A value is not finite, of another shape, or time does not go on.
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
        """Momentum (n,), and τ + Cᵀq̇ − g − friction (n,)."""
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
                    hint="stop the arm: its sensors are not read",
                )
        if not math.isfinite(t) or t <= self._time:
            raise DataError(
                f"a sample at {t} s follows one at {self._time} s",
                hint="give each sample once, in the order of time",
            )


FADES_S = 0.1
"""Time constant after a start: the way in which friction comes round, and the observer's lag."""


class RestMargin:
    """Dry friction of joints that stand, or stood just before.

    A joint at rest holds any torque up to its dry friction without moving, and how much it holds
    changes unseen: a controller's integral unwinds, a gear creeps. No model of the motion knows
    this torque, so that much less of a residual is a collision while a joint stands, and a while
    after.

    Args:
        level: (n,) dry friction [N·m].
    """

    def __init__(self, level: FloatArray) -> None:
        self._level = level
        self._share = np.ones_like(level)
        self._time: float | None = None

    def update(self, t: float, qd: FloatArray) -> FloatArray:
        """(n,) margin [N·m] after a sample at time t [s] with velocities (n,) [rad/s]."""
        passed = 0.0 if self._time is None else t - self._time
        self._time = t
        self._share *= math.exp(-passed / FADES_S)
        self._share[np.abs(qd) < STANDSTILL] = 1.0
        margin: FloatArray = self._level * self._share
        return margin
