"""Torques at rest beyond those of the bare arm, the four numbers behind them, and their errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.arms import Payload
from hil.core import FitError, FloatArray
from hil.dynamics import static_columns
from hil.estimators.base import RobotEstimator
from hil.estimators.rest_readings import RestReadings
from hil.estimators.standstill import dry_friction, resting_at

STATIC = 4
"""A load's mass and first moment."""

STEPS = 8
"""A load that friction or a drive makes more of than its rigid torque settles in three."""

LEAST_NM = 0.01
"""Least standard deviation of a torque [N·m]: a simulation without noise has none."""

PRIOR = 1e-6
"""Information about each of the four without any pose: 1000 kg, 1000 kg·m. Nothing is singular."""


@dataclass(frozen=True, slots=True)
class RestErrors:
    """Standard deviations of what a model at rest has wrong beside its gains.

    Measured on the embedded mock's UR5, seeds 1 to 9, by `rigid-wls`, `rigid-hysteresis`,
    `static-wls` and `static-hysteresis`, whose controller knew of the load or did not; see
    docs/how-to/identify-a-load.md.

    Attributes:
        offset: Of a joint's constant, as a share of its dry friction.
        pose: Of what friction leaves at a pose, the mean of two approaches, as a share of it.
        gravity: Of the bare arm's gravity, as a share of it, one for all poses.
        change: Of what dry friction has changed by since the bare weighing.
    """

    offset: float = 0.3
    pose: float = 0.3
    gravity: float = 0.15
    change: float = 0.0


LEARNT_AT_REST = RestErrors(gravity=0.06)
"""Those of models of an arm at rest; in motion, friction takes some of the gravity."""

TARED = RestErrors(offset=0.08, pose=0.15, gravity=0.0, change=0.5)
"""Those of the difference to a weighing of the bare flange. Friction leaves that much because a
controller that is told of another load than hangs there comes to rest otherwise."""


@dataclass(frozen=True, slots=True, eq=False)
class RestProblem:
    """What poses tell of a load, and how surely.

    Attributes:
        model: Of the arm.
        readings: At P poses.
        found: (P, n) torque beyond that of the bare arm [N·m].
        columns: (P, n, 4) of `static_columns`.
        bare: (P, n) torque of the bare arm by the model [N·m].
        errors: Of the model.
        variance: (P, n) of `found`, errors that repeat from pose to pose left out [N²·m²].
        friction: (n,) dry friction, or the model's own residual if that is larger [N·m].
        gain_share: Standard deviation of a drive gain, as a share of it.
        one_sided: How many poses have all of their friction left.
    """

    model: RobotEstimator
    readings: RestReadings
    found: FloatArray
    columns: FloatArray
    bare: FloatArray
    errors: RestErrors
    variance: FloatArray
    friction: FloatArray
    gain_share: float
    one_sided: int

    @staticmethod
    def of(
        model: RobotEstimator,
        readings: RestReadings,
        first: RestReadings | None,
        gain_share: float,
    ) -> RestProblem:
        """With or without the readings of the bare flange at the same poses, `first`.

        Raises:
            FitError: Nobody knows the friction, or the model does not predict an arm at rest.
        """
        K = model.torque_scale_
        bare = _at_rest(model, readings.q, Payload())
        found = readings.effort * K - bare
        errors = LEARNT_AT_REST if "dwell" in model.series_kinds[0] else RestErrors()
        change, one_sided = np.zeros_like(found), readings.one_sided
        friction = _friction(model, readings)
        if first is not None:
            found = found - (first.effort * K - _at_rest(model, first.q, Payload()))
            # From one side friction cancels as well, if it was the same side.
            errors, one_sided = TARED, np.zeros_like(one_sided)
            change = np.nan_to_num(readings.half - first.half) * K
        else:
            # A model that errs by more than friction does not know its arm.
            friction = np.maximum(friction, model.sigma_ * K)
        whole = np.where(one_sided, 1.0, errors.pose)[:, None]
        variance = (whole * friction) ** 2 + (errors.change * change) ** 2 + LEAST_NM**2
        gains = 0.0 if model.effort_kind_ == "torque" else gain_share
        columns = static_columns(model.robot_, readings.q)
        return RestProblem(
            model, readings, found, columns, bare, errors, variance, friction, gains,
            int(one_sided.sum()),
        )  # fmt: skip

    def solved(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(4,) parameters, their covariance (4, 4), and what is left of the torques (P, n)."""
        phi = np.zeros(STATIC)
        for _ in range(STEPS):
            # The model may make more of a load than its rigid torque; without a mass, nothing.
            beyond = self._load(phi) - self.columns @ phi
            wanted, carried = self.found - beyond, self.columns @ phi
            X, y = self._whitened(self.columns, carried), self._whitened(wanted[..., None], carried)
            covariance = np.asarray(np.linalg.inv(X.T @ X + PRIOR * np.eye(STATIC)))
            phi = np.asarray(covariance @ X.T @ y[:, 0])
        chi2 = float(np.sum((y[:, 0] - X @ phi) ** 2)) / (len(X) - STATIC)
        # More is left than the errors explain: they are larger here.
        return phi, np.asarray(covariance * max(1.0, chi2)), wanted - self.columns @ phi

    def _load(self, phi: FloatArray) -> FloatArray:
        if phi[0] <= 0.0:
            return np.asarray(self.columns @ phi)
        return _at_rest(self.model, self.readings.q, point_load(phi)) - self.bare

    def _whitened(self, values: FloatArray, carried: FloatArray) -> FloatArray:
        """(n·P, k) of `values` (P, n, k) with errors of size 1 that do not correlate."""
        poses = len(self.variance)
        common = [
            self.gain_share * carried,
            self.errors.gravity * self.bare,
            np.broadcast_to(self.errors.offset * self.friction, carried.shape),
        ]
        V = sum(part.T[:, :, None] @ part.T[:, None, :] for part in common)
        V = V + np.eye(poses) * self.variance.T[:, :, None]
        white = np.linalg.solve(np.linalg.cholesky(V), values.transpose(1, 0, 2))
        return np.asarray(white.reshape(-1, values.shape[2]))


def _friction(model: RobotEstimator, readings: RestReadings) -> FloatArray:
    """(n,) dry friction [N·m]: as the two approaches show it, else as the model has it."""
    both = readings.half[~readings.one_sided]
    if len(both):
        return np.asarray(np.sqrt(np.mean(both**2, axis=0)) * model.torque_scale_)
    level = dry_friction(model)
    if level is None:
        raise FitError(
            "no pose was approached from both sides, and the model does not tell dry friction: "
            "nobody knows how much of the torques is the load's",
            hint="use approach: both, as experiments/ur5_weigh.yaml does",
        )
    return level


def _at_rest(model: RobotEstimator, q: FloatArray, load: Payload) -> FloatArray:
    """(P, n) torque [N·m] that the model expects of an arm that came from nowhere."""
    effort: FloatArray = model.predict(resting_at(model, q, load)).effort
    if not np.all(np.isfinite(effort)):
        raise FitError(f"the model {model.estimator} does not predict an arm at rest")
    return effort * model.torque_scale_


def point_load(phi: FloatArray) -> Payload:
    """A point mass of mass and first moment (4,); the mass must be above 0."""
    x, y, z = (float(value) for value in phi[1:] / phi[0])
    return Payload(float(phi[0]), (x, y, z))
