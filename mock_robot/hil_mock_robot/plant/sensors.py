"""Sensors: noise, quantisation, and a velocity dead band at standstill."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray
from hil_mock_robot.plant.truth import Truth

CELSIUS_QUANTUM = 1 / 16
CELSIUS_NOISE = 0.03


class Sensors:
    """Sensors of one robot; the same truth and order of samples give the same noise.

    Every sample draws the same number of random values, row by row, so that the division of samples
    into blocks has no effect.
    """

    def __init__(self, truth: Truth, day: int = 0) -> None:
        each = [joint.sensor for joint in truth.joints]
        self._rest = np.array([sensor.rest_a for sensor in each])
        self._moving = np.array([sensor.moving_a for sensor in each])
        self._ampere = Quanta(np.array([sensor.quantum_a for sensor in each]))
        self._q = np.array([sensor.q_rad for sensor in each])
        self._qd = np.array([sensor.qd_rad_s for sensor in each])
        self._qd_rest = np.array([sensor.qd_rest_rad_s for sensor in each])
        self._half_speed = truth.noise_speed_rad_s
        self._rng = np.random.default_rng(
            [truth.seed, len(each), truth.ranges, *([day] if day else [])]
        )

    def measure(
        self, q: FloatArray, qd: FloatArray, current: FloatArray, celsius: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return measured position, velocity, current and temperature for true values (N, n)."""
        noise = self._rng.standard_normal((len(q), 4, q.shape[1]))
        speed = np.abs(qd)
        share = speed / (speed + self._half_speed)
        deviation = self._rest + (self._moving - self._rest) * share
        return (
            q + noise[:, 0] * self._q,
            np.where(speed < self._qd_rest, 0.0, qd + noise[:, 1] * self._qd),
            self._ampere.rounded(current + noise[:, 2] * deviation),
            np.rint((celsius + noise[:, 3] * CELSIUS_NOISE) / CELSIUS_QUANTUM) * CELSIUS_QUANTUM,
        )


class Quanta:
    """Quantisation steps of a sensor.

    Args:
        quantum: (n,) size of one step; 0 for no quantisation.
    """

    def __init__(self, quantum: FloatArray) -> None:
        stepped = quantum > 0
        self._step = np.where(stepped, quantum, 1.0)
        self._unstepped = None if stepped.all() else ~stepped

    def rounded(self, values: FloatArray) -> FloatArray:
        """Return values (N, n) rounded to whole steps; unchanged without quantisation."""
        rounded: FloatArray = np.rint(values / self._step) * self._step
        if self._unstepped is not None:
            rounded[:, self._unstepped] = values[:, self._unstepped]
        return rounded
