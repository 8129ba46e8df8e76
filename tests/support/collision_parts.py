"""Motions of simulated UR5s, with pushes at the flange, for tests of collision detection."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.data import Conditions, Dataset
from hil.dynamics import load_model
from hil.estimators import estimator
from hil_mock_robot.plant.sensors import Sensors
from hil_mock_robot.plant.simulation import Setting, Simulation
from hil_mock_robot.plant.truth import draw_truth
from tests.support.mock_motions import fourier

RATE_HZ = load_arm("ur5").rate_hz
MIDDLE = np.radians([20.0, -80.0, 70.0, -60.0, 60.0, 10.0])
STEP_RAD = 1e-6


@dataclass(frozen=True)
class Push:
    """A force (3,) [N] at the flange in the base frame, from one sample to before another."""

    force: tuple[float, float, float]
    first: int
    last: int


def motion(seed, period_s=10.0):
    """Set-points (N, 3, 6) from rest to rest about a pose of their own."""
    start = MIDDLE + np.random.default_rng([7, seed]).uniform(-0.7, 0.7, 6)
    return fourier(start, RATE_HZ, seed, period_s, peak_rad_s=1.2)


def recorded(robot, setpoints, *, noise=0, mounted=None, declared=None, push=None):
    """One motion of the mock with this seed, as measured."""
    truth = draw_truth("ur5", robot)
    simulation = Simulation(truth, Setting(RATE_HZ), setpoints[0, 0].copy())
    simulation.set_payloads(mounted or Payload(), mounted or Payload())
    simulation.settle()
    values = np.concatenate([piece.values for piece in _played(simulation, setpoints, push)])
    q, qd, current, celsius = values[:, :4].swapaxes(0, 1)
    sensors = Sensors(truth)
    sensors._rng = np.random.default_rng([robot, noise])
    q, qd, current, _ = sensors.measure(q, qd, current, celsius)
    columns = {"t": np.arange(len(q)) / RATE_HZ, "q": q, "qd": qd, "effort": current}
    condition = Conditions(
        f"motion {noise}", "trajectory", f"mock {robot}", noise, payload=declared or Payload()
    )
    return Dataset(
        "ur5", load_model("ur5").joint_names, "current", columns,
        np.array([0, len(q)]), (condition,),
        np.array([joint.drive.gain_nm_a for joint in truth.joints]), "the truth",
    )  # fmt: skip


def quiet(robot, seeds, period_s=10.0):
    """Motions without contact."""
    return Dataset.concatenate(
        [recorded(robot, motion(seed, period_s), noise=seed) for seed in seeds]
    )


@cache
def _learnt_from(robot):
    return quiet(robot, range(100, 105), 6.0)


@cache
def fitted(robot, name="rigid-hysteresis"):
    """A model of five motions of six seconds, which no test changes."""
    return estimator(name).fit(_learnt_from(robot), load_model("ur5"))


def collisions_in(detector, data):
    """All collisions that a detector finds, sample by sample, and the residuals (N, n)."""
    found, residuals = [], []
    for row in zip(*(data[name] for name in ("t", "q", "qd", "effort")), strict=True):
        collision = detector.update(*row)
        found += [] if collision is None else [collision]
        residuals.append(detector.residual.copy())
    return found, np.array(residuals)


def joint_torque(force, q):
    """(6,) torques of a force at the flange, by differences of its position."""
    step = STEP_RAD * np.eye(6)
    ahead, behind = (load_model("ur5").flange_pose(q + s * step)[:, :3, 3] for s in (1, -1))
    return (ahead - behind) @ np.asarray(force) / (2 * STEP_RAD)


def _played(simulation, setpoints, push):
    if push is None:
        yield simulation.advance(setpoints)
        return
    yield simulation.advance(setpoints[: push.first])
    for k in range(push.first, push.last):
        simulation.disturbances.push[:] = joint_torque(push.force, simulation.position)
        yield simulation.advance(setpoints[k : k + 1])
    simulation.disturbances.push[:] = 0.0
    yield simulation.advance(setpoints[push.last :])
