"""The links and rotors of an arm in free coordinates, and how far they are from nominal.

Coordinates are the log-Cholesky ones of every link (10 each) and the logarithm of every rotor
inertia over its start. The distance is the Bregman divergence of −log det per link and, a rotor
being a 1×1 pseudo-inertia, the same of every rotor. It is a sum of squares: with W = U₀⁻¹U,

    tr(J₀⁻¹J) − log det(J₀⁻¹J) − 4 = Σ_{i<j} Wᵢⱼ² + Σᵢ (Wᵢᵢ² − 1 − 2 log Wᵢᵢ),

so it joins a least-squares problem as further rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.dynamics import RobotModel
from hil.dynamics.inertial import body_parameters
from hil.dynamics.pseudo_inertia import (
    coordinate_jacobian,
    from_coordinates,
    nearest_consistent,
    to_coordinates,
    triangle,
    triangle_jacobian,
)
from hil.typing import FloatArray

LEAST_SHARE = 1e-6
"""A nominal link is thickened until its pseudo-inertia's eigenvalues reach this share."""

ROTOR_SHARE = 0.3
"""Start of a rotor nobody told: this share of what its joint accelerates on average."""

SMALL = 1e-4

_OFF_DIAGONAL = np.triu_indices(4, 1)


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """Links and rotors of an arm.

    Attributes:
        theta: (n, 10) log-Cholesky coordinates of the nominal links.
        rotor: (n,) nominal or guessed rotor inertias [kg·m²].
    """

    theta: FloatArray
    rotor: FloatArray

    @classmethod
    def nominal(cls, robot: RobotModel) -> Bodies:
        """Those of a robot model, mended where its links cannot exist."""
        links = robot.parameters(rotor=False).reshape(robot.n, -1)
        links = np.where(links[:, :1] > 0, links, _unknown_link())
        known = np.asarray(robot.rotor_inertia)
        rotor = np.where(known > 0, known, ROTOR_SHARE * _driven_inertia(robot))
        return cls(to_coordinates(nearest_consistent(links, LEAST_SHARE)), rotor)

    @property
    def start(self) -> FloatArray:
        """(11n,) coordinates of the nominal arm."""
        return np.concatenate([self.theta.ravel(), np.zeros(len(self.rotor))])

    def parameters(self, u: FloatArray) -> FloatArray:
        """(11n,) inertial parameters in the order of `RobotModel.parameters(rotor=True)`."""
        theta, log_rotor = self._split(u)
        return np.concatenate([from_coordinates(theta).ravel(), self.rotor * np.exp(log_rotor)])

    def jacobian(self, u: FloatArray) -> FloatArray:
        """(11n, 11n) ∂parameters/∂u."""
        theta, log_rotor = self._split(u)
        return _blocks(coordinate_jacobian(theta), self.rotor * np.exp(log_rotor))

    def divergence(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(11n,) r with |r|² the divergence from nominal, and (11n, 11n) ∂r/∂u."""
        theta, log_rotor = self._split(u)
        back = np.linalg.inv(triangle(self.theta))
        W, slope = back @ triangle(theta), back[:, None] @ triangle_jacobian(theta)
        upper, upper_slope = W[(..., *_OFF_DIAGONAL)], slope[(..., *_OFF_DIAGONAL)]
        x = np.log(np.diagonal(W, axis1=-2, axis2=-1))
        root, root_slope = _root(x)
        dx = np.diagonal(slope, axis1=-2, axis2=-1) * np.exp(-x)[:, None]
        links = np.concatenate([upper, root], axis=-1)
        links_slope = np.concatenate([upper_slope, dx * root_slope[:, None]], axis=-1)
        # A rotor is J = exp(log_rotor) of its start, so its W is exp(log_rotor / 2).
        rotor, rotor_slope = _root(0.5 * log_rotor)
        r = np.concatenate([links.ravel(), rotor])
        return r, _blocks(np.swapaxes(links_slope, -1, -2), 0.5 * rotor_slope)

    def _split(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        n = len(self.rotor)
        return u[: 10 * n].reshape(n, 10), u[10 * n : 11 * n]


def _root(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """±√(e²ˣ − 1 − 2x) with the sign of x, smooth through 0, and its derivative."""
    near = np.abs(x) < SMALL
    far = np.where(near, 1.0, x)
    root = np.sign(far) * np.sqrt(np.expm1(2.0 * far) - 2.0 * far)
    slope = np.expm1(2.0 * far) / root
    series = np.sqrt(2.0) * x * (1.0 + x / 3.0)
    return np.where(near, series, root), np.where(near, np.sqrt(2.0) * (1 + x / 1.5), slope)


def _blocks(links: FloatArray, rotors: FloatArray) -> FloatArray:
    """(11n, 11n) with a 10×10 block (n, 10, 10) per link, then the rotors' diagonal (n,)."""
    n = len(rotors)
    full = np.zeros((11 * n, 11 * n))
    for i, block in enumerate(links):
        full[10 * i : 10 * i + 10, 10 * i : 10 * i + 10] = block
    full[np.arange(10 * n, 11 * n), np.arange(10 * n, 11 * n)] = rotors
    return full


def _driven_inertia(robot: RobotModel) -> FloatArray:
    """(n,) what each joint accelerates, on average over the workspace [kg·m²]."""
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (50, robot.n))
    mean = np.mean(np.diagonal(robot.mass_matrix(q), axis1=1, axis2=2), axis=0)
    return np.asarray(np.maximum(mean, 1e-3))


def _unknown_link() -> FloatArray:
    """A link of which the model tells nothing: 1 kg, gyrated 0.1 m about its axis."""
    return body_parameters(1.0, (0.0, 0.0, 0.0), 0.01 * np.eye(3))
