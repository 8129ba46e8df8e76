"""What joint torques at rest say about the load at the flange, and how surely.

At rest a load's torques are linear in (m, m·cx, m·cy, m·cz), flange frame. Two things spoil them:
what is left of friction, independent from pose to pose, and drive gains that are only roughly
known, which err by the same share at every pose. Generalised least squares takes both into
account: a joint that errs by its gain is trusted for its small torques, not for its large ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray
from hil.dynamics.robot_model import RobotModel

GAIN_SHARE = 0.05
"""Standard deviation of a drive gain from its nominal value; motor constants of one type of drive
are toleranced by a few percent."""

CALIBRATED_SHARE = 0.01
"""That of one which was measured on the arm itself."""

UNDETERMINED = 1e-6
"""Directions of the first moment with less than this share of the best one's information do not
show at these poses."""


def static_columns(model: RobotModel, q: FloatArray) -> FloatArray:
    """(P, n, 4) torques at rest at `q` (P, n) per kg and per kg·m of a load's first moment."""
    still = np.zeros(np.shape(q))
    columns: FloatArray = model.payload_regressor(q, still, still)[:, :4]
    return columns.reshape(len(q), model.n, 4)


def static_parameters(load: Payload) -> FloatArray:
    """(4,) mass [kg] and first moment [kg·m] of a load in the flange frame."""
    return load.mass * np.array([1.0, *load.com])


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """By how much a load differs from what was expected.

    Attributes:
        mass: More mass than expected, if its centre is where it was said to be [kg].
        mass_deviation: Standard deviation of that [kg].
        free_mass: More mass than expected, wherever its centre is [kg].
        free_mass_deviation: Standard deviation of that [kg].
        moment: (3,) first moment that no mass at the declared centre explains [kg·m].
        moment_deviation: Standard deviation along `moment` [kg·m]; infinite when it is zero.
    """

    mass: float
    mass_deviation: float
    free_mass: float
    free_mass_deviation: float
    moment: FloatArray
    moment_deviation: float


@dataclass(frozen=True, slots=True, eq=False)
class Balance:
    """Poses as a pair of scales.

    Attributes:
        columns: (P, n, 4) of `static_columns`.
        torque: (P, n) the load's torques [N·m]; gain errors are a share of them.
        deviation: (P, n) what is left of friction and noise, standard deviation [N·m].
        com: (3,) where a mass that is weighed has its centre, flange frame [m].
    """

    columns: FloatArray
    torque: FloatArray
    deviation: FloatArray
    com: tuple[float, float, float]

    @property
    def information(self) -> FloatArray:
        """(4, 4) Fisher information about mass at `com` and about the first moment beside it."""
        basis = self._whitened(self.columns @ self._basis)
        return basis.T @ basis

    def weigh(self, surplus: FloatArray) -> Weighed:
        """What explains the torques `surplus` (P, n) beyond the expected ones [N·m] best."""
        basis = self._whitened(self.columns @ self._basis)
        seen = basis.T @ self._whitened(surplus[:, :, None])[:, 0]
        info = basis.T @ basis
        own, both = info[0, 0], info[1:, 0] / info[0, 0]
        rest = info[1:, 1:] - own * np.outer(both, both)
        inverse = np.linalg.pinv(rest, rcond=UNDETERMINED, hermitian=True)
        share = seen[1:] - both * seen[0]
        moment: FloatArray = inverse @ share
        length, significance = float(np.linalg.norm(moment)), float(np.sqrt(share @ moment))
        return Weighed(
            mass=float(seen[0] / own),
            mass_deviation=float(np.sqrt(1 / own)),
            free_mass=float(seen[0] / own - both @ moment),
            free_mass_deviation=float(np.sqrt(1 / own + both @ inverse @ both)),
            moment=moment,
            moment_deviation=length / significance if significance > 0 else np.inf,
        )

    @property
    def _basis(self) -> FloatArray:
        """(4, 4) columns: a kilogram at `com`, then a kg·m along each axis."""
        basis = np.eye(4)
        basis[1:, 0] = self.com
        return basis

    def _whitened(self, values: FloatArray) -> FloatArray:
        """(n·P, k) of `values` (P, n, k) with errors of size 1 that do not correlate."""
        gains = GAIN_SHARE * self.torque.T[:, :, None]
        friction = np.eye(len(self.torque)) * self.deviation.T[:, :, None] ** 2
        lower = np.linalg.cholesky(friction + gains @ gains.transpose(0, 2, 1))
        white: FloatArray = np.linalg.solve(lower, values.transpose(1, 0, 2))
        return white.reshape(-1, values.shape[2])
