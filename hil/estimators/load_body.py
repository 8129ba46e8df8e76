"""A load as ten numbers that a fit moves, and as the rigid body it has to stay.

The ten parameters are those of `hil.dynamics.inertial` in the flange frame. They belong to a body
made of positive masses exactly when the 4 × 4 pseudo-inertia [[Σ, h], [hᵀ, m]] is positive
semi-definite, Σ = ½·tr(I)·1 − I (Wensing, Kim & Slotine, IEEE RA-L 2018).
"""

from __future__ import annotations

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray
from hil.dynamics import body_parameters, from_pseudo_inertia, pseudo_inertia, skew

LENGTH_M = 0.1
"""What a load's dimensions are counted in, so that its numbers are alike in size."""

THINNEST_KGM2 = 1e-7
"""Least second moment in every direction: a body is no point, and rounding must not make it less
than one."""

LIGHTEST_KG = 1e-4
"""Nothing has no centre of mass, so a fit does not get to nothing."""

SMALLEST_GAP = 1e-6
"""How near a sum of squares comes to its minimum, as a share of itself."""

MOST_NEWTON = 30

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
    return bool(np.linalg.eigvalsh(_above_floor(parameters))[0] >= 0.0)


def nearest_body(X: FloatArray, y: FloatArray) -> FloatArray:
    """(10,) parameters of the body that minimises ‖X·parameters − y‖², X (m, 10) of full rank.

    Newton's method with a barrier −μ·log det of what the pseudo-inertia is above its floor; the
    sum of squares is within 4μ of its minimum (Boyd & Vandenberghe, Convex Optimization, §11.2).
    """
    free = np.asarray(np.linalg.lstsq(X, y, rcond=None)[0])
    if is_body(free):
        return free
    gram, phi = X.T @ X, _inside(free)
    least = float(np.sum((X @ free - y) ** 2))
    excess = float((phi - free) @ gram @ (phi - free))
    mu = excess / 4
    while mu > SMALLEST_GAP * max(excess, least) / 4:
        for _ in range(MOST_NEWTON):
            step, decrement = _newton(phi, free, gram, mu)
            phi = phi + _longest(phi, step) * step
            if decrement < 1e-6 * mu:
                break
        mu *= 0.1
    return phi


def _newton(
    phi: FloatArray, free: FloatArray, gram: FloatArray, mu: float
) -> tuple[FloatArray, float]:
    """The step, and half its decrement squared, of (φ − free)ᵀ·gram·(φ − free) − μ·log det."""
    inverse = np.linalg.inv(_above_floor(phi))
    slopes = np.einsum("ij,kjl->kil", inverse, _UNITS)
    gradient = 2.0 * gram @ (phi - free) - mu * np.einsum("kii->k", slopes)
    hessian = 2.0 * gram + mu * np.einsum("kij,lji->kl", slopes, slopes)
    scale = 1.0 / np.sqrt(np.diag(hessian))
    # Parameters of a load differ by powers of ten.
    step = -scale * np.linalg.solve(hessian * np.outer(scale, scale), scale * gradient)
    return step, float(-gradient @ step) / 2.0


def _longest(phi: FloatArray, step: FloatArray) -> float:
    """Share of a step, 1 at most, that stays well inside."""
    L = np.linalg.cholesky(_above_floor(phi))
    change = np.linalg.solve(L, np.linalg.solve(L, np.tensordot(step, _UNITS, 1)).T)
    lowest = float(np.linalg.eigvalsh(change)[0])
    return 1.0 if lowest > -0.9 else -0.9 / lowest


def _inside(parameters: FloatArray) -> FloatArray:
    """(10,) a body near the parameters, well inside what can be."""
    values, vectors = np.linalg.eigh(_scaled(pseudo_inertia(parameters)))
    least = max(1e-2 * float(values[-1]), 1e-3)
    near = (vectors * np.maximum(values, least)) @ vectors.T
    return from_pseudo_inertia(near * np.outer(_LENGTHS, _LENGTHS))


def _above_floor(parameters: FloatArray) -> FloatArray:
    """(4, 4) what has to be positive definite, lengths in `LENGTH_M`."""
    above: FloatArray = np.tensordot(parameters, _UNITS, 1) - _SCALED_FLOOR
    return above


def _scaled(pseudo: FloatArray) -> FloatArray:
    scaled: FloatArray = pseudo / np.outer(_LENGTHS, _LENGTHS)
    return scaled


_UNITS = np.stack([_scaled(pseudo_inertia(unit)) for unit in np.eye(10)])
_SCALED_FLOOR = _scaled(_FLOOR)
