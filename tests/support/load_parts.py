"""Arms whose drive gains are not known exactly, their controllers' logs, and their loads."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.signal import lfilter

from hil.arms.payload import Payload
from hil.data.dataset import Dataset
from hil.estimators.payload import PayloadEstimate, estimate_payload
from hil.estimators.rigid_linear import RigidWls
from tests.support.synthetic_motion import COULOMB, GAINS, LOAD, VISCOUS, moving, nominal, raw

NOISE_A = 0.03
QUIET_A = 0.02
BELIEVED = 1.1 * GAINS
"""Gains by which a controller computes its currents."""

GAIN_SHARE = 0.03
SAMPLES = 600

OFF_AXIS = (
    Payload(1.0, (0.05, 0.01, 0.03), (6e-4, 9e-4, 6e-4, 0.0, 0.0, 0.0)),
    Payload(3.0, (-0.03, 0.055, 0.045), (4.5e-3, 3e-3, 3.6e-3, 0.0, 0.0, 0.0)),
    Payload(5.0, (0.06, -0.03, 0.06), (8e-3, 1e-2, 8e-3, 0.0, 0.0, 0.0)),
)
ON_AXIS = tuple(replace(load, com=(0.0, 0.0, load.com[2])) for load in OFF_AXIS)


def recorded(seed: int, *motions: int, load: Payload | None = None) -> Dataset:
    """Motions of the arm of a seed: its gains differ from those it declares, joint by joint."""
    random = np.random.default_rng(seed)
    share = 1.0 + GAIN_SHARE * random.uniform(-1.7, 1.7, 6)
    data = moving(*motions, load=load, samples=SAMPLES)
    noise = np.random.default_rng([seed, *motions]).normal(size=data["effort"].shape)
    effort = data["effort"] / share + NOISE_A * noise
    return data.with_columns(effort=effort, effort_f=effort)


@cache
def estimates(seed: int, loads: tuple[Payload, ...] = OFF_AXIS) -> tuple[PayloadEstimate, ...]:
    """The loads of the arm of a seed, by a model of it without any."""
    model = RigidWls().fit(recorded(seed, 1, 2, 3), nominal())
    return tuple(
        estimate_payload(
            model, recorded(seed, *range(5 + 3 * i, 8 + 3 * i), load=load), friction="model"
        )
        for i, load in enumerate(loads)
    )


def sweep(
    seed: int = 1,
    *,
    mounted: tuple[Payload, ...] = OFF_AXIS,
    declared: tuple[Payload, ...] | None = None,
    motions: int = 4,
) -> Dataset:
    """A run: the same motions bare and with every load, as measured."""
    numbers = tuple(range(1, motions + 1))
    parts = []
    told = (Payload(), *(declared or mounted))
    for load, (what, declaration) in enumerate(zip((None, *mounted), told, strict=True)):
        data = recorded(seed, *numbers, load=what)
        conditions = (
            replace(c, load=load, payload=declaration, id=f"{c.id} load {load}")
            for c in data.conditions
        )
        parts.append(replace(data, conditions=tuple(conditions)))
    return raw(Dataset.concatenate(parts))


def undeclared(data: Dataset) -> Dataset:
    """The same recording without any load in its conditions."""
    return replace(data, conditions=tuple(replace(c, payload=Payload()) for c in data.conditions))


def under_load(*seeds: int, load: Payload = LOAD, noise_a: float = QUIET_A) -> Dataset:
    """Recordings with the load mounted and not declared."""
    return undeclared(moving(*seeds, noise_a=noise_a, load=load))


def logged(*seeds: int, noise: float = 0.03, correlation: float = 0.95) -> Dataset:
    """A controller that computes torques, and adds a control error that lasts a while."""
    data = moving(*seeds, samples=1500)
    motion = [data[name] for name in ("q", "qd", "qdd_f")]
    torque = nominal().inverse_dynamics(*motion)
    random = np.random.default_rng(sum(seeds))
    size = noise * np.std(torque / BELIEVED, axis=0)
    white = size * np.sqrt(1 - correlation**2) * random.normal(size=torque.shape)
    error = lfilter([1.0], [1.0, -correlation], white, axis=0)
    own = (0.8 * COULOMB * np.tanh(data["qd"] / 0.01) + 0.9 * VISCOUS * data["qd"]) / GAINS
    current = torque / BELIEVED + own + error
    declared = replace(data, drive_gains=np.full(6, 12.0))
    return declared.with_columns(torque_target=torque, effort_target=current)
