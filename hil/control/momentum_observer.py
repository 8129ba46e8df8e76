"""External torques without accelerations: the residual of the generalised momentum.

De Luca & Mattone 2005 (eq. 12), Haddadin, De Luca & Albu-Schäffer 2017 (sec. IV-E). With
p = M(q) q̇ the momentum obeys dp/dt = τ + τ_ext + Cᵀq̇ − g − friction, so that

    r = K (p(t) − p(0) − ∫ (τ + Cᵀq̇ − g − friction + r) dt)

is τ_ext through a first-order filter of time constant 1/K. No acceleration is in it. Friction that
depends on the torque through the gears is told a filtered one; in the rigid body it cancels.
"""

from __future__ import annotations

import math

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FloatArray
from hil.estimators import RobotEstimator, number, require_torque
from hil.export import rigid_parameters

GAIN = 40.0
"""K [1/s]: a push shows by 63 % after 25 ms."""

ACCELERATION_S = 0.015
"""Time constant of the acceleration that friction is told: about the 11 Hz of fits."""

GAP_S = 0.1
"""Over a longer pause between samples momentum cannot be followed."""


class MomentumObserver:
    """The residual of any fitted model with a rigid body, one sample at a time.

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
