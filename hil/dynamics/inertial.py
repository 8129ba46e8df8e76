"""The ten inertial parameters of a rigid body in the order of Pinocchio, and their transformations.

The order of the inertial parameters is m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz. The parameter
mx = m·cx is the first moment of the body along x. The inertia refers to the *origin* of the frame
and not to the centre of mass; torques are therefore linear in all ten parameters.

Ten parameters φ are physically consistent if their pseudo-inertia

    J = [[Σ, h], [hᵀ, m]],  Σ = ½ tr(I)·1 − I,

which contains the second moments of the mass density about the origin of the frame, is positive
definite (Wensing, Kim & Slotine, RA-L 2018). J = U Uᵀ with an upper triangular matrix U, whose
diagonal is written as exponentials, has ten free coordinates θ: the log-Cholesky coordinates of
Rucker & Wensing (RA-L 2022):

    U = e^α [[e^d1, s12, s13, t1], [0, e^d2, s23, t2], [0, 0, e^d3, t3], [0, 0, 0, 1]].

In the matrix U, the mass is e^2α and t is the centre of mass. All functions of parameter arrays (…,
10) accept any number of bodies.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hil.arms import Payload
from hil.core import BoolArray, FitError, FloatArray

PARAMETERS = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")


def body_parameters(mass: float, com: ArrayLike, inertia: ArrayLike) -> FloatArray:
    """Return the parameters (10,) of a body about the origin of the frame.

    Args:
        mass: Mass [kg].
        com: (3,) centre of mass in the frame [m].
        inertia: (3, 3) inertia about the centre of mass, along the axes of the frame [kg·m²].
    """
    c = skew(np.asarray(com, dtype=np.float64))
    about_origin = np.asarray(inertia) - mass * c @ c
    return _pack(mass, mass * np.asarray(com, dtype=np.float64), about_origin)


def _pack(m: float, h: FloatArray, inertia: FloatArray) -> FloatArray:
    rows, columns = [0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]
    return np.concatenate(([m], h, inertia[rows, columns]))


def about_centre(body: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return mass, centre of mass (3,), and inertia (3, 3) about the centre of mass of a body.

    Args:
        body: (10,) parameters about the origin of the frame; the mass of the body must not be zero.
    """
    mass, h, inertia = _unpack(body)
    com = h / mass
    S = skew(com)
    return mass, com, inertia + mass * S @ S


def _unpack(parameters: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    xx, xy, yy, xz, yz, zz = parameters[4:]
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return float(parameters[0]), parameters[1:4], inertia


def payload_parameters(payload: Payload) -> FloatArray:
    """Return the parameters (10,) of a payload about the origin of the flange frame."""
    return body_parameters(payload.mass, payload.com, payload_inertia(payload))


def payload_inertia(payload: Payload) -> FloatArray:
    """Return the inertia (3, 3) of a payload about its centre of mass, in flange axes [kg·m²]."""
    xx, yy, zz, xy, xz, yz = payload.inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=np.float64)


