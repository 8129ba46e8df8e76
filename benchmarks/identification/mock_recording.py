"""Fourier trajectories of mock robots as datasets, straight from the simulation: no files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.identification.mock_truth import true_gains
from hil.arms import load_arm
from hil.core.typing import FloatArray
from hil.data.dataset import Conditions, Dataset
from hil.excitation.motion import FourierSeries, Line, Motion
from hil_mock_robot.plant.sensors import Sensors
from hil_mock_robot.plant.simulation import Simulation
from hil_mock_robot.plant.truth import Truth

HARMONICS, FUNDAMENTAL_HZ = 5, 0.1
AMPLITUDE_RAD, VELOCITY_RAD_S, ACCELERATION_RAD_S2 = 1.0, 1.7, 5.0
CENTRE_RAD = 1.2
"""Trajectories go round poses so far from the middle of each joint's range for excitation."""

MOVE_RAD_S, MOVE_RAD_S2, MOVE_RAD_S3 = 1.0, 3.0, 30.0
SERVO_S = 1e-3
"""The mock's servo holds a current for so long, and reports it with the state at the end of it."""

PAUSE_S = 5.0
"""Between the time stamps of two trajectories."""


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """What sensors saw, and what was there to be seen.

    Attributes:
        data: Trajectories as measured.
        clean: (N, n) current without the sensor's noise [A].
    """

    data: Dataset
    clean: FloatArray


def trajectories(arm: str, count: int, seed: int = 0) -> list[FourierSeries]:
    """Random series of five harmonics, 10 s from rest to rest, within limits.

    No collision model looks at them: the simulation knows no obstacles.
    """
    description = load_arm(arm)
    middle = 0.5 * (description.excite_min + description.excite_max)
    return [_drawn(np.random.default_rng([seed, k]), middle) for k in range(count)]


def recorded(
    truth: Truth,
    simulation: Simulation,
    series: Sequence[FourierSeries],
    *,
    noise: int | None = None,
    moves: bool = False,
) -> Recorded:
    """Play the trajectories and measure them, moves between them left out.

    Time stamps are the mock's: the current of a row belongs `delay_s` before its state.

    Args:
        truth: What the robot is like.
        simulation: Of it, at the start of the first trajectory.
        series: To follow.
        noise: Seed of the sensors' noise in place of the robot's own.
        moves: Move from one to the next; otherwise each begins with an arm that jumped there.
    """
    sensors, rate = Sensors(truth), simulation.setting.rate_hz
    if noise is not None:
        sensors._rng = np.random.default_rng([truth.seed, noise])  # noqa: SLF001
    columns: list[tuple[FloatArray, ...]] = []
    for k, motion in enumerate(series):
        if moves and k:
            _follow(simulation, _way(series[k - 1].q_end, motion.q_start, rate))
        elif not moves:
            simulation = Simulation(truth, simulation.setting, motion.q_start)
            simulation.settle()
        true = _follow(simulation, motion)
        q, qd, current, celsius = sensors.measure(*true)
        t = np.arange(len(q)) / rate + k * (motion.duration_s + PAUSE_S)
        columns.append((t, q, qd, current, celsius, true[2]))
    t, q, qd, current, celsius, clean = (np.concatenate(c) for c in zip(*columns, strict=True))
    data = {"t": t, "q": q, "qd": qd, "effort": current, "temperature": celsius}
    return Recorded(_dataset(truth, data, [len(c[0]) for c in columns]), clean)


def delay_s(simulation: Simulation) -> float:
    """By how much the current of a row is older than its state, on average.

    Half of the servo's cycle, for which it is held, and half a step of the integration, in which
    positions already move with the new velocity (semi-implicit Euler).
    """
    return 0.5 * (SERVO_S + 1.0 / simulation.setting.substep_hz)


def advanced(data: Dataset, seconds: float) -> Dataset:
    """Shift the effort of a dataset to the state it belongs to."""
    effort = np.empty_like(data["effort"])
    for _, rows in data.slices():
        t = data["t"][rows]
        for j, values in enumerate(data["effort"][rows].T):
            effort[rows, j] = np.interp(t + seconds, t, values)
    return data.with_columns(effort=effort)


def _drawn(random: np.random.Generator, middle: FloatArray) -> FourierSeries:
    n, order = len(middle), np.arange(1, HARMONICS + 1)
    a, b = random.standard_normal((2, n, HARMONICS))
    a -= a.mean(axis=1, keepdims=True)
    b -= (b @ order / (order @ order))[:, None] * order
    unit = _series(np.zeros(n), a, b).sample(200.0)
    limits = (AMPLITUDE_RAD, VELOCITY_RAD_S, ACCELERATION_RAD_S2)
    peaks = [np.abs(values).max(axis=0) for values in (unit.q, unit.qd, unit.qdd)]
    largest = np.min([limit / peak for limit, peak in zip(limits, peaks, strict=True)], axis=0)
    scale = (largest * random.uniform(0.7, 1.0, n))[:, None]
    return _series(middle + random.uniform(-CENTRE_RAD, CENTRE_RAD, n), a * scale, b * scale)


def _series(q0: FloatArray, a: FloatArray, b: FloatArray) -> FourierSeries:
    rows = [tuple(tuple(map(float, row)) for row in matrix) for matrix in (a, b)]
    return FourierSeries(tuple(map(float, q0)), rows[0], rows[1], FUNDAMENTAL_HZ, 1)


def _way(start: FloatArray, goal: FloatArray, rate: float) -> Line:
    ends = tuple(map(float, start)), tuple(map(float, goal))
    return Line(*ends, MOVE_RAD_S, MOVE_RAD_S2, MOVE_RAD_S3, rate)


def _follow(
    simulation: Simulation, motion: Motion
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return true position, velocity, current and temperature, each (N, n)."""
    points = motion.sample(simulation.setting.rate_hz)
    found = simulation.advance(np.stack([points.q, points.qd, points.qdd], axis=1))
    if found.fault:
        raise AssertionError(f"the mock {simulation.truth.arm} stopped with fault {found.fault}")
    return found["q"], found["qd"], found["current"], found["celsius"]


def _dataset(truth: Truth, columns: dict[str, FloatArray], lengths: Sequence[int]) -> Dataset:
    source = f"mock {truth.arm} {truth.seed} {truth.profile}"
    conditions = tuple(
        Conditions(f"trajectory {k}", "trajectory", source, trajectory=k)
        for k in range(len(lengths))
    )
    names = tuple(f"J{j + 1}" for j in range(len(truth.joints)))
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    return Dataset(
        truth.arm, names, "current", columns, offsets, conditions, true_gains(truth), "the truth"
    )
