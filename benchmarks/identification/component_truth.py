"""How well a model knows the parts of a torque, by the mock robot's own physics.

A total torque hides errors that cancel: what friction lacks, a network's gravity can hold. The mock
knows M(q) and gravity from MuJoCo, and friction from its true currents. A constant moves freely
between gravity and the offset of friction, and no total tells them apart: the mean over the judged
rows is removed from both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.identification.mock_gap import mass_matrices
from benchmarks.identification.mock_truth import true_gains
from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.core.typing import FloatArray
from hil.data.dataset import Dataset
from hil.estimators.base import RobotEstimator
from hil_mock_robot.plant.model import Plant, build_plant
from hil_mock_robot.plant.truth import Truth

EVERY = 8
"""Of the judged rows, recorded at 1 kHz: 125 per second are compared."""

POSES = 200
"""Judged poses at which mass matrices are compared."""

GRAVITY = (0.0, 0.0, -9.81)
RIGID = ("inertia", "coriolis", "gravity", "payload", "residual")
"""Components that are not friction; a correction of the whole torque is none either."""


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """What a joint's torque is made of at the judged rows.

    Attributes:
        q: (P, n) poses of the mass matrices [rad].
        mass: (P, n, n) with rotors [kg·m²].
        gravity: (N, n) [N·m].
        friction: (N, n) true current times true gain, less the torque of the rigid body [N·m]:
            friction, ripple, and what the drives do not do in proportion to their currents.
        gains: (n,) K1 [N·m/A].
    """

    q: FloatArray
    mass: FloatArray
    gravity: FloatArray
    friction: FloatArray
    gains: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Of one model.

    Attributes:
        mass: Over the poses, mean of |M − M̂|/|M| in Frobenius norms.
        gravity, friction: (n,) RMSE without the mean [N·m].
    """

    mass: float
    gravity: FloatArray
    friction: FloatArray


def true_parts(truth: Truth, test: Dataset, current: FloatArray) -> Parts:
    """Return the true components along the evaluated motions.

    Args:
        truth: The robot.
        test: Judged trajectories, filtered.
        current: (N, n) true current through the same filter [A].
    """
    plant = _plant(truth)
    q, qd, qdd = (test[name][::EVERY] for name in ("q_f", "qd_f", "qdd_f"))
    still = np.zeros_like(q[0])
    gravity = np.array([plant.inverse(one, still, still) for one in q])
    rigid = np.array([plant.inverse(*sample) for sample in zip(q, qd, qdd, strict=True)])
    poses = q[np.linspace(0, len(q) - 1, POSES).astype(np.int64)]
    mass = np.array([plant.mass_matrix(one) for one in poses])
    gains = true_gains(truth)
    return Parts(poses, mass, gravity, current[::EVERY] * gains - rigid, gains)


def component_errors(model: RobotEstimator, test: Dataset, true: Parts) -> Errors | None:
    """Of a fitted model; None if it does not tell its parts apart.

    A model learns currents times the gains it was told; what it found is compared as currents
    times the true ones.
    """
    parts = model.predict(test).components
    M = learned_mass(model, true.q)
    if M is None or not {"gravity", "friction"} <= parts.keys():
        return None
    rows_by = true.gains / model.torque_scale_
    off = M * rows_by[:, None] - true.mass
    sizes = [np.linalg.norm(values, axis=(1, 2)) for values in (off, true.mass)]
    friction = np.sum([part for name, part in parts.items() if name not in RIGID], axis=0)
    return Errors(
        float(np.mean(sizes[0] / sizes[1])),
        _scatter(parts["gravity"][::EVERY] * true.gains - true.gravity),
        _scatter(friction[::EVERY] * true.gains - true.friction),
    )


def learned_mass(model: RobotEstimator, q: FloatArray) -> FloatArray | None:
    """(P, n, n) of a network, or of links that can exist; None of anything else."""
    if hasattr(model, "mass_matrix"):
        return np.asarray(model.mass_matrix(q))
    inertial = getattr(getattr(model, "base_", model), "inertial_", None)
    return None if inertial is None else mass_matrices(np.asarray(inertial), model.robot_, q)


def _plant(truth: Truth) -> Plant:
    rotors = [joint.drive.rotor_kgm2 for joint in truth.joints]
    return build_plant(load_arm(truth.arm).dh, truth.links, rotors, Payload(), GRAVITY, 1e-3)


def _scatter(error: FloatArray) -> FloatArray:
    """(n,) RMS of (N, n) about its mean."""
    return np.asarray(np.std(error, axis=0))
