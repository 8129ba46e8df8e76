"""A UR5 whose friction remembers and grows with load, simulated sample by sample."""

from __future__ import annotations

import numpy as np

from hil.arms.payload import Payload
from hil.core.typing import FloatArray
from hil.data import Conditions, Dataset
from tests.support.synthetic_motion import COULOMB, GAINS, OFFSET, VISCOUS, dataset, fourier, plant

SHORT, LONG = 1e-3, 3e-2
"""Lengths of the two friction states [rad]."""

EFFICIENCY = 0.15
"""Dry friction per torque through the gear: twice a UR's, so that little motion shows it."""


def dahl_loop(q: FloatArray, length: FloatArray | float) -> FloatArray:
    """Dahl's equation along a path q (N, n), exactly for every straight piece, one by one."""
    states, z = np.zeros_like(q), np.zeros(q.shape[1])
    lengths = np.broadcast_to(length, z.shape)
    for k in range(1, len(q)):
        way = q[k] - q[k - 1]
        for j, step in enumerate(way):
            kept = np.exp(-abs(step) / lengths[j])
            z[j] = z[j] * kept + np.sign(step) * (1.0 - kept)
        states[k] = z
    return states


def stopping(seed: int, samples: int = 800, rate_hz: float = 100.0) -> tuple[FloatArray, ...]:
    """Fourier motion that halts for 1 s every 4 s: t (N,), q, qd, qdd (N, 6)."""
    t = np.arange(samples) / rate_hz
    turn, u = np.divmod(t, 4.0)
    u = np.minimum(u, 3.0)
    w = np.pi / 3.0
    s = 1.5 * turn + 0.5 * u - np.sin(2 * w * u) / (4 * w)
    ds = np.where(u < 3.0, np.sin(w * u) ** 2, 0.0)[:, None]
    dds = np.where(u < 3.0, w * np.sin(2 * w * u), 0.0)[:, None]
    grid, q, qd, qdd = fourier(seed, samples, rate_hz)

    def at(values: FloatArray) -> FloatArray:
        return np.stack([np.interp(s, grid, column) for column in values.T], axis=1)

    return t, at(q), at(qd) * ds, at(qdd) * ds**2 + at(qd) * dds


def torque_of(
    q: FloatArray, qd: FloatArray, qdd: FloatArray, load: Payload, warmth: FloatArray
) -> FloatArray:
    """Rigid body, then Coulomb friction with memory, load and temperature [N·m]."""
    rigid = plant().with_payload(load).inverse_dynamics(q, qd, qdd)
    z, z_long = dahl_loop(q, SHORT), dahl_loop(q, LONG)
    dry = z * (COULOMB + EFFICIENCY * np.abs(rigid)) * (1.0 - 0.01 * warmth)
    return rigid + dry + 0.5 * COULOMB * z_long + VISCOUS * qd + OFFSET


def remembering(
    *seeds: int,
    noise_a: float = 0.02,
    load: Payload | None = None,
    celsius: tuple[float, float] | None = None,
    samples: int = 800,
) -> Dataset:
    """One trajectory per seed, as recorded; temperature goes from one to the other over each."""
    columns: dict[str, list[FloatArray]] = {}
    conditions = []
    for seed in seeds:
        t, q, qd, qdd = stopping(seed, samples)
        path = np.linspace(*(celsius or (30.0, 30.0)), samples)[:, None] * np.ones(6)
        clean = torque_of(q, qd, qdd, load or Payload(), path - 30.0) / GAINS
        noise = noise_a * np.random.default_rng(2000 + seed).normal(size=clean.shape)
        made = {"t": t, "q": q, "qd": qd, "effort": clean + noise}
        if celsius is not None:
            made["temperature"] = path
        for name, values in made.items():
            columns.setdefault(name, []).append(values)
        conditions.append(
            Conditions(f"t{seed}", "trajectory", f"run{seed}", seed, payload=load or Payload())
        )
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    return dataset(joined, [samples] * len(seeds), conditions)
