"""Datasets of a UR5 whose efforts are known exactly, for tests of estimators and evaluation."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from hil.arms.payload import Payload
from hil.core.typing import FloatArray
from hil.data import Conditions, Dataset
from hil.data.arrivals import ARRIVAL_POINTS, ARRIVAL_STEP_S
from hil.dynamics import RobotModel, load_model

GAINS = np.array([10.0, 11.0, 9.0, 8.0, 7.0, 6.0])
COULOMB = np.array([6.0, 7.0, 5.0, 1.5, 1.2, 1.0])
VISCOUS = np.array([8.0, 9.0, 6.0, 2.0, 1.5, 1.0])
OFFSET = np.array([0.3, -0.2, 0.1, 0.05, -0.05, 0.02])
ROTORS = np.array([0.7, 0.8, 0.6, 0.1, 0.12, 0.09])
SIGN_WIDTH = 0.01
LOAD = Payload(2.0, (0.02, -0.03, 0.06), (0.004, 0.005, 0.003, 0.0, 0.0, 0.0))


@cache
def plant() -> RobotModel:
    """The UR5 with rotor inertias, whose torques the tests take as the truth."""
    return RobotModel.from_arm("ur5", rotor_inertia=ROTORS)


@cache
def nominal() -> RobotModel:
    """The UR5 an estimator is given."""
    return load_model("ur5")


def fourier(seed: int, samples: int = 600, rate_hz: float = 100.0) -> tuple[FloatArray, ...]:
    """Smooth random motion of six joints: t (N,), q, qd, qdd (N, 6)."""
    random = np.random.default_rng(seed)
    t = np.arange(samples) / rate_hz
    q, qd, qdd = (np.zeros((samples, 6)) for _ in range(3))
    q += random.uniform(-1.0, 1.0, 6)
    for harmonic in range(1, 6):
        w = 2 * np.pi * 0.1 * harmonic
        a, b = random.uniform(-0.6, 0.6, (2, 6)) / harmonic
        s, c = np.sin(w * t)[:, None], np.cos(w * t)[:, None]
        q += a * s + b * c
        qd += w * (a * c - b * s)
        qdd -= w * w * (a * s + b * c)
    return t, q, qd, qdd


def true_torque(
    q: FloatArray, qd: FloatArray, qdd: FloatArray, load: Payload | None = None
) -> FloatArray:
    """Rigid-body torque with the load mounted, plus Coulomb, viscous and offset."""
    robot = plant().with_payload(load) if load else plant()
    friction = COULOMB * np.tanh(qd / SIGN_WIDTH) + VISCOUS * qd + OFFSET
    return robot.inverse_dynamics(q, qd, qdd) + friction


def moving(
    *seeds: int,
    noise_a: float = 0.0,
    load: Payload | None = None,
    kind: str = "current",
    samples: int = 600,
) -> Dataset:
    """One trajectory per seed, already prepared with its exact derivatives."""
    parts = []
    for seed in seeds:
        t, q, qd, qdd = fourier(seed, samples)
        scale = GAINS if kind == "current" else np.ones(6)
        clean = true_torque(q, qd, qdd, load) / scale
        noise = noise_a * np.random.default_rng(1000 + seed).normal(size=clean.shape)
        columns = {"t": t, "q": q, "qd": qd, "effort": clean + noise}
        columns |= {"q_f": q, "qd_f": qd, "qdd_f": qdd, "effort_f": clean + noise}
        condition = Conditions(
            f"trajectory{seed}", "trajectory", f"run{seed}", seed, payload=load or Payload()
        )
        parts.append(dataset(columns, [samples], [condition], kind))
    return Dataset.concatenate(parts)


def dwelling(
    poses: int,
    *,
    seed: int = 0,
    stiction_nm: float = 0.0,
    both: bool = False,
    load: Payload | None = None,
    noise_a: float = 0.002,
) -> Dataset:
    """Dwells of ten samples at random poses, stuck friction ± `stiction_nm` by approach."""
    random = np.random.default_rng(seed)
    where = random.uniform(-2.0, 2.0, (poses, 6))
    robot = plant().with_payload(load) if load else plant()
    held = robot.gravity(where) + OFFSET
    conditions, q, effort = [], [], []
    for pose in range(poses):
        for approach in (1, -1) if both else (1 if random.random() < 0.5 else -1,):
            current = (held[pose] + approach * stiction_nm) / GAINS
            q.append(np.repeat(where[pose][None], 10, axis=0))
            effort.append(current + noise_a * random.normal(size=(10, 6)))
            conditions.append(
                Conditions(
                    f"dwell{len(conditions)}", "dwell", "run", pose=pose, approach=approach,
                    payload=load or Payload(),
                )
            )  # fmt: skip
    rows = 10 * len(conditions)
    columns = {
        "t": np.arange(rows) * 0.008,
        "q": np.concatenate(q),
        "qd": np.zeros((rows, 6)),
        "effort": np.concatenate(effort),
    }
    return dataset(columns, [10] * len(conditions), conditions, "current")


K2 = np.array([0.0, -0.25, -0.3, 0.5, 0.0, 0.0])
"""Of eq. 16, torque = K2·i·|i| + gain·i, in drives that bend [N·m/A²]."""


def bent_currents(linear: FloatArray, k2: FloatArray) -> FloatArray:
    """Currents that make the torque of linear ones in a drive that bends, by bisection."""
    low, high = np.full_like(linear, -12.0), np.full_like(linear, 12.0)
    for _ in range(60):
        middle = (low + high) / 2
        short = k2 * middle * np.abs(middle) + GAINS * middle < linear * GAINS
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return low


def dataset(
    columns: dict[str, FloatArray],
    lengths: list[int],
    conditions: list[Conditions],
    kind: str = "current",
) -> Dataset:
    """A UR5 dataset with the tests' drive gains."""
    return Dataset(
        robot="ur5",
        joint_names=nominal().joint_names,
        effort_kind=kind,  # type: ignore[arg-type]
        columns=columns,
        offsets=np.concatenate(([0], np.cumsum(lengths))).astype(np.int64),
        conditions=tuple(conditions),
        drive_gains=GAINS if kind == "current" else None,
        drive_gains_source="the tests",
    )


