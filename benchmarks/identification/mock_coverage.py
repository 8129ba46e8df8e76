"""Do 95 % intervals of identified parameters hold the true ones? Mock robots, seed by seed.

An `ideal` robot has the model's form: rigid bodies, Coulomb and viscous friction, a linear drive
and noise on current, position and velocity. What is given to the fit is what its standard errors
say they take for given: gains, the width of the smooth sign, and the delay between current and
state. A `full` robot has friction of another form; there bias and coverage are told, not promised.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.identification.mock_recording import advanced, delay_s, recorded, trajectories
from benchmarks.identification.mock_truth import sign_widths, true_coefficients
from hil.core.parallel import processes
from hil.core.typing import FloatArray, IntArray
from hil.dynamics import load_model
from hil.estimators.rigid_linear import Covariance, RigidLeastSquares
from hil_mock_robot.plant.simulation import Setting, Simulation
from hil_mock_robot.plant.truth import Profile, draw_truth

TRAJECTORIES, RATE_HZ, SUBSTEP_HZ = 8, 1000.0, 8000.0
"""Integration steps of the mock's usual 1 ms would be seen: half a step is half a millisecond."""

FILTERS = {"unit": "hz", "velocity": 80.0, "acceleration": 12.0, "effort": 12.0, "every": 5}
"""Velocities wide open: a reversal that a filter has rounded makes friction columns of another
form. Friction columns and effort then go through the same narrow filter, which leaves the
acceleration, differentiated noise, little to bias with."""

LEVEL = 0.95
COVARIANCES: tuple[Covariance, ...] = ("hac", "clustered")
"""The last one is what groups are told of."""


class KnownWidths(RigidLeastSquares):
    """Weighted least squares that is told each joint's width of the smooth sign."""

    widths: FloatArray

    def _friction(self, qd: FloatArray) -> dict[str, FloatArray]:
        sign = np.tanh(qd / self.widths)
        return {"coulomb": sign, "viscous": np.array(qd), "offset": np.ones_like(qd)}


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """One fit to one robot.

    Attributes:
        names: Of the parameters, length p.
        truth, value, error: (p,) in SI, errors clustered by trajectory.
        covered: By covariance, (p,) 1 where the 95 % interval holds the truth and 0 elsewhere.
    """

    names: tuple[str, ...]
    truth: FloatArray
    value: FloatArray
    error: FloatArray
    covered: Mapping[str, FloatArray]

    @property
    def z(self) -> FloatArray:
        """(p,) errors in standard errors."""
        return np.asarray((self.value - self.truth) / self.error)


def estimated(
    seed: int, arm: str = "ur5", profile: Profile = "ideal", noise: int | None = None
) -> Estimate:
    """Simulate one robot and fit it, with each kind of standard error.

    Args:
        seed: Which robot.
        arm: Its kind.
        profile: `ideal` or `full`.
        noise: Seed of the sensors' noise in place of the robot's own.
    """
    truth, series = draw_truth(arm, seed, profile), trajectories(arm, TRAJECTORIES)
    simulation = Simulation(truth, Setting(RATE_HZ, SUBSTEP_HZ), series[0].q_start)
    found = recorded(truth, simulation, series, noise=noise)
    data, robot = advanced(found.data, delay_s(simulation)), load_model(arm)
    covered: dict[str, FloatArray] = {}
    with threadpool_limits(1):
        for covariance in COVARIANCES:
            model = _model(sign_widths(truth), covariance).fit(data, robot)
            true = true_coefficients(truth, model.base)
            low, high = model.interval(LEVEL).T
            covered[covariance] = ((low <= true) & (true <= high)).astype(np.float64)
    return Estimate(model.parameter_names_, true, model.coefficients_, model.std_error_, covered)


def all_estimated(seeds: Sequence[int], jobs: int = 2, **given: Any) -> list[Estimate]:
    """One estimate per seed, in that order, in processes of their own."""
    work: Callable[[int], Estimate] = partial(estimated, **given)
    if jobs == 1:
        return [work(seed) for seed in seeds]
    with processes(jobs) as pool:
        return list(pool.map(work, seeds))


def groups(names: Sequence[str]) -> dict[str, IntArray]:
    """Numbers of the parameters of each kind: what they are the parameters of."""
    kinds = [_kind(name) for name in names]
    return {kind: np.flatnonzero([k == kind for k in kinds]) for kind in dict.fromkeys(kinds)}


def figures(estimates: Sequence[Estimate]) -> dict[str, float]:
    """Coverage, overall and by group of parameters, and bias in standard errors and per cent."""
    z = np.stack([one.z for one in estimates])
    held = {kind: np.stack([one.covered[kind] for one in estimates]) for kind in COVARIANCES}
    told = {f"coverage_{kind}": float(np.mean(hits)) for kind, hits in held.items()}
    covered = held[COVARIANCES[-1]]
    for kind, chosen in groups(estimates[0].names).items():
        own = covered[:, chosen].mean(axis=0)
        told[f"{kind}_coverage"] = float(own.mean())
        told[f"{kind}_worst_coverage"] = float(own.min())
        told[f"{kind}_bias_std_errors"] = _rms(z[:, chosen].mean(axis=0))
        bias = np.mean([one.value[chosen] - one.truth[chosen] for one in estimates], axis=0)
        size = _rms(np.stack([one.truth[chosen] for one in estimates]))
        if size > 0:
            told[f"{kind}_bias_percent"] = 100 * _rms(bias) / size
    return told


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _kind(name: str) -> str:
    if "." in name and name.split(".")[-1] in ("coulomb", "viscous", "offset"):
        return name.split(".")[-1]
    if name.startswith("Ia_"):
        return "rotor"
    return "moment" if name.startswith("m") else "inertia"


def _model(widths: FloatArray, covariance: Covariance) -> KnownWidths:
    model = KnownWidths(method="wls", covariance=covariance, filters=dict(FILTERS))
    model.widths = widths
    return model
