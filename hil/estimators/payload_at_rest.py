"""Payload identification from static poses: mass and centre of mass.

In a static pose, the torques of a payload are linear in its mass m and first moment m·c
(`static_columns`), and independent of its inertia. `RestReadings` averages the dwells of a program
pose by pose. The mean of both approach directions contains little friction, and half the difference
of both directions is the friction. `RestProblem` explains the difference between the measured
torques and the model of the bare arm by the four payload parameters.

The payload is computed by generalised least squares with four kinds of errors: drive gains, which
err by the same share at every pose; the gravity model, which errs by the same share at every pose;
a constant per joint; and the friction at each pose that the two approach directions do not cancel.
A second recording of the same poses without payload cancels the errors of the arm model, because
only differences are used.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hil.arms import Payload
from hil.core import BoolArray, DataError, FitError, FloatArray, HilError
from hil.data import Conditions, Dataset, dwells_of, series_means
from hil.dynamics import GAIN_SHARE, static_columns
from hil.estimators.base import HONEST, RobotEstimator
from hil.estimators.checks import require_clean
from hil.estimators.distributions import student_quantile
from hil.estimators.payload import LEVEL, Correction, PayloadEstimate, rms
from hil.estimators.standstill import dry_friction, require_torque, resting_at

MOST_KG, MOST_M = 5.0, 0.3
"""Largest half width of a reported 95 % interval, for the mass [kg] and the centre of mass [m].

