"""How much of what classical methods leave our default explains, on robots whose noise is known.

A `full` mock robot follows twelve Fourier trajectories at 1 kHz. Every method is fitted to seven of
them and judged on three, as the study `dynamic-identification` does. The oracle knows the robot,
friction states included: its error is the sensor's noise, what the measured current holds beyond
the true one, through the same filter.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.identification.mock_recording import recorded, trajectories
from hil.arms import load_arm
from hil.core.errors import HilError
from hil.core.parallel import processes
from hil.core.typing import FloatArray
from hil.data.dataset import Dataset
from hil.data.filters import prepare
from hil.dynamics import RobotModel, load_model
from hil.estimators.base import RobotEstimator
from hil.studies.dynamic_methods import (
    METHODS,
    Parts,
    Trajectories,
    honest_parts,
    missing,
    score,
    trajectories_of,
    unfitted,
)
from hil_mock_robot.plant.simulation import Setting, Simulation
from hil_mock_robot.plant.truth import draw_truth

TRAJECTORIES, QUICK_TRAJECTORIES, RATE_HZ = 12, 6, 1000.0
CUTOFF_HZ, FIT_HZ, SIGN_WIDTH = 50.0, 125.0, 0.01
CLASSICAL = ("ols", "wls", "lmi", "lmi-weighted", "irls", "ridge", "tls")
"""Methods of the literature; the best of them on the test trajectories is what is to be beaten."""

OURS, ORACLE = "hysteresis", "oracle"
POSES = 1000
"""At which a mass matrix has to be positive definite."""

TRUE = "true_effort"


@dataclass(frozen=True, slots=True, eq=False)
class Contest:
    """One robot.

    Attributes:
        seed: Which.
        filtered, raw: By method and for the oracle, mean RMSE over the joints [N·m].
        seconds: By method, CPU time of the fit.
        least_inertia: By method with physical parameters, the least eigenvalue of M(q) over
            random poses, relative to the largest.
        failed: By method, why it is not among the others.
    """

    seed: int
    filtered: dict[str, float]
    raw: dict[str, float]
    seconds: dict[str, float]
    least_inertia: dict[str, float]
    failed: dict[str, str]

    def share_of_gap(self, errors: dict[str, float]) -> float:
        """Of the way from the best classical method to the oracle, how much ours goes."""
        best = min(error for name, error in errors.items() if name in CLASSICAL)
        return (best - errors[OURS]) / (best - errors[ORACLE])


def contest(seed: int, arm: str = "ur5", quick: bool = False) -> Contest:
    """Simulate one robot, fit every method, judge it."""
    of, robot = observed(seed, arm, QUICK_TRAJECTORIES if quick else TRAJECTORIES), load_model(arm)
    parts = honest_parts(of, seed)
    found = Contest(seed, {}, {}, {}, {}, {})
    with threadpool_limits(1):
        for key in ("wls", OURS) if quick else METHODS:
            if not missing(METHODS[key]):
                _judge(key, of, parts, robot, found)
    for errors, kind in ((found.filtered, "_f"), (found.raw, "")):
        noise = parts.test["effort" + kind] - parts.test[TRUE + kind]
        errors[ORACLE] = float(np.mean(of.scale * _rms(noise)))
    return found


def contests(
    seeds: Sequence[int], jobs: int = 2, arm: str = "ur5", quick: bool = False
) -> list[Contest]:
    """One per seed, in processes of their own."""
    work = partial(contest, arm=arm, quick=quick)
    if jobs == 1:
        return [work(seed) for seed in seeds]
    with processes(jobs) as pool:
        return list(pool.map(work, seeds))


def observed(seed: int, arm: str, count: int) -> Trajectories:
    """Return the filtered trajectories of one robot with all effects, and the true current."""
    truth, series = draw_truth(arm, seed, "full"), trajectories(arm, count)
    simulation = Simulation(truth, Setting(RATE_HZ), series[0].q_start)
    simulation.settle()
    run = recorded(truth, simulation, series, moves=True)
    # What is declared about the drives, as on a bench: the truth is 1 to 6 % off.
    data = replace(run.data, drive_gains=load_arm(arm).drive_gains, drive_gains_source="nominal")
    robot = load_model(arm)
    of = trajectories_of(data, robot, CUTOFF_HZ, FIT_HZ)
    clean: Dataset = prepare(data.with_columns(effort=run.clean), of.filters)
    columns = {TRUE: run.clean, TRUE + "_f": clean["effort_f"]}
    return replace(of, data=of.data.with_columns(**columns))


def mass_matrices(inertial: FloatArray, robot: RobotModel, q: FloatArray) -> FloatArray:
    """(N, n, n) of a robot with other parameters (11 n,), at positions (N, n)."""
    still = np.zeros_like(q)
    gravity = robot.torque(inertial, q, still, still)
    columns = []
    for j in range(robot.n):
        unit = np.zeros_like(q)
        unit[:, j] = 1.0
        columns.append(robot.torque(inertial, q, still, unit) - gravity)
    return np.stack(columns, axis=2)


def least_inertia(inertial: FloatArray, robot: RobotModel, seed: int = 0) -> float:
    """Least eigenvalue of M(q) over the largest, least over random poses."""
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (POSES, robot.n))
    M = mass_matrices(inertial, robot, q)
    values = np.linalg.eigvalsh(0.5 * (M + M.transpose(0, 2, 1)))
    return float(np.min(values[:, 0] / values[:, -1]))


def _judge(key: str, of: Trajectories, parts: Parts, robot: RobotModel, found: Contest) -> None:
    begin = time.process_time()
    try:
        model: RobotEstimator = unfitted(METHODS[key], SIGN_WIDTH, of.filters)
        model.fit(parts.train, robot)
    except HilError as error:
        found.failed[key] = error.message
        return
    found.seconds[key] = time.process_time() - begin
    told = score(model, parts)
    found.filtered[key], found.raw[key] = float(np.mean(told.filtered)), float(np.mean(told.raw))
    inertial = getattr(model, "inertial_", None)
    if inertial is not None:
        found.least_inertia[key] = least_inertia(np.asarray(inertial), robot)


def _rms(errors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))