def raw(data: Dataset) -> Dataset:
    """The dataset without its prepared columns."""
    kept = {name: values for name, values in data.columns.items() if not name.endswith("_f")}
    return replace(data, columns=kept)


def arriving(
    poses: int,
    *,
    seed: int = 0,
    dry_nm: FloatArray = COULOMB,
    slide_rad: float = 3e-4,
    length_rad: float = 2e-4,
    load_share: float = 0.0,
    per_k: float = 0.0,
    load: Payload | None = None,
    noise_a: float = 0.002,
) -> Dataset:
    """Dwells at random poses, from both sides, whose arrivals say how friction is stuck.

    Every joint comes 1 mrad in one direction and slides back by up to `slide_rad`. Dahl's friction
    of length `length_rad` is then side·(2·exp(−slide/length) − 1) of what it is in motion, which is
    `dry_nm`, more by `load_share` of the torque borne and by `per_k` of itself per kelvin.
    """
    random = np.random.default_rng(1000 + seed)
    stays = dwelling(poses, seed=seed, both=True, load=load, noise_a=noise_a)
    q = stays["q"][stays.offsets[:-1]]
    side = np.array([c.approach for c in stays.conditions], dtype=float)[:, None]
    slid = slide_rad * random.random(q.shape)
    warmer = np.linspace(-5.0, 5.0, len(q))[:, None] * np.ones(6)
    borne = (plant().with_payload(load) if load else plant()).gravity(q)
    level = (dry_nm + load_share * np.abs(borne)) * (1.0 + per_k * warmer)
    friction = level * side * (2.0 * np.exp(-slid / length_rad) - 1.0)
    columns = {
        **stays.columns,
        "effort": stays["effort"] + np.repeat(friction / GAINS, 10, axis=0),
        "temperature": np.repeat(35.0 + warmer, 10, axis=0),
    }
    return replace(stays, columns=columns, arrivals=arrivals_of(side, slid))


def arrivals_of(side: FloatArray, slid: FloatArray) -> FloatArray:
    """Paths (D, K, 2, n) that come from `side` (D, 1), and slide back by `slid` (D, n)."""
    way = (np.arange(ARRIVAL_POINTS) / 9.0)[None, :, None]
    coming = -1e-3 + (1e-3 + slid[:, None]) * (1.0 - (1.0 - np.minimum(way, 1.0)) ** 2)
    back = np.clip(way - 1.0, 0.0, 1.0) * slid[:, None]
    position = side[:, None] * (coming - back)
    return np.stack([position, np.gradient(position, ARRIVAL_STEP_S, axis=1)], axis=2)
