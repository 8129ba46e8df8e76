"""The load at the flange of an arm that holds a few poses, like a pair of scales, in seconds.

At rest a load shows its mass m and first moment m·c alone, linearly (`static_columns`); its inertia
does not show. A program's dwells are put together pose by pose (`RestReadings`): the mean of the
two approaches is free of most friction, and half their difference is the friction. What is left
over by the model of the bare arm is explained by the four numbers (`RestProblem`), by generalised
least squares over errors of known kinds: drive gains, which err by the same share at every pose;
the model's gravity, likewise; a constant per joint; and what of the friction does not cancel
between two approaches, pose by pose. With a recording of the bare flange at the same poses the
model's own errors cancel, and only differences count.
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
"""A result with a wider 95 % interval is not reported: it would be taken for a measurement."""


def estimate_payload_at_rest(
    model: RobotEstimator,
    dataset: Dataset,
    *,
    bare: Dataset | None = None,
    gain_share: float = GAIN_SHARE,
) -> PayloadEstimate:
    """Mass and centre of mass of what hangs at the flange, from poses that the arm held.

    Args:
        model: Fitted to recordings of the same arm whose loads are known.
        dataset: Dwells with one load, or motion with stays in it.
        bare: The same program with nothing mounted: much smaller errors.
        gain_share: Standard deviation of a drive gain [share of it]; torques have no gains.

    Returns:
        An estimate whose inertia is NaN, and its centre too where no load shows or no pose shows
        it. Its errors include those of the gains (so its `by_gain` is 0) and of the model.

    Raises:
        FitError: The model is not fitted, has no drive gains, predicts from the measured effort,
            or predicts no arm at rest; the arm never rested; values are not finite, or the effort
            is 0; the poses are too few or do not show the mass; the dry friction is not known; the
            arm is lighter than the model has it.
        DataError: The data are of another robot, unit or gravity, or `bare` of other poses or
            approaches.
    """
    require_torque(model)
    if model.protocol != HONEST:
        raise FitError(
            f"{model.protocol}: such a model cannot tell a load at rest",
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
            "the arm never rested in this recording, so it says nothing about a load at rest",
            hint="run experiments/ur5_weigh.yaml, or use a model of motion",
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
            f"these poses do not show the mass: it is uncertain by {reach:.0f} kg",
            hint="hold poses at which gravity turns joints that the load loads: the arm stretched",
        )
    if mass < -reach:
        raise FitError(
            f"the arm is {-mass:.2f} ± {reach:.2f} kg lighter at the flange than the model has it",
            hint="the model, or --bare, must be of the arm without the load",
        )


def _notes(
    problem: RestProblem, values: FloatArray, interval: FloatArray, shows: bool
) -> Iterator[str]:
    yield "an arm at rest does not show a load's inertia: use a recording of motion for that"
    if problem.one_sided_count:
        poses = f"{problem.one_sided_count} of {len(problem.found)} poses"
        side = "an unknown side" if problem.tared else "one side only"
        yield f"{poses} were approached from {side}: their friction is part of the errors"
    if not problem.tared:
        yield "the same program run with nothing mounted (--bare RUN) makes errors much smaller"
    if not shows:
        return
    axes = [axis for axis, value in zip("xyz", values[1:STATIC], strict=True) if np.isnan(value)]
    if axes:
        yield (
            f"these poses do not show com_{', com_'.join(axes)}: hold poses in which the flange's "
            "axis points in other directions (with it vertical, a centre anywhere on it is alike)"
        )
    if np.all((interval[1:3, 0] <= 0.0) & (interval[1:3, 1] >= 0.0)):
        yield (
            "the centre of mass is on the flange's axis as far as can be told: which way round "
            "the load is mounted does not show"
        )


SAME_POSE_RAD = 0.01
"""Poses whose joints are all nearer than this to one another are one pose."""


@dataclass(frozen=True, slots=True, eq=False)
class RestReadings:
    """Efforts at P poses; of a pose that was approached from both sides, the mean of both.

    Attributes:
        q: (P, n) positions [rad].
        effort: (P, n) in the unit of the data.
        half: (P, n) half the difference between the approaches; NaN where there was one only.
        sides: Per pose, the approaches there were: +1, −1, and 0 for an unknown one.
    """

    q: FloatArray
    effort: FloatArray
    half: FloatArray
    sides: tuple[frozenset[int], ...]

    @property
    def one_sided(self) -> BoolArray:
        """(P,) poses at which friction does not cancel."""
        return np.asarray(~np.isfinite(self.half).all(axis=1))

    @property
    def side_unknown(self) -> BoolArray:
        """(P,) poses of which no direction of approach is known."""
        return np.array([side == {0} for side in self.sides])

    @staticmethod
    def of(dwells: Dataset) -> RestReadings:
        """Put dwells together, pose by pose."""
        q, effort = (series_means(dwells, dwells[name]) for name in ("q", "effort"))
        poses: dict[tuple[str, int], dict[int, list[int]]] = {}
        for number, condition in enumerate(dwells.conditions):
            sides = poses.setdefault(_pose(condition, number), {})
            sides.setdefault(condition.approach, []).append(number)
        rows = [_read(q, effort, sides) for sides in poses.values()]
        at, mean, half = (np.array(column) for column in zip(*rows, strict=True))
        return RestReadings(at, mean, half, tuple(map(frozenset, poses.values())))

    def matching(self, other: RestReadings) -> RestReadings:
        """The readings of `other` at the poses of this one, in this order.

        Raises:
            DataError: It was not at one of them, or came there from elsewhere.
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
                f"{len(missing)} of {len(self.q)} poses were not held with the bare flange, or not "
                "approached from the same sides",
                hint="run the same program with and without the load",
            )
        sides = tuple(other.sides[there] for there in nearest)
        return RestReadings(other.q[nearest], other.effort[nearest], other.half[nearest], sides)


