"""Models of arms other than six revolute joints with a motor each, fitted to their own torques."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from hil.data import Conditions, Dataset
from hil.dynamics import RobotModel, load_model
from hil.estimators import estimator
from hil.estimators.base import RobotEstimator
from tests.dynamics.test_model import SLIDING

ARMS = ("tx40@motors", "panda", "sliding")
"""Coupled motors; seven joints; joints that slide. TURNED of the last so that all is exciting."""

TURNED = (
    SLIDING.replace('name="x" type="prismatic"', 'name="x" type="revolute"')
    .replace('xyz="1 0 0.5"', 'xyz="0.2 1 0.1"')
    .replace('name="z" type="prismatic"', 'name="z" type="revolute"')
    .replace('name="r" type="revolute"', 'name="r" type="prismatic"')
)


@cache
def fitted_arm(name: str, folder: Path) -> RobotEstimator:
    """`rigid-wls` of one of `ARMS`; `folder` takes what has to be written for it."""
    return fitted_robot(robot_of(name, folder))


def robot_of(name: str, folder: Path) -> RobotModel:
    """One of `ARMS`."""
    return from_text(TURNED, folder) if name == "sliding" else load_model(name)


def from_text(urdf: str, folder: Path) -> RobotModel:
    """An arm of three joints from its description."""
    (folder / "a.urdf").write_text(urdf, "utf-8")
    return RobotModel.from_urdf(folder / "a.urdf", rotor_inertia=[0.4, 0.1, 0.2])


def fitted_robot(robot: RobotModel, samples: int = 800) -> RobotEstimator:
    """`rigid-wls` of three trajectories without noise."""
    n = robot.n
    parts = [_trajectory(robot, seed, samples) for seed in (1, 2, 3)]
    t, q, qd, qdd, effort = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    columns = {"t": t, "q": q, "qd": qd, "effort": effort}
    columns |= {"q_f": q, "qd_f": qd, "qdd_f": qdd, "effort_f": effort}
    x, y, z = (float(v) for v in robot.gravity_vector)
    data = Dataset(
        robot=robot.name, joint_names=robot.joint_names, effort_kind="torque", columns=columns,
        offsets=np.arange(4, dtype=np.int64) * samples,
        conditions=tuple(Conditions(f"t{k}", "trajectory", f"r{k}", k) for k in range(3)),
        drive_gains=np.ones(n), gravity=(x, y, z),
    )  # fmt: skip
    return estimator("rigid-wls").fit(data, robot)


def _trajectory(robot: RobotModel, seed: int, samples: int) -> tuple[np.ndarray, ...]:
    random, t = np.random.default_rng(seed), np.arange(samples) / 100.0
    q, qd, qdd = (np.zeros((samples, robot.n)) for _ in range(3))
    q += random.uniform(-0.5, 0.5, robot.n)
    for h in range(1, 6):
        w = 0.2 * np.pi * h
        a, b = random.uniform(-0.5, 0.5, (2, robot.n)) / h
        s, c = np.sin(w * t)[:, None], np.cos(w * t)[:, None]
        q, qd, qdd = q + a * s + b * c, qd + w * (a * c - b * s), qdd - w * w * (a * s + b * c)
    effort = robot.inverse_dynamics(q, qd, qdd) + 3 * np.tanh(qd / 0.01) + 2 * qd + 0.1
    return t, q, qd, qdd, effort
