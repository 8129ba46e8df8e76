"""The links and rotors of an arm in free coordinates, and how far they are from nominal.

Coordinates are the log-Cholesky ones of every link (10 each) and the logarithm of every rotor
inertia over its start. The distance is the Bregman divergence of −log det per link,
tr(J₀⁻¹J) − log det(J₀⁻¹J) − 4, and, a rotor being a 1×1 pseudo-inertia, the same of every rotor.
It is convex in the inertial parameters. Its curvature there, tr(J⁻¹dJ J⁻¹dJ), carried over to the
coordinates is positive semidefinite; what it leaves out is the total gradient by the parameters
times how the coordinates bend, and that gradient vanishes at the minimum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray
from hil.dynamics import (
    RobotModel,
    body_parameters,
    coordinate_jacobian,
    from_coordinates,
    nearest_consistent,
    to_coordinates,
    triangle,
    triangle_jacobian,
)
from hil.estimators.diffnea.minimise import Local

LEAST_SHARE = 1e-6
"""A nominal link is thickened until its pseudo-inertia's eigenvalues reach this share."""

ROTOR_SHARE = 0.3
"""Start of a rotor nobody told: this share of what its joint accelerates on average."""

LIGHT = 0.1
"""Share of the arm's mass below which a link counts as that heavy when its mass is bounded."""

MASS_FACTOR = 5.0
"""A link weighs at most this many times what the model says, or times a tenth of the arm where the
link is lighter than that: tools are mounted on small flanges and not always declared."""


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """Links and rotors of an arm.

    Attributes:
        theta: (n, 10) log-Cholesky coordinates of the nominal links.
        rotor: (n,) nominal or guessed rotor inertias [kg·m²].
        mass_factor: Above 1; bounds masses, because α = α₀ + h·tanh((u − α₀)/h) with h half the
            logarithm of how much heavier than nominal a link may be.
    """

    theta: FloatArray
    rotor: FloatArray
    mass_factor: float = MASS_FACTOR

    @classmethod
    def nominal(cls, robot: RobotModel, mass_factor: float = MASS_FACTOR) -> Bodies:
        """Those of a robot model, mended where its links cannot exist."""
        links = robot.parameters(rotor=False).reshape(robot.n, -1)
        links = np.where(links[:, :1] > 0, links, _unknown_link())
        known = np.asarray(robot.rotor_inertia)
        rotor = np.where(known > 0, known, ROTOR_SHARE * _driven_inertia(robot))
        return cls(to_coordinates(nearest_consistent(links, LEAST_SHARE)), rotor, mass_factor)

    @property
    def start(self) -> FloatArray:
        """(11n,) coordinates of the nominal arm."""
        return np.concatenate([self.theta.ravel(), np.zeros(len(self.rotor))])

    def parameters(self, u: FloatArray) -> FloatArray:
        """(11n,) inertial parameters in the order of `RobotModel.parameters(rotor=True)`."""
        theta, log_rotor, _ = self._split(u)
        return np.concatenate([from_coordinates(theta).ravel(), self.rotor * np.exp(log_rotor)])

    def jacobian(self, u: FloatArray) -> FloatArray:
        """(11n, 11n) ∂parameters/∂u."""
        theta, log_rotor, bent = self._split(u)
        return _blocks(coordinate_jacobian(theta) * bent[:, None], self.rotor * np.exp(log_rotor))

    def divergence(self, u: FloatArray) -> Local:
        """Divergence from nominal, by the coordinates (11n,)."""
        theta, log_rotor, bent = self._split(u)
        U, slope = triangle(theta), triangle_jacobian(theta) * bent[..., None, None]
        links, links_gradient = self._links(U, slope)
        inner = np.linalg.inv(U)[:, None] @ slope
        rows = (inner + np.swapaxes(inner, -1, -2)).reshape(len(U), 10, 16)
        ratio = np.exp(log_rotor)
        return Local(
            links + float(np.sum(ratio - log_rotor - 1.0)),
            np.concatenate([links_gradient.ravel(), ratio - 1.0]),
            _blocks(rows @ np.swapaxes(rows, -1, -2), np.ones(len(ratio))),
        )

    def _links(self, U: FloatArray, slope: FloatArray) -> tuple[float, FloatArray]:
        """Sum of the links' divergences, |W|² − 2 Σ log Wᵢᵢ − 4 with W = U₀⁻¹U, and gradient."""
        back = np.linalg.inv(triangle(self.theta))
        W, dW = back @ U, back[:, None] @ slope
        diagonal = np.diagonal(W, axis1=-2, axis2=-1)
        value = np.sum(W**2) - 2.0 * np.sum(np.log(diagonal)) - 4.0 * len(W)
        bent = np.diagonal(dW, axis1=-2, axis2=-1) / diagonal[:, None]
        gradient = 2.0 * np.einsum("lij,lkij->lk", W, dW) - 2.0 * np.sum(bent, axis=-1)
        return float(value), gradient

    def _split(self, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """θ (n, 10), the rotors' logarithms (n,) and ∂θ/∂u (n, 10), which is diagonal."""
        n, middle = len(self.rotor), self.theta[:, 0]
        mass = np.exp(2.0 * middle)
        half = 0.5 * np.log(self.mass_factor * np.maximum(1.0, LIGHT * mass.sum() / mass))
        theta = u[: 10 * n].reshape(n, 10).copy()
        share = np.tanh((theta[:, 0] - middle) / half)
        bent = np.ones_like(theta)
        theta[:, 0], bent[:, 0] = middle + half * share, 1.0 - share**2
        return theta, u[10 * n : 11 * n], bent


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
