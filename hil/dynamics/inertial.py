"""The ten inertial parameters of a rigid body, in Pinocchio's order, and how they change frame.

Order: m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz; mx = m·cx is the first moment, the inertia is
about the *origin* of the frame (not the centre of mass), so torques are linear in all ten.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hil.arms import Payload
from hil.core import FloatArray

PARAMETERS = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")


def body_parameters(mass: float, com: ArrayLike, inertia: ArrayLike) -> FloatArray:
    """(10,) parameters about the frame's origin.

    Args:
        mass: [kg].
        com: (3,) centre of mass in the frame [m].
        inertia: (3, 3) about the centre of mass, frame axes [kg·m²].
    """
    c = skew(np.asarray(com, dtype=np.float64))
    about_origin = np.asarray(inertia) - mass * c @ c
    return _pack(mass, mass * np.asarray(com, dtype=np.float64), about_origin)


def about_centre(body: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Inverse of `body_parameters`: mass, its centre (3,) and the inertia (3, 3) about that.

    Args:
        body: (10,) parameters about the frame's origin; with mass.
    """
    mass, h, inertia = _unpack(body)
    com = h / mass
    S = skew(com)
    return mass, com, inertia + mass * S @ S


def payload_parameters(payload: Payload) -> FloatArray:
    """(10,) parameters of a load about the origin of the flange frame."""
    return body_parameters(payload.mass, payload.com, payload_inertia(payload))


def payload_inertia(payload: Payload) -> FloatArray:
    """(3, 3) inertia about the load's centre of mass, flange axes [kg·m²]."""
    xx, yy, zz, xy, xz, yz = payload.inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=np.float64)


def transfer_matrix(pose: FloatArray) -> FloatArray:
    """(10, 10) X with φ_parent = X φ_child.

    Args:
        pose: (4, 4) of the child frame in the parent frame.
    """
    R, p = pose[:3, :3], pose[:3, 3]
    columns = []
    for unit in np.eye(10):
        m, h, inertia = _unpack(unit)
        h_turned, S = R @ h, skew(p)
        H = skew(h_turned)
        moved = R @ inertia @ R.T - S @ H - H @ S - m * S @ S
        columns.append(_pack(m, h_turned + m * p, moved))
    return np.stack(columns, axis=1)


def skew(v: FloatArray) -> FloatArray:
    """(3, 3) matrix of the cross product v ×."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _pack(m: float, h: FloatArray, inertia: FloatArray) -> FloatArray:
    rows, columns = [0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]
    return np.concatenate(([m], h, inertia[rows, columns]))


def _unpack(parameters: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    xx, xy, yy, xz, yz, zz = parameters[4:]
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return float(parameters[0]), parameters[1:4], inertia