def _pose(condition: Conditions, number: int) -> tuple[str, int]:
    """Dwells without a number of a pose, or without a side, are poses of their own."""
    known = condition.pose >= 0 and condition.approach
    return (condition.source, condition.pose) if known else ("", number)


def _read(
    q: FloatArray, effort: FloatArray, sides: dict[int, list[int]]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position, effort and half difference (n,) of one pose, both sides weighing the same."""
    at, mean = (
        np.mean([values[numbers].mean(axis=0) for numbers in sides.values()], axis=0)
        for values in (q, effort)
    )
    if not {1, -1} <= sides.keys():
        return at, mean, np.full_like(mean, np.nan)
    return at, mean, (effort[sides[1]].mean(axis=0) - effort[sides[-1]].mean(axis=0)) / 2


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
    """Standard deviations of a model's errors at rest, except drive gains.

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
        bare_torque: (P, n) torque of the bare arm by the model [N·m].
        tared: Whether readings of the bare flange were subtracted.
        errors: Of the model.
        variance: (P, n) of `found`, errors that repeat from pose to pose left out [N²·m²].
        friction: (n,) dry friction; unless tared, at least the model's own residual [N·m].
        gain_share: Standard deviation of a drive gain, as a share of it.
        one_sided_count: How many poses have all of their friction left.
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
        """With or without the readings of the bare flange at the same poses, `first`.

        Raises:
            FitError: There are too few poses, the friction is not known, or the model does not
                predict an arm at rest.
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
            # Friction cancels if both runs came from the same side. If the side is unknown, they
            # may not have: both readings keep theirs.
            errors, one_sided, uncancelled = TARED, readings.side_unknown, np.sqrt(2.0)
            change = np.nan_to_num(readings.half - first.half) * K
        else:
            # A residual above the friction means the model is at least that wrong.
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
        """(4,) parameters, their covariance (4, 4), and what is left of the torques (P, n)."""
        phi = np.zeros(STATIC)
        for _ in range(STEPS):
            # The model may make more of a load than its rigid torque; without a mass, nothing.
            beyond = self._load_torque(phi) - self.columns @ phi
            wanted, carried = self.found - beyond, self.columns @ phi
            X, y = self._whitened(self.columns, carried), self._whitened(wanted[..., None], carried)
            covariance = np.asarray(np.linalg.inv(X.T @ X + PRIOR * np.eye(STATIC)))
            phi = np.asarray(covariance @ X.T @ y[:, 0])
        chi2 = float(np.sum((y[:, 0] - X @ phi) ** 2)) / (len(X) - STATIC)
        # More is left than the errors explain: they are larger here.
        return phi, np.asarray(covariance * max(1.0, chi2)), wanted - self.columns @ phi

    def _load_torque(self, phi: FloatArray) -> FloatArray:
        if phi[0] <= 0.0:
            return np.asarray(self.columns @ phi)
        return _torque_at_rest(self.model, self.readings.q, point_load(phi)) - self.bare_torque

    def _whitened(self, values: FloatArray, carried: FloatArray) -> FloatArray:
        """(n·P, k) of `values` (P, n, k) with errors of size 1 that do not correlate."""
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
    """Raise FitError unless there are more torques than parameters of a load."""
    if poses * joints <= STATIC:
        raise FitError(
            f"{poses} {'pose' if poses == 1 else 'poses'} of {joints} joints is too few to "
            "identify a load's mass and centre",
            hint=f"hold at least {STATIC // joints + 1} poses",
        )


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


def _torque_at_rest(model: RobotEstimator, q: FloatArray, load: Payload) -> FloatArray:
    """(P, n) torque [N·m] that the model expects of an arm that came from nowhere."""
    effort: FloatArray = model.predict(resting_at(model, q, load)).effort
    if not np.all(np.isfinite(effort)):
        raise FitError(f"the model {model.estimator} does not predict an arm at rest")
    return effort * model.torque_scale_


def point_load(phi: FloatArray) -> Payload:
    """A point mass of mass and first moment (4,); the mass must be above 0."""
    x, y, z = (float(value) for value in phi[1:] / phi[0])
    return Payload(float(phi[0]), (x, y, z))
