"""Payload check from the joint torques of a static arm, with standard deviations.

The static torques of a payload are linear in its parameters (m, m·cx, m·cy, m·cz) in the flange
frame. The measured torques have two kinds of error. Residual friction is independent from pose to
pose, whereas errors of the drive gains are the same share of the torque at every pose. Generalised
least squares accounts for residual friction and gain errors. In a joint with an inaccurate gain,
small torques have more weight than large torques.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray
from hil.dynamics.robot_model import RobotModel

GAIN_SHARE = 0.05
"""Relative standard deviation of a drive gain from its nominal value.

The motor constants of one type of drive have tolerances of a few percent.
"""

CALIBRATED_SHARE = 0.01
"""Relative standard deviation of a drive gain that was measured on the arm itself."""

UNDETERMINED = 1e-6
"""Share of the information of the best direction below which a direction is not identifiable.

The directions are directions of the first moment at the evaluated poses.
"""


def static_columns(model: RobotModel, q: FloatArray) -> FloatArray:
    """Return the static torques (P, n, 4) at `q` (P, n) per kg and per kg·m of first moment."""
    still = np.zeros(np.shape(q))
    columns: FloatArray = model.payload_regressor(q, still, still)[:, :4]
    return columns.reshape(len(q), model.n, 4)


def static_parameters(load: Payload) -> FloatArray:
    """Return mass [kg] and first moment [kg·m] (4,) of a payload, both in the flange frame."""
    return load.mass * np.array([1.0, *load.com])


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """Difference of a payload from the expected payload.

    Attributes:
        mass: Additional mass [kg], if its centre of mass is at the declared position.
        mass_deviation: Standard deviation of `mass` [kg].
        free_mass: Additional mass [kg], if its centre of mass may be at any position.
        free_mass_deviation: Standard deviation of `free_mass` [kg].
        moment: (3,) first moment [kg·m] that no mass at the declared centre of mass explains.
        moment_deviation: Standard deviation of the first moment along `moment` [kg·m]; infinite if
            `moment` is zero.
    """

    mass: float
    mass_deviation: float
    free_mass: float
    free_mass_deviation: float
    moment: FloatArray
    moment_deviation: float


@dataclass(frozen=True, slots=True, eq=False)
class Balance:
    """Poses from which a payload is identified, with their torques and errors.

    Attributes:
        columns: (P, n, 4) static torques per unit of the payload parameters, from `static_columns`.
        torque: (P, n) torques of the payload [N·m], to which the effects of gain errors are
            proportional.
        deviation: (P, n) standard deviations of residual friction and noise [N·m].
        com: (3,) position of the centre of mass of the additional mass, in the flange frame [m].
    """

    columns: FloatArray
    torque: FloatArray
    deviation: FloatArray
    com: tuple[float, float, float]

    @property
    def information(self) -> FloatArray:
        """Fisher information (4, 4) about the mass at `com` and the additional first moment."""
        basis = self._whitened(self.columns @ self._basis)
        return basis.T @ basis

    def weigh(self, surplus: FloatArray) -> Weighed:
        """Return the payload difference that best explains the torques `surplus` (P, n) [N·m].

        The torques `surplus` are the measured torques minus the expected torques.
        """
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
        """Basis vectors as columns (4, 4): 1 kg at `com`, then 1 kg·m along each axis."""
        basis = np.eye(4)
        basis[1:, 0] = self.com
        return basis

    def _whitened(self, values: FloatArray) -> FloatArray:
        """Return `values` (P, n, k) as (n·P, k), with uncorrelated errors of unit variance."""
        gains = GAIN_SHARE * self.torque.T[:, :, None]
        friction = np.eye(len(self.torque)) * self.deviation.T[:, :, None] ** 2
        lower = np.linalg.cholesky(friction + gains @ gains.transpose(0, 2, 1))
        white: FloatArray = np.linalg.solve(lower, values.transpose(1, 0, 2))
        return white.reshape(-1, values.shape[2])