def transfer_matrix(pose: FloatArray) -> FloatArray:
    """Return the matrix X (10, 10) that transforms parameters: φ_parent = X φ_child.

    Args:
        pose: (4, 4) pose of the child frame in the parent frame.
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
    """Return the matrix (3, 3) of the cross product v × with a vector v."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def pseudo_inertia(parameters: FloatArray) -> FloatArray:
    """Return the pseudo-inertias J (…, 4, 4) of parameters (…, 10)."""
    m, mx, my, mz, xx, xy, yy, xz, yz, zz = np.moveaxis(np.asarray(parameters, float), -1, 0)
    half = 0.5 * (xx + yy + zz)
    rows = [
        [half - xx, -xy, -xz, mx],
        [-xy, half - yy, -yz, my],
        [-xz, -yz, half - zz, mz],
        [mx, my, mz, m],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def from_pseudo_inertia(J: FloatArray) -> FloatArray:
    """Return the parameters (…, 10) of symmetric pseudo-inertias J (…, 4, 4); linear in J."""
    x, y, z = J[..., 0, 0], J[..., 1, 1], J[..., 2, 2]
    entries = (
        J[..., 3, 3], J[..., 0, 3], J[..., 1, 3], J[..., 2, 3],
        y + z, -J[..., 0, 1], x + z, -J[..., 0, 2], -J[..., 1, 2], x + y,
    )  # fmt: skip
    return np.stack(entries, axis=-1)


def least_eigenvalue(parameters: FloatArray) -> FloatArray:
    """Return the smallest eigenvalue (…) of the pseudo-inertia; positive for a consistent body.

    The eigenvalue of the pseudo-inertia has mixed units.
    """
    return np.asarray(np.linalg.eigvalsh(pseudo_inertia(parameters))[..., 0])


def is_consistent(parameters: FloatArray) -> BoolArray:
    """Return whether the pseudo-inertia J of each body is positive definite (…).

    A positive definite J implies a positive mass, positive principal moments, and the triangle
    inequality of these moments.
    """
    return np.asarray(least_eigenvalue(parameters) > 0.0)


def nearest_consistent(parameters: FloatArray, share: float = 1e-6) -> FloatArray:
    """Return the parameters (…, 10) whose pseudo-inertia J is the nearest consistent one.

    All eigenvalues of the returned J are at least `share` times its largest eigenvalue. Bodies
    whose J already satisfies this condition are returned unchanged. The distance between
    pseudo-inertias J is measured in the Frobenius norm. For a body without mass, the minimum
    eigenvalue is the share of 1 kg and 1 kg·m².

    Args:
        parameters: (…, 10) parameters.
        share: Minimum permitted ratio of the smallest to the largest eigenvalue of J, above 0.
    """
    J = pseudo_inertia(parameters)
    values, vectors = np.linalg.eigh(J)
    largest = np.maximum(values[..., -1:], 0.0)
    floor = share * np.where(largest > 0.0, largest, 1.0)
    raised = np.maximum(values, floor)
    mended = (vectors * raised[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    fine = np.all(values >= floor, axis=-1)[..., None]
    return np.where(fine, parameters, from_pseudo_inertia(mended))


_DIAGONAL = (0, 1, 2)

_UPPER = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
"""Indices in U of s12, s23, s13, t1, t2, t3."""


def to_coordinates(parameters: FloatArray) -> FloatArray:
    """Return the log-Cholesky coordinates θ (…, 10) of physically consistent parameters.

    The order of the coordinates θ is α, d1, d2, d3, s12, s23, s13, and the centre of mass t1, t2,
    t3 [m].

    Raises:
        FitError: A pseudo-inertia is not positive definite, so its body has no log-Cholesky
            coordinates.
    """
    J = pseudo_inertia(parameters)
    if not np.all(np.isfinite(J)) or not np.all(is_consistent(parameters)):
        raise FitError(
            "inertial parameters that are not physically consistent have no log-Cholesky "
            "coordinates",
            hint="replace them with nearest_consistent(parameters) first",
        )
    # J = U Uᵀ with upper U is the Cholesky factorisation of J with reversed rows and columns.
    U = np.linalg.cholesky(J[..., ::-1, ::-1])[..., ::-1, ::-1]
    scale = U[..., 3, 3]
    unit = U / scale[..., None, None]
    diagonal = [np.log(unit[..., i, i]) for i in _DIAGONAL]
    upper = [unit[..., row, column] for row, column in _UPPER]
    return np.stack([np.log(scale), *diagonal, *upper], axis=-1)


def triangle(theta: FloatArray) -> FloatArray:
    """Return the upper triangular matrices U (…, 4, 4) of coordinates θ (…, 10), with J = U Uᵀ."""
    theta = np.asarray(theta, dtype=np.float64)
    U = np.zeros((*theta.shape[:-1], 4, 4))
    for i in _DIAGONAL:
        U[..., i, i] = np.exp(theta[..., 1 + i])
    for k, (row, column) in enumerate(_UPPER):
        U[..., row, column] = theta[..., 4 + k]
    U[..., 3, 3] = 1.0
    return U * np.exp(theta[..., :1, None])


def from_coordinates(theta: FloatArray) -> FloatArray:
    """Return the inertial parameters φ(θ) (…, 10), which are always physically consistent."""
    U = triangle(theta)
    return from_pseudo_inertia(U @ np.swapaxes(U, -1, -2))


def triangle_jacobian(theta: FloatArray) -> FloatArray:
    """Return the derivatives ∂U/∂θₖ (…, 10, 4, 4)."""
    theta = np.asarray(theta, dtype=np.float64)
    scale = np.exp(theta[..., 0])
    slope = np.zeros((*theta.shape, 4, 4))
    slope[..., 0, :, :] = triangle(theta)
    for i in _DIAGONAL:
        slope[..., 1 + i, i, i] = scale * np.exp(theta[..., 1 + i])
    for k, (row, column) in enumerate(_UPPER):
        slope[..., 4 + k, row, column] = scale
    return slope


def coordinate_jacobian(theta: FloatArray) -> FloatArray:
    """Return the derivatives ∂φ/∂θ (…, 10, 10), computed exactly from dJ = dU Uᵀ + U dUᵀ."""
    half = triangle_jacobian(theta) @ np.swapaxes(triangle(theta), -1, -2)[..., None, :, :]
    slope = from_pseudo_inertia(half + np.swapaxes(half, -1, -2))
    return np.swapaxes(slope, -1, -2)


def divergence(parameters: FloatArray, prior: FloatArray) -> FloatArray:
    """Return the Bregman divergence (…) of −log det from a prior: tr(J₀⁻¹J) − log det(J₀⁻¹J) − 4.

    The divergence is zero only at the prior, and infinite at the limit of physical consistency. The
    divergence is independent of the frame and of the units (Lee, Wensing & Park, T-RO 2020,
    entropic distance).
    """
    ratio = np.linalg.solve(pseudo_inertia(prior), pseudo_inertia(parameters))
    sign, log_det = np.linalg.slogdet(ratio)
    found = np.trace(ratio, axis1=-2, axis2=-1) - log_det - 4.0
    return np.where((sign > 0) & is_consistent(parameters), found, np.inf)
