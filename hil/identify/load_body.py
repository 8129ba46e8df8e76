"""A load as ten numbers that a fit moves, and as the rigid body it has to stay.

The ten parameters are those of `hil.dynamics.inertial` in the flange frame. They belong to a body
made of positive masses exactly when the 4 × 4 pseudo-inertia [[Σ, h], [hᵀ, m]] is positive
semi-definite, Σ = ½·tr(I)·1 − I (Wensing, Kim & Slotine, IEEE RA-L 2018).
"""

from __future__ import annotations

import numpy as np

from hil.dynamics.inertial import body_parameters, skew
from hil.dynamics.pseudo_inertia import from_pseudo_inertia, pseudo_inertia
from hil.payload import Payload
from hil.typing import FloatArray

LENGTH_M = 0.1
"""What a load's dimensions are counted in, so that its numbers are alike in size."""

THINNEST_KGM2 = 1e-7
"""Least second moment in every direction: a body is no point, and rounding must not make it less
than one."""

LIGHTEST_KG = 1e-4
"""Nothing has no centre of mass, so a fit does not get to nothing."""

_LENGTHS = np.array([LENGTH_M, LENGTH_M, LENGTH_M, 1.0])
_FLOOR = np.diag([THINNEST_KGM2, THINNEST_KGM2, THINNEST_KGM2, LIGHTEST_KG])


def payload_of(parameters: FloatArray) -> Payload:
    """The load with these parameters; its mass must be above 0."""
    m, c, I = central(parameters)  # noqa: E741
    x, y, z = (float(value) for value in c)
    xx, yy, zz, xy, xz, yz = (float(value) for value in I)
    return Payload(float(m), (x, y, z), (xx, yy, zz, xy, xz, yz))


def central(parameters: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Mass, centre of mass (3,) and Ixx Iyy Izz Ixy Ixz Iyz (6,) about it."""
    m = float(parameters[0])
    c = parameters[1:4] / m
    xx, xy, yy, xz, yz, zz = parameters[4:]
    S = skew(c)
    about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) + m * S @ S
    rows, columns = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    return m, c, about[rows, columns]


def central_jacobian(parameters: FloatArray) -> FloatArray:
    """(10, 10) how m, cx, cy, cz, Ixx Iyy Izz Ixy Ixz Iyz (central) follow the parameters."""
    m, c = float(parameters[0]), parameters[1:4] / float(parameters[0])
    out = np.zeros((10, 10))
    out[0, 0] = 1.0
    out[1:4, 0], out[1:4, 1:4] = -c / m, np.eye(3) / m
    # I_c = I_o − (h·h/m)·1 + h·hᵀ/m, with I_o about the flange's origin.
    along = sum(_gradient(c, k, k) for k in range(3))
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    for row, ((i, j), source) in enumerate(zip(pairs, (4, 6, 9, 5, 7, 8), strict=True), start=4):
        out[row, source] = 1.0
        out[row] += _gradient(c, i, j) - (along if i == j else 0.0)
    return out


def _gradient(c: FloatArray, i: int, j: int) -> FloatArray:
    """(10,) of hᵢ·hⱼ/m."""
    row = np.zeros(10)
    row[1 + i] += c[j]
    row[1 + j] += c[i]
    row[0] = -c[i] * c[j]
    return row


def point_masses(mass: float, reach: float) -> FloatArray:
    """(10, 10) rows of parameters of ten point masses that together span all loads.

    Added to a body they leave it one, which a step along a single parameter need not.
    """
    e = reach * np.eye(3)
    places = [np.zeros(3), *e, *-e, e[0] + e[1], e[0] + e[2], e[1] + e[2]]
    return np.array([body_parameters(mass, place, np.zeros((3, 3))) for place in places])


def is_body(parameters: FloatArray) -> bool:
    """Whether positive masses could have these parameters."""
    return bool(np.linalg.eigvalsh(_scaled(pseudo_inertia(parameters) - _FLOOR))[0] >= 0.0)


def nearest_body(X: FloatArray, y: FloatArray) -> FloatArray:
    """(10,) parameters of the body that minimises ‖X·parameters − y‖², X (m, 10).

    The pseudo-inertia is floor + L·Lᵀ. With L (4, 4) this has no other minimum than the convex
    problem in the pseudo-inertia (Burer & Monteiro, Math. Program. 2005).
    """
    from scipy.optimize import least_squares

    free = np.asarray(np.linalg.lstsq(X, y, rcond=None)[0])
    if is_body(free):
        return free
    rows, columns = np.tril_indices(4)
    map_ = np.array([_parameters_of_pair(i, j) for i in range(4) for j in range(4)]).T
    offset = from_pseudo_inertia(_FLOOR)
    A, b = X @ map_, y - X @ offset

    def unpacked(entries: FloatArray) -> FloatArray:
        L = np.zeros((4, 4))
        L[rows, columns] = entries
        return L

    def residual(entries: FloatArray) -> FloatArray:
        L = unpacked(entries)
        error: FloatArray = A @ (L @ L.T).ravel() - b
        return error

    def jacobian(entries: FloatArray) -> FloatArray:
        L = unpacked(entries)
        G = A.reshape(-1, 4, 4)
        full = np.einsum("kij,jl->kil", G + G.transpose(0, 2, 1), L)
        picked: FloatArray = full[:, rows, columns]
        return picked

    start = _interior(free)
    solved = least_squares(
        residual, start[rows, columns], jacobian, method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-14
    )
    L = unpacked(solved.x)
    return map_ @ (L @ L.T).ravel() + offset


def _parameters_of_pair(i: int, j: int) -> FloatArray:
    """Parameters of half the symmetric unit matrix at (i, j), lengths in `LENGTH_M`."""
    unit = np.zeros((4, 4))
    unit[i, j] += 0.5
    unit[j, i] += 0.5
    return from_pseudo_inertia(unit * np.outer(_LENGTHS, _LENGTHS))


def _interior(parameters: FloatArray) -> FloatArray:
    """(4, 4) Cholesky factor of a body near the parameters, well inside."""
    values, vectors = np.linalg.eigh(_scaled(pseudo_inertia(parameters)))
    least = max(1e-2 * float(values[-1]), 1e-3)
    near = (vectors * np.maximum(values, least)) @ vectors.T
    return np.asarray(np.linalg.cholesky(near))


def _scaled(pseudo: FloatArray) -> FloatArray:
    scaled: FloatArray = pseudo / np.outer(_LENGTHS, _LENGTHS)
    return scaled
