"""Inertial parameters as multiples of a reference body, and bounds that are linear in them."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray
from hil.dynamics import PARAMETERS, from_pseudo_inertia, pseudo_inertia
from hil.estimators.inertial_bounds import InertialBounds

BODY = len(PARAMETERS)
_ROWS, _COLUMNS = np.triu_indices(4)


def symmetric_basis() -> FloatArray:
    """(16, 10) from ten coordinates to the entries of a symmetric 4 × 4 matrix, orthonormal."""
    basis = np.zeros((4, 4, BODY))
    size = np.where(_ROWS == _COLUMNS, 1.0, np.sqrt(0.5))
    basis[_ROWS, _COLUMNS, np.arange(BODY)] = size
    basis[_COLUMNS, _ROWS, np.arange(BODY)] = size
    return basis.reshape(16, BODY)


class ReferenceCoordinates:
    """Coordinates s in which every link's reference body is the unit matrix.

    A link's pseudo-inertia is J = C S Cᵀ, C the Cholesky factor of its reference; s are the ten
    entries of S in an orthonormal basis. Rotor inertias follow behind all links, unscaled.

    Attributes:
        links: Number of links n.
        bodies: 10n, the coordinates of all bodies.
        size: 11n, rotors included.
        symmetric: (16, 10) from s of a link to its S.
        to_parameters: (11n, 11n) from coordinates to parameters.
        reference: (10n,) coordinates of the reference bodies.
        limits, room: (4n, 10n) and (4n,): the bounds are limits @ s ≤ room.
    """

    def __init__(self, bounds: InertialBounds) -> None:
        self.links = len(bounds.reference)
        self.bodies, self.size = BODY * self.links, (BODY + 1) * self.links
        self.symmetric = symmetric_basis()
        self.to_parameters = np.eye(self.size)
        self.reference = np.tile(self.symmetric.T @ np.eye(4).ravel(), self.links)
        self.limits = np.zeros((4 * self.links, self.bodies))
        self.room = np.zeros(4 * self.links)
        for i in range(self.links):
            own = slice(BODY * i, BODY * (i + 1))
            T = self._from_entries(bounds.reference[i])
            self.to_parameters[own, own] = T
            rows = _limit_rows(bounds.box[i]) @ T
            # Each bound counts in units of how far the reference keeps away from it.
            mass_max = float(bounds.mass_max[i])
            away = np.append(-rows[:3] @ self.reference[own], mass_max)
            rows[3] = T[0]
            self.limits[4 * i : 4 * i + 4, own] = rows / away[:, None]
            self.room[4 * i + 3] = 1.0

    def _from_entries(self, reference: FloatArray) -> FloatArray:
        """(10, 10) from s of a link to its parameters."""
        C = np.linalg.cholesky(pseudo_inertia(reference))
        units = self.symmetric.T.reshape(BODY, 4, 4)
        return from_pseudo_inertia(C @ units @ C.T).T

    def matrices(self, s: FloatArray) -> FloatArray:
        """(n, 4, 4) S of every link."""
        return (s.reshape(self.links, BODY) @ self.symmetric.T).reshape(self.links, 4, 4)

    def least_eigenvalue(self, s: FloatArray) -> float:
        """Smallest eigenvalue of any link's S."""
        return float(np.linalg.eigvalsh(self.matrices(s)).min())

    def strictly_inside(self, s: FloatArray, least: float) -> tuple[FloatArray, float]:
        """Coordinates (10n,) drawn to the reference until all bounds hold, and by which share.

        The reference is strictly inside and the bounds are convex, so a share below 1 is enough.
        """
        over = self.limits @ s - self.room
        spare = self.room - self.limits @ self.reference
        lack = least - self.least_eigenvalue(s)
        over, spare = np.append(over, lack), np.append(spare, 1.0 - least)
        broken = over > 0
        share = float(np.max(over[broken] / (over + spare)[broken], initial=0.0))
        return (1.0 - share) * s + share * self.reference, share


def _limit_rows(box: FloatArray) -> FloatArray:
    """(4, 10) rows that must be ≤ 0 for mass inside the box, and one more for the mass itself.

    Along each axis ∫(x − lo)(hi − x) dm ≥ 0, that is Σ − (lo + hi) h + lo hi m ≤ 0 with the second
    moment Σ and the first moment h.
    """
    rows = np.zeros((4, BODY))
    J = pseudo_inertia(np.eye(BODY))  # (10, 4, 4): what each parameter adds to J
    for axis in range(3):
        lo, hi = box[0, axis], box[1, axis]
        rows[axis] = J[:, axis, axis] - (lo + hi) * J[:, axis, 3] + lo * hi * J[:, 3, 3]
    return rows
