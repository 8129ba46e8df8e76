"""Recordings of probes whose arm is known exactly."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hil.arms.payload import Payload
from hil.importers import import_recording
from tests.support.imported_motions import layout
from tests.support.synthetic_motion import GAINS, fourier, true_torque

SAMPLES, NOISE_A = 3000, 0.02
COULOMB_J2_NM = 7.0


def probe(
    folder: Path, seed: int, *, noise: int, more_friction: float = 0.0, load: Payload | None = None
) -> Path:
    """30 s along one Fourier motion; J2 with a share of more dry friction, or a load nobody told.

    Args:
        folder: Where the recording goes.
        seed: Of the motion.
        noise: Seed of the noise.
        more_friction: Share.
        load: Mounted.
    """
    t, q, qd, qdd = fourier(seed, SAMPLES)
    torque = true_torque(q, qd, qdd, load)
    torque[:, 1] += more_friction * COULOMB_J2_NM * np.tanh(qd[:, 1] / 0.01)
    current = torque / GAINS + NOISE_A * np.random.default_rng(noise).normal(size=q.shape)
    path = folder / f"{seed}-{noise}-{more_friction}-{load is not None}.csv"
    np.savetxt(path, np.column_stack([t, q, qd, current]), delimiter=",", fmt="%.12g")
    out = path.with_suffix(".mcap")
    import_recording(path, map_file=layout(), out=out)
    return out