A value with a wider interval is not reported, because users would mistake the value for a
measurement.
"""


def estimate_payload_at_rest(
    model: RobotEstimator,
    dataset: Dataset,
    *,
    bare: Dataset | None = None,
    gain_share: float = GAIN_SHARE,
) -> PayloadEstimate:
    """Return the mass and the centre of mass of the payload, from static poses.

    Args:
        model: Model fitted to recordings of the same arm with known payloads.
        dataset: Dwells with one payload, or a motion that contains static phases.
        bare: Recording of the same program without payload, which strongly reduces the errors; None
            without such a recording.
        gain_share: Standard deviation of a drive gain, as a share of the gain; not used for torque
            data.

    Returns:
        Payload estimate whose inertia is NaN. The centre of mass is also NaN if no payload is
        detected or if the poses do not determine it. The standard errors include the errors of the
        drive gains and of the model; `by_gain` is therefore 0.

    Raises:
        FitError: The model is not fitted, has no drive gains, uses the measured effort as an input,
            or does not predict a static arm. The data contain no dwell, contain values that are not
            finite, or contain an effort of 0 only. The number of poses is too small, or the poses
            do not determine the mass. The dry friction of the joints is unknown. The identified
            mass is significantly negative.
        DataError: Robot, unit or gravity of the data differ from those of the model, or `bare`
            contains different poses or approach directions.
    """
    require_torque(model)
    if model.protocol != HONEST:
        raise FitError(
            f"{model.protocol}; such a model cannot identify a payload from static poses",
            hint="fit without current_term",
        )
    readings = _readings(model, dataset)
    first = None if bare is None else _tare(model, readings, bare)
    problem = RestProblem.of(model, readings, first, gain_share)
    return _estimate(problem, *problem.solved())


def _readings(model: RobotEstimator, dataset: Dataset) -> RestReadings:
    model.require_match(dataset)
    dwells = dwells_of(dataset)
    if not len(dwells.conditions):
        raise FitError(
            "the arm was never at standstill in this recording, so a static identification of the "
            "payload is not possible",
            hint="run experiments/ur5_weigh.yaml, or use a model that was fitted to motion",
        )
    require_clean(dwells, ("t", "q", "effort"))
    return RestReadings.of(dwells)


def _tare(model: RobotEstimator, readings: RestReadings, bare: Dataset) -> RestReadings:
    try:
        return readings.matching(_readings(model, bare))
    except HilError as error:
        of = ", ".join(dict.fromkeys(condition.source for condition in bare.conditions))
        raise type(error)(f"the bare flange ({of}): {error.message}", hint=error.hint) from error


def _estimate(
    problem: RestProblem, phi: FloatArray, covariance: FloatArray, left: FloatArray
) -> PayloadEstimate:
    n, degrees = left.shape[1], left.size - STATIC
    t = float(student_quantile((1.0 + LEVEL) / 2.0, degrees))
    values, spread = np.full(10, np.nan), np.full((10, 10), np.nan)
    values[0], spread[0, 0] = phi[0], covariance[0, 0]
    _require_mass(phi[0], t * np.sqrt(covariance[0, 0]))
    shows = phi[0] > t * np.sqrt(covariance[0, 0])
    if shows:
        G = np.vstack([np.eye(STATIC)[0], np.eye(STATIC)[1:] / phi[0]])
        G[1:, 0] = -phi[1:] / phi[0] ** 2
        spread[:STATIC, :STATIC] = G @ covariance @ G.T
        known = t * np.sqrt(np.diag(spread)[1:STATIC]) <= MOST_M
        values[1:STATIC] = np.where(known, phi[1:] / phi[0], np.nan)
        spread[:, 1:STATIC][:, ~known], spread[1:STATIC][~known] = np.nan, np.nan
    error = np.sqrt(np.diag(spread))
    scale = problem.model.torque_scale_
    interval = np.column_stack([values - t * error, values + t * error])
    return PayloadEstimate(
        payload=point_load(np.append(phi[0], phi[0] * np.nan_to_num(values[1:STATIC])))
        if shows else Payload(),
        values=values, std_error=error, interval=interval, covariance=spread,
        degrees=np.full(10, float(degrees)), by_gain=np.zeros((10, n)),
        residual=rms(left / scale), without=rms(problem.found / scale),
        unit="A" if problem.model.effort_kind_ == "current" else "N·m",
        joint_names=problem.model.joint_names_, friction="rest",
        correction=Correction(np.zeros(n), np.zeros(n)),
        samples=len(left), blocks=len(left), bounded=False,
        notes=tuple(_notes(problem, values, interval, bool(shows))),
        gain_share=problem.gain_share,
    )  # fmt: skip


def _require_mass(mass: float, reach: float) -> None:
    if reach > MOST_KG:
        raise FitError(
            f"these poses do not determine the mass: its uncertainty is {reach:.0f} kg",
            hint="choose poses in which the payload causes large joint torques, such as a "
            "stretched arm",
        )
    if mass < -reach:
        raise FitError(
            f"at the flange, the arm is {-mass:.2f} ± {reach:.2f} kg lighter than in the model",
            hint="the model, or the recording of --bare, must be of the arm without payload",
        )


def _notes(
    problem: RestProblem, values: FloatArray, interval: FloatArray, shows: bool
) -> Iterator[str]:
    yield "static poses do not determine the inertia of a payload: record a motion for the inertia"
    if problem.one_sided_count:
        poses = f"{problem.one_sided_count} of {len(problem.found)} poses"
        side = "an unknown direction" if problem.tared else "one direction only"
        yield f"{poses} were approached from {side}: their friction is included in the errors"
    if not problem.tared:
        yield "a run of the same program without payload (--bare RUN) makes errors much smaller"
    if not shows:
        return
    axes = [axis for axis, value in zip("xyz", values[1:STATIC], strict=True) if np.isnan(value)]
    if axes:
        yield (
            f"these poses do not determine com_{', com_'.join(axes)}: add poses in which the "
            "flange axis points in other directions (if the axis is vertical, every centre on the "
            "axis gives the same torques)"
        )
    if np.all((interval[1:3, 0] <= 0.0) & (interval[1:3, 1] >= 0.0)):
        yield (
            "within its uncertainty, the centre of mass is on the flange axis, so the mounting "
            "angle of the payload cannot be checked"
        )


SAME_POSE_RAD = 0.01
"""Largest difference of joint positions between dwells of the same pose [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class RestReadings:
    """Positions and efforts at P static poses, averaged over the two approach directions.

    Attributes:
        q: (P, n) positions [rad].
        effort: (P, n) efforts, in the unit of the data.
        half: (P, n) half of the effort difference between the approach directions; NaN if a pose
            was approached from one direction only.
        sides: Known approach directions of each pose: +1, −1, or 0 if unknown.
    """

    q: FloatArray
    effort: FloatArray
    half: FloatArray
    sides: tuple[frozenset[int], ...]

    @property
    def one_sided(self) -> BoolArray:
        """Mask (P,) of the poses at which friction does not cancel in the mean."""
        return np.asarray(~np.isfinite(self.half).all(axis=1))

    @property
    def side_unknown(self) -> BoolArray:
        """Mask (P,) of the poses with no known approach direction."""
        return np.array([side == {0} for side in self.sides])

    @staticmethod
    def of(dwells: Dataset) -> RestReadings:
        """Return the readings of a dataset of dwells, combined pose by pose."""
        q, effort = (series_means(dwells, dwells[name]) for name in ("q", "effort"))
        poses: dict[tuple[str, int], dict[int, list[int]]] = {}
        for number, condition in enumerate(dwells.conditions):
            sides = poses.setdefault(_pose(condition, number), {})
            sides.setdefault(condition.approach, []).append(number)
        rows = [_read(q, effort, sides) for sides in poses.values()]
        at, mean, half = (np.array(column) for column in zip(*rows, strict=True))
        return RestReadings(at, mean, half, tuple(map(frozenset, poses.values())))

    def matching(self, other: RestReadings) -> RestReadings:
        """Return the readings of `other` at the poses of these readings, in the same order.

        Raises:
            DataError: A pose is missing in `other`, or was approached from different directions.
        """
        apart = np.max(np.abs(self.q[:, None] - other.q[None]), axis=2)
        nearest = np.argmin(apart, axis=1)
        missing = [
            pose
            for pose, there in enumerate(nearest)
            if apart[pose, there] > SAME_POSE_RAD or self.sides[pose] != other.sides[there]
        ]
        if missing:
            raise DataError(
                f"{len(missing)} of {len(self.q)} poses were not recorded with the bare flange, "
                "or not approached from the same directions",
                hint="run the same program with and without the payload",
            )
        sides = tuple(other.sides[there] for there in nearest)
        return RestReadings(other.q[nearest], other.effort[nearest], other.half[nearest], sides)


def _pose(condition: Conditions, number: int) -> tuple[str, int]:
    """Return a key that is equal for dwells of the same pose.

    Dwells without a pose number or without an approach direction each get a separate key.
    """
    known = condition.pose >= 0 and condition.approach
    return (condition.source, condition.pose) if known else ("", number)


def _read(
    q: FloatArray, effort: FloatArray, sides: dict[int, list[int]]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the position, the effort and the half difference (n,) of one pose.

    The two approach directions have the same weight in the mean.
    """
    at, mean = (
        np.mean([values[numbers].mean(axis=0) for numbers in sides.values()], axis=0)
        for values in (q, effort)
    )
    if not {1, -1} <= sides.keys():
        return at, mean, np.full_like(mean, np.nan)
    return at, mean, (effort[sides[1]].mean(axis=0) - effort[sides[-1]].mean(axis=0)) / 2


STATIC = 4
"""Number of payload parameters that static poses determine: mass and first moment."""

STEPS = 8
"""Number of fixed-point iterations in the computation of the payload.

Three iterations are enough if friction or a drive increases the payload effort over its rigid
value.
"""

LEAST_NM = 0.01
"""Lower bound for the standard deviation of a torque [N·m], for simulations without noise."""

PRIOR = 1e-6
"""Prior information on each of the four payload parameters, for 1000 kg and 1000 kg·m.

The prior keeps the normal equations regular if the poses do not determine all parameters.
"""


@dataclass(frozen=True, slots=True)
class RestErrors:
    """Standard deviations of the model errors in static poses, apart from the drive gains.

    The error values were measured on the UR5 of the embedded mock, seeds 1 to 9, with `rigid-wls`,
    `rigid-hysteresis`, `static-wls` and `static-hysteresis`. The payload was declared to the
    controller in some runs and undeclared in others; see docs/how-to/identify-a-load.md.

    Attributes:
        offset: Error of the constant torque of a joint, as a share of its dry friction.
        pose: Friction that remains in the mean of two approach directions, as a share of the dry
            friction.
        gravity: Error of the gravity torque of the bare arm, as a share of this torque, common to
            all poses.
        change: Error due to a change of dry friction since the recording without payload, as a
            share of this change.
    """

    offset: float = 0.3
    pose: float = 0.3
    gravity: float = 0.15
    change: float = 0.0


LEARNT_AT_REST = RestErrors(gravity=0.06)
"""Standard deviations of the errors of models that were fitted to static poses.

Models that were fitted to motions have larger gravity errors: their friction terms absorb a part of
the gravity torque.
"""

TARED = RestErrors(offset=0.08, pose=0.15, gravity=0.0, change=0.5)
"""Standard deviations of the errors of the difference to a recording without payload.

The remaining friction in the difference is due to the controller: if its declared payload differs
from the mounted payload, the joints come to rest in a different way.
"""


@dataclass(frozen=True, slots=True, eq=False)
class RestProblem:
    """Generalised least-squares problem of a payload in static poses.

    Attributes:
        model: Fitted model of the arm.
        readings: Averaged readings at P poses.
        found: (P, n) measured torque minus the torque of the bare arm [N·m].
        columns: (P, n, 4) regressor of `static_columns`.
        bare_torque: (P, n) predicted torque of the bare arm [N·m].
        tared: Whether the readings without payload were subtracted.
        errors: Standard deviations of the errors of the arm model.
        variance: (P, n) variance of `found` without errors common to all poses [N²·m²].
        friction: (n,) dry friction [N·m]. If `tared` is false, the value is at least the residual
            standard deviation of the model.
        gain_share: Standard deviation of a drive gain, as a share of the gain.
        one_sided_count: Number of poses approached from one direction, at which the friction does
            not cancel.
    """

    model: RobotEstimator
    readings: RestReadings
    found: FloatArray
    columns: FloatArray
    bare_torque: FloatArray
    tared: bool
    errors: RestErrors
    variance: FloatArray
    friction: FloatArray
    gain_share: float
    one_sided_count: int

    @staticmethod
    def of(
        model: RobotEstimator,
        readings: RestReadings,
        first: RestReadings | None,
        gain_share: float,
    ) -> RestProblem:
        """Return the payload problem, with or without readings of the bare flange.

        Args:
            model: Fitted model of the arm.
            readings: Readings with the payload at P poses.
            first: Readings without payload at the same poses, or None.
            gain_share: Standard deviation of a drive gain, as a share of the gain.

        Raises:
            FitError: There are too few poses, the friction is unknown, or the model does not
                predict a static arm.
        """
        _require_enough(*readings.q.shape)
        K = model.torque_scale_
        bare_torque = _torque_at_rest(model, readings.q, Payload())
        found = readings.effort * K - bare_torque
        errors = LEARNT_AT_REST if "dwell" in model.series_kinds[0] else RestErrors()
        change, one_sided = np.zeros_like(found), readings.one_sided
        friction, uncancelled = _friction(model, readings), 1.0
        if first is not None:
            found = found - (first.effort * K - _torque_at_rest(model, first.q, Payload()))
            # Friction cancels if both runs approached from the same direction. If the direction is
            # unknown, the friction of both readings possibly remains.
            errors, one_sided, uncancelled = TARED, readings.side_unknown, np.sqrt(2.0)
            change = np.nan_to_num(readings.half - first.half) * K
        else:
            # A residual above the friction shows that the model errs by at least that much.
            friction = np.maximum(friction, model.sigma_ * K)
        share = np.where(one_sided, uncancelled, errors.pose)[:, None]
        variance = (share * friction) ** 2 + (errors.change * change) ** 2 + LEAST_NM**2
        gains = 0.0 if model.effort_kind_ == "torque" else gain_share
        columns = static_columns(model.robot_, readings.q)
        return RestProblem(
            model, readings, found, columns, bare_torque, first is not None, errors, variance,
            friction, gains, int(one_sided.sum()),
        )  # fmt: skip

    def solved(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return payload parameters (4,), their covariance (4, 4) and residual torques (P, n)."""
        phi = np.zeros(STATIC)
        for _ in range(STEPS):
            # The payload effort of a model may exceed the rigid torque, for example by friction.
            beyond = self._load_torque(phi) - self.columns @ phi
            wanted, carried = self.found - beyond, self.columns @ phi
            X, y = self._whitened(self.columns, carried), self._whitened(wanted[..., None], carried)
            covariance = np.asarray(np.linalg.inv(X.T @ X + PRIOR * np.eye(STATIC)))
            phi = np.asarray(covariance @ X.T @ y[:, 0])
        chi2 = float(np.sum((y[:, 0] - X @ phi) ** 2)) / (len(X) - STATIC)
        # A χ² above 1 means that the assumed errors are too small, so the covariance is scaled up.
        return phi, np.asarray(covariance * max(1.0, chi2)), wanted - self.columns @ phi

    def _load_torque(self, phi: FloatArray) -> FloatArray:
        if phi[0] <= 0.0:
            return np.asarray(self.columns @ phi)
        return _torque_at_rest(self.model, self.readings.q, point_load(phi)) - self.bare_torque

    def _whitened(self, values: FloatArray, carried: FloatArray) -> FloatArray:
        """Return (n·P, k) the whitened `values` (P, n, k): uncorrelated errors of variance 1."""
        poses = len(self.variance)
        common = [
            self.gain_share * carried,
            self.errors.gravity * self.bare_torque,
            np.broadcast_to(self.errors.offset * self.friction, carried.shape),
        ]
        V = sum(part.T[:, :, None] @ part.T[:, None, :] for part in common)
        V = V + np.eye(poses) * self.variance.T[:, :, None]
        white = np.linalg.solve(np.linalg.cholesky(V), values.transpose(1, 0, 2))
        return np.asarray(white.reshape(-1, values.shape[2]))


def _require_enough(poses: int, joints: int) -> None:
    """Raise FitError unless there are more torques than payload parameters."""
    if poses * joints <= STATIC:
        raise FitError(
            f"{poses} pose(s) of {joints} joints are too few to identify mass and centre of mass "
            "of a payload",
            hint=f"record at least {STATIC // joints + 1} poses",
        )


def _friction(model: RobotEstimator, readings: RestReadings) -> FloatArray:
    """Return (n,) the dry friction of each joint [N·m].

    The dry friction is measured from the two approach directions if possible, and is otherwise
    taken from the model.
    """
    both = readings.half[~readings.one_sided]
    if len(both):
        return np.asarray(np.sqrt(np.mean(both**2, axis=0)) * model.torque_scale_)
    level = dry_friction(model)
    if level is None:
        raise FitError(
            "no pose was approached from both directions, and the model does not contain dry "
            "friction, so the torque of the payload cannot be separated from friction",
            hint="use approach: both, as in experiments/ur5_weigh.yaml",
        )
    return level


def _torque_at_rest(model: RobotEstimator, q: FloatArray, load: Payload) -> FloatArray:
    """Return (P, n) the predicted torque [N·m] of static poses without approach direction."""
    effort: FloatArray = model.predict(resting_at(model, q, load)).effort
    if not np.all(np.isfinite(effort)):
        raise FitError(f"the model {model.estimator} does not predict static poses")
    return effort * model.torque_scale_


def point_load(phi: FloatArray) -> Payload:
    """Return the point mass with this mass and first moment (4,); the mass must be above 0."""
    x, y, z = (float(value) for value in phi[1:] / phi[0])
    return Payload(float(phi[0]), (x, y, z))
