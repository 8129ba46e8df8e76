"""A small fitted model of every kind, of every build of arm, each fitted once."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.data import Conditions, Dataset
from hil.dynamics import RobotModel, load_model
from hil.estimators import estimator
from hil.estimators.base import RobotEstimator
from hil.export.program import GROUPS
from tests.support import lagrangian_models, residual_models
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import arriving, dwelling, moving, nominal

TRAINING = {"epochs": 3, "batch_size": 300, "device": "cpu"}
RESIDUAL = {
    "base": residual_models.SMOOTH, "network": residual_models.SMALL,
    "training": {"epochs": 1, "batch_size": 16, "device": "cpu"}, "folds": 1, "margin": 0.0,
}  # fmt: skip
EXTRA = {"residual": "torch", "lagrangian": "torch", "rigid-lmi": "cvxpy", "rigid-irls": "cvxpy",
         "rigid-hysteresis": "cvxpy"}  # fmt: skip
"""Library that an estimator needs; a test of its models is skipped without it."""

KINDS: dict[str, dict[str, Any]] = {
    "rigid-wls": {},
    "rigid-wls hard": {"sign_width": 0.0},
    "rigid-linear": {},
    "rigid-linear ridge": {"method": "ridge", "alpha": 1e-6},
    "rigid-lmi": {},
    "rigid-irls": {},
    "rigid-irls plain": {"feasible": False, "exponent": False},
    "rigid-diffnea": {},
    "rigid-diffnea plain": {"friction": "coulomb-viscous"},
    "rigid-diffnea power": {"friction": "stribeck-power"},
    "rigid-diffnea memory": {"friction": "memory"},
    "rigid-hysteresis": {},
    "residual": RESIDUAL,
    "lagrangian": {"network": {"hidden": [12]}, "training": TRAINING},
    "lagrangian coulomb": {
        "friction": "coulomb", "direction": "dahl", "network": {"hidden": [12]},
        "training": TRAINING,
    },
    "lagrangian dissipative": {
        "friction": "dissipative", "network": {"hidden": [12]}, "training": TRAINING
    },
    "static-wls": {},
    "static-wls paper": {"form": "paper"},
    "static-wls current": {"form": "paper", "current_term": True},
    "static-linear": {},
    "static-linear lasso": {"method": "lasso"},
    "static-inverse": {},
    "static-inverse shared": {"form": "shared", "square": "free"},
    "static-coulomb": {},
    "static-hysteresis": {"gear_ratio": 101.0},
    "static-mlp-lm": {"layers": (4, 6, 1), "epochs": 20},
}  # fmt: skip
"""Name of a registered estimator, with a word where there are several of it, and its parameters."""

PROGRAMS: dict[str, dict[str, Any]] = {
    "rigid-diffnea hard": {"friction": "stribeck-power", "sign_width": 0.0},
    "rigid-hysteresis every group": {"consistent": False, "friction": list(GROUPS)},
    "rigid-hysteresis warm": {"consistent": False, "friction": ["core", "load", "temperature"]},
    "residual folds": {**RESIDUAL, "folds": 2},
    "residual none kept": {**RESIDUAL, "base": {"estimator": "rigid-wls"}, "margin": 0.99},
    "residual measured": {**RESIDUAL, "inputs": "measured"},
    "residual lagrangian": {
        **RESIDUAL,
        "base": {
            "estimator": "lagrangian", "network": {"hidden": [12]},
            "training": lagrangian_models.QUICK,
        },
    },
}  # fmt: skip
"""More of what programs are made of; so is `lagrangian: ` with a case of `lagrangian_models`."""

ARMS = ("rigid-wls hard on sliding", "rigid-linear on tx40@motors", "rigid-lmi on panda")
"""Joints that slide; motors that move two joints; seven joints. All of torques, without noise."""

SLIDING = Path(__file__).with_name("sliding_arm.urdf")


@cache
def fitted(kind: str) -> RobotEstimator:
    """A model of `KINDS`, `PROGRAMS` or `ARMS`; not to be changed."""
    if extra := EXTRA.get(kind.split()[0].rstrip(":")):
        pytest.importorskip(extra, reason=f"{extra} is not installed")
    if kind.startswith("lagrangian: "):
        return lagrangian_models.lagrangian(kind.removeprefix("lagrangian: "))
    kind, _, arm = kind.partition(" on ")
    unfitted = estimator(kind.split()[0], **(KINDS | PROGRAMS)[kind])
    if arm:
        robot = sliding_arm() if arm == "sliding" else load_model(arm)
        return unfitted.fit(torques_of(robot, unfitted.get_params()["sign_width"]), robot)
    return unfitted.fit(_data(kind), nominal())


def _data(kind: str) -> Dataset:
    name = kind.split()[0]
    if name in ("static-coulomb", "static-hysteresis"):
        return arriving(60, load_share=0.1)
    if name.startswith("static"):
        return dwelling(80, stiction_nm=1.0)
    if kind == "rigid-hysteresis warm":
        return remembering(1, 2, 3, celsius=(20.0, 45.0))
    if name == "rigid-hysteresis" or kind.endswith(("memory", "coulomb")):
        return remembering(1, 2, 3, samples=500)
    seeds = (1, 2, 3, 4) if kind in PROGRAMS else (1, 2, 3)
    return moving(*seeds, noise_a=0.02)


@cache
def exact() -> RobotEstimator:
    """`rigid-wls` of data without noise: its links are those of bodies that exist."""
    return estimator("rigid-wls").fit(moving(1, 2, 3), nominal())


def sliding_arm(path: Path = SLIDING) -> RobotModel:
    """Return a three-joint arm from a URDF file; joint 2 of the default one is prismatic."""
    return RobotModel.from_urdf(path, rotor_inertia=[0.4, 0.1, 0.2])


def torques_of(robot: RobotModel, sign_width: float = 0.01, samples: int = 800) -> Dataset:
    """Three trajectories of any arm with 3 N·m Coulomb and 2 N·m·s/rad viscous friction."""
    parts = [_trajectory(robot, sign_width, seed, samples) for seed in (1, 2, 3)]
    t, q, qd, qdd, effort = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    columns = {"t": t, "q": q, "qd": qd, "effort": effort}
    columns |= {"q_f": q, "qd_f": qd, "qdd_f": qdd, "effort_f": effort}
    x, y, z = (float(v) for v in robot.gravity_vector)
    return Dataset(
        robot=robot.name, joint_names=robot.joint_names, effort_kind="torque", columns=columns,
        offsets=np.arange(4, dtype=np.int64) * samples,
        conditions=tuple(Conditions(f"t{k}", "trajectory", f"r{k}", k) for k in range(3)),
        drive_gains=np.ones(robot.n), gravity=(x, y, z),
    )  # fmt: skip


def _trajectory(
    robot: RobotModel, sign_width: float, seed: int, samples: int
) -> tuple[np.ndarray, ...]:
    t, q, qd, qdd = smooth(robot.n, seed, samples)
    sign = np.tanh(qd / sign_width) if sign_width else np.sign(qd)
    effort = robot.inverse_dynamics(q, qd, qdd) + 3 * sign + 2 * qd + 0.1
    return t, q, qd, qdd, effort


def smooth(n: int, seed: int, samples: int) -> tuple[np.ndarray, ...]:
    """Random motion at 100 Hz: t (N,), q, qd, qdd (N, n)."""
    random, t = np.random.default_rng(seed), np.arange(samples) / 100.0
    q, qd, qdd = (np.zeros((samples, n)) for _ in range(3))
    q += random.uniform(-0.5, 0.5, n)
    for h in range(1, 6):
        w = 0.2 * np.pi * h
        a, b = random.uniform(-0.5, 0.5, (2, n)) / h
        s, c = np.sin(w * t)[:, None], np.cos(w * t)[:, None]
        q, qd, qdd = q + a * s + b * c, qd + w * (a * c - b * s), qdd - w * w * (a * s + b * c)
    return t, q, qd, qdd
