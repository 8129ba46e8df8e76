"""Linear models of a static arm: gravity and an offset per joint, with standard errors.

In a static pose, the motor torque equals gravity: φ_j·θ_j = K₂·i²·sign(i) + K₁·i + K₀ (static
paper, eq. 18). There are two forms of gravity (`BaseGravity`, `PaperGravity`):

- `shared` is the base gravity regressor of the arm with one set of parameters for all joints, plus
  one offset per joint, fitted to the torque K·i. The form `shared` requires drive gains.
- `paper` consists of φ₂…φ₅ of eq. 15, with an independent regression and one offset per joint. The
  form `paper` requires no drive gains if no payload is mounted, and is only valid for six-joint
  arms of Universal Robots on a level base.

The column i²·sign(i) of eq. 20 is left out by default. The column i²·sign(i) contains the target of
the regression, and a model that needs the current to predict the current is useless for prediction.
The setting `current_term` adds the column i²·sign(i) to reproduce the results of the static paper;
reports then show the deviation (`protocol`).

`StaticModel` is the base class with regressor, predictions and checks. `StaticWls` (`static-wls`)
uses weighted least squares. `PoseClustered` is the base class of models with standard errors
clustered by pose. Static friction depends on the approach direction and acts as noise; this noise
averages out at poses that were approached from both directions. Every dwell counts as one
observation, because its ten samples are nearly equal; counting all ten would make the standard
errors three times too small. Models that use the approach direction are in
`hil.estimators.static_friction`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar, Literal, Protocol, Self

import numpy as np

from hil.arms import Payload
from hil.core import BoolArray, FitError, FloatArray, IntArray, SpecError
from hil.data import (
    SAMPLES_PER_DWELL,
    Dataset,
    Prediction,
    RestRule,
    SeriesKind,
    Stream,
    dwells_of,
    group_of,
    series_means,
)
from hil.dynamics import RobotModel, base_parameters, joint_columns
from hil.estimators.base import HONEST, WlsEstimator, load_of, payload_torque
from hil.estimators.checks import (
    Needs,
    require_clean,
    require_motion,
    require_plausible,
    require_robot,
    require_varied,
    torque_scale,
)
from hil.estimators.covariance import interval
from hil.estimators.parameters import choice, flag, number, parameter

Form = Literal["shared", "paper"]

PAPER_PROTOCOL = "paper: the measured current is among the inputs"

CURRENT_PART = "measured current² (paper protocol)"
"""Name of the prediction component that is computed from the measured effort."""


class StaticModel(WlsEstimator):
    """Gravity and offset of a static arm, linear in the parameters.

    After division by K₁ (eq. 19), eq. 18 is linear in the parameters. With `current_term`, the
    regressor of joint j is R_j = [φ_j, i²·sign(i), 1] (eq. 20). The last two coefficients of this
    regressor, divided by `torque_scale_[j]`, are −K₂/K₁ and −K₀/K₁.

    Attributes:
        form, current_term: Parameters of the estimator, or constants of a subclass.
        parameter_names_: Gravity parameters, followed by `offset` for each joint, or by
            `current_squared` and `offset` for each joint.
        samples_: Number of dwells used in the fit.
    """

    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("dwell",), ("trajectory",))
    tells_friction: ClassVar[bool] = False

    form: Form
    current_term: bool
    rest_speed: float = parameter(
        0.01,
        number,
        above=0.0,
        doc="Joint speed [rad/s] above which a row is not static and the model is not valid.",
    )

    @property
    def protocol(self) -> str:
        """Protocol of the model: `honest`, or a text that the measured current is an input."""
        return PAPER_PROTOCOL if self.current_term else HONEST

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return the minimum data requirements: at least as many dwells as parameters.

        Motor currents require no drive gains if every joint is fitted separately and no payload is
        mounted.

        Raises:
            FitError: `form: paper` does not support this robot.
        """
        return Needs(
            {"dwells": len(self._form_of(robot).names) + robot.n * len(self._own_terms())},
            gains=loaded or self.form != "paper",
            effort="current" if self.current_term else "",
        )

    def _dwells(self, dataset: Dataset, robot: RobotModel) -> Dataset:
        """Return the dwells used in the fit, and prepare the regressor.

        Dwells are detected if a motion has no plan.

        Raises:
            FitError: The data are not finite, are of a different robot or unit, or contain
                impossible efforts. The setting `current_term` is on although the efforts are
                torques.
        """
        require_robot(dataset, robot)
        loaded = any(not load_of(condition).is_empty for condition in dataset.conditions)
        needs = self.needs(robot, loaded=loaded)
        self._require_effort(dataset, needs.effort)
        known = needs.gains or dataset.drive_gains is not None
        scale = torque_scale(dataset) if known else np.ones(dataset.n_joints)
        self._remember(dataset, robot, scale)
        require_clean(dataset, ("t", "q", "effort"))
        self._open()
        dwells = dwells_of(dataset, RestRule(speed=self.rest_speed / 2))
        require_plausible(dwells, robot)
        return dwells

    def predict(self, dataset: Dataset) -> Prediction:
        """Return the effort of every row from the measured positions, with its components.

        The effort of rows in motion is predicted too, but marked as not valid. With `current_term`,
        the
        *measured* effort of the dataset is an input; such predictions reproduce the static paper,
        but do not show how well a current can be predicted.

        Raises:
            DataError: Robot or unit of the data differ from those of the model.
            FitError: A payload is mounted, and the training data had no drive gains.
        """
        self.require_match(dataset)
        self._require_gains(any(not load_of(c).is_empty for c in dataset.conditions))
        still = np.zeros_like(dataset["q"])
        whole = self._predict(dataset, dataset["q"], still, still)
        parts, effort = dict(whole.components), whole.effort
        if self.current_term:
            parts[CURRENT_PART] = self._current_part(dataset["effort"])
            effort = effort + parts[CURRENT_PART]
        valid = whole.valid & np.isfinite(effort) & self._at_rest(dataset)[:, None]
        return Prediction(effort, whole.std, valid, parts)

    def stream(self, payload: Payload | None = None) -> Stream:
        """Return a predictor for one sample at a time.

        Raises:
            FitError: `current_term` is set; a prediction would need the current that is to be
                predicted. A payload is mounted, and the training data had no drive gains.
        """
        if self.current_term:
            raise FitError(
                "a model with current_term cannot be streamed: its prediction of the current "
                f"needs the measured current ({self.protocol})",
                hint="fit without current_term",
            )
        self._require_gains(payload is not None and not payload.is_empty)
        return super().stream(payload)

    def _check_together(self) -> None:
        if self.current_term and self.form != "paper":
            raise SpecError(
                "current_term is eq. 20 of the static paper and needs form: paper",
                hint="set form: paper, or leave out current_term",
            )

    def _require_effort(self, dataset: Dataset, needed: str) -> None:
        if needed and dataset.effort_kind != needed:
            raise FitError(
                f"current_term needs motor currents, but the data contain a {dataset.effort_kind}",
                hint="fit without current_term, or on a recording of currents",
            )

    def _require_gains(self, loaded: bool) -> None:
        """Raise if a payload is mounted and its torque cannot be converted to a current."""
        if loaded and not self.knows_gains:
            raise FitError(
                "a payload is mounted, but the model was fitted to currents without drive gains",
                hint="fit again on data with declared drive gains",
            )

    def _open(self) -> None:
        self._form = self._form_of(self.robot_)
        own = (f"{joint}.{term}" for joint in self.joint_names_ for term in self._own_terms())
        self.parameter_names_ = (*self._form.names, *own)

    def _form_of(self, robot: RobotModel) -> GravityForm:
        return PaperGravity(robot) if self.form == "paper" else BaseGravity(robot)

    def _own_terms(self) -> tuple[str, ...]:
        """Return the names of the terms of each joint besides gravity, the offset last."""
        return ("current_squared", "offset") if self.current_term else ("offset",)

    def _observations(self, data: Dataset) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        q, still = data["q"], np.zeros_like(data["q"])
        load = payload_torque(self.robot_, data, q, still, still)
        own = {"current": signed_square(data["effort"])} if self.current_term else {}
        columns = joint_columns(own | {"offset": np.ones_like(q)})
        W = np.hstack([self._form.columns(q), columns])
        yield slice(0, len(data)), W, data["effort"] * self.torque_scale_ - load

    def _own_coefficients(self) -> FloatArray:
        """Return (n, k) the coefficients of the k terms of each joint, the offset last."""
        own: FloatArray = self.coefficients_[len(self._form.names) :]
        return own.reshape(len(self.joint_names_), -1)

    def _current_part(self, current: FloatArray) -> FloatArray:
        part: FloatArray = signed_square(current) * self._own_coefficients()[:, 0]
        return part / self.torque_scale_

    def _parts(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        gravity, offset = (
            self.coefficients_[: len(self._form.names)],
            self._own_coefficients()[:, -1],
        )
        torque = (self._form.columns(q) @ gravity).reshape(q.shape)
        return {
            "gravity": torque / self.torque_scale_,
            "offset": np.broadcast_to(offset / self.torque_scale_, q.shape),
        }

    def _at_rest(self, dataset: Dataset) -> BoolArray:
        """Return (N,) masks of the rows of dwells, and of the rows in which every joint is slow."""
        kinds = np.array([c.kind in ("dwell", "reference") for c in dataset.conditions], dtype=bool)
        resting: BoolArray = kinds[dataset.series_index()]
        if "qd" in dataset.columns:
            resting = resting | (np.max(np.abs(dataset["qd"]), axis=1) < self.rest_speed)
        return resting


def signed_square(current: FloatArray) -> FloatArray:
    """Return i²·sign(i) of eq. 16, computed elementwise."""
    squared: FloatArray = current * np.abs(current)
    return squared


CURRENT_TERM = parameter(
    False,
    flag,
    doc="Use eq. 20 as printed, with the measured current as an input; only with `form: paper`.",
)


class StaticWls(StaticModel):
    """Gravity and offset of a static arm, fitted by weighting the joints."""

    estimator: ClassVar[str] = "static-wls"

    form: Form = parameter("shared", choice, ("shared", "paper"), doc="`shared` or `paper`.")
    weighted: bool = parameter(
        True,
        flag,
        doc="Weight the joints by their residuals; no effect with `form: paper`, whose joints are "
        "independent.",
    )
    current_term: bool = CURRENT_TERM

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit the model to the dwells of the data.

        Dwells are detected if the recording has no plan.

        Raises:
            FitError: The data are too few, not finite, are of a different robot or unit, or do not
                excite all parameters. The setting `current_term` is on although the efforts are
                torques.
        """
        dwells = self._dwells(dataset, robot)
        self.samples_ = len(dwells.conditions)
        self.needs(robot).require(dwells=self.samples_)
        self._solve(one_row_each(dwells), weighted=self.weighted)
        return self


STD_ERROR_GIVEN = (
    "exact drive gains, declared loads, kinematics and form of the model; poses independent of "
    "each other, arbitrary correlation within one pose (clustered by pose, CR2, Student's t with "
    "Satterthwaite's degrees of freedom)"
)

STD_ERROR_LEAVES_OUT = (
    "errors of the gains, loads and kinematics; gravity that the model does not describe; "
    "friction that depends on the pose and not on the approach direction; effects common to all "
    "poses, such as temperature"
)


class PoseClustered(StaticModel):
    """Static model fitted joint by joint (`form: paper`) or for all joints together (`shared`).

    Attributes:
        covariance_: (p, p) covariance of the parameters, clustered by pose; 0 between separate
            regressions.
        degrees_: (p,) degrees of freedom of Student's t distribution for `interval`.
        poses_: Number of poses used in the fit.
    """

    covariance_: FloatArray
    degrees_: FloatArray
    poses_: int

    def interval(self, level: float = 0.95) -> FloatArray:
        """Return (p, 2) the confidence intervals of the parameters; NaN if errors are unknown."""
        return interval(self.coefficients_, self.std_error_, self.degrees_, level)

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Return parameters, covariance, torque scale and residual deviations as arrays."""
        own = {"covariance": self.covariance_, "degrees": self.degrees_}
        return super().fitted_arrays() | own

    def fitted_facts(self) -> dict[str, Any]:
        """Return the entries of a linear model, with the assumptions of the standard errors."""
        errors = self._std_error_facts()
        return super().fitted_facts() | {"std_error": errors, "poses": self.poses_}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Restore the fitted attributes from the output of `fitted_arrays` and `fitted_facts`."""
        super().restore(arrays, facts)
        self.covariance_, self.degrees_ = arrays["covariance"], arrays["degrees"]
        self.poses_ = int(facts["poses"])

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return the minimum data requirements: more poses than a regression has columns.

        Raises:
            FitError: `form: paper` does not support this robot.
        """
        form, terms = self._form_of(robot), len(self._own_terms())
        widest = len(form.names) + robot.n * terms
        if self.form == "paper":
            widest = terms + max(form.joint.count(joint) for joint in range(robot.n))
        return replace(super().needs(robot, loaded=loaded), least={"poses": widest + 1})

    def _std_error_facts(self) -> dict[str, Any]:
        return {"given": STD_ERROR_GIVEN, "leaves_out": STD_ERROR_LEAVES_OUT}

    def _enough_dwells(self, dataset: Dataset, robot: RobotModel) -> Dataset:
        """Return the dwells for the fit if there are enough poses; set counts and notes.

        Raises:
            FitError: There are not more poses than parameters of one regression, or
                `StaticModel._dwells` rejects the data.
        """
        dwells = self._dwells(dataset, robot)
        self.samples_ = len(dwells.conditions)
        self.poses_ = len(set(pose_numbers(dwells).tolist()))
        self.needs(robot).require(poses=self.poses_)
        self.notes_ = tuple(short_dwells(dwells))
        return dwells

    def _allocate(self) -> None:
        count, n = len(self.parameter_names_), len(self.joint_names_)
        self.coefficients_, self.degrees_ = np.zeros(count), np.full(count, np.nan)
        self.covariance_, self.sigma_ = np.zeros((count, count)), np.zeros(n)
        self.condition_, self.correlated_samples_ = 1.0, np.ones(n)

    def _require_excited(self, data: Dataset, cube: FloatArray) -> None:
        """Raise if a joint that affects gravity never moved, or if a column is constant."""
        turn, span = reach_of(self._form, data.n_joints)
        require_motion(data, np.flatnonzero(turn).tolist())
        change, names = np.ptp(cube, axis=0).max(axis=0), self.parameter_names_
        gravity = slice(0, len(span))
        require_varied(change[gravity], span, names[gravity])

    def _unit(self, joints: IntArray) -> FloatArray:
        """Return (k,) the torque per unit of the fitted target.

        If joints are fitted separately, the target is the effort; if they are fitted together, the
        target is the torque.
        """
        alone = self.form == "paper"
        return self.torque_scale_[joints] if alone else np.ones(len(joints))

    def _joint_groups(self) -> list[IntArray]:
        joints = np.arange(len(self.joint_names_))
        return list(joints[:, None]) if self.form == "paper" else [joints]

    def _columns_of(self, joints: IntArray) -> IntArray:
        """Return the ascending columns of the passed joints: gravity, then the joint terms."""
        gravity = [k for k, j in enumerate(self._form.joint) if j is None or j in joints]
        terms = len(self._own_terms())
        own = [self._offset_of(j) - terms + 1 + t for j in joints for t in range(terms)]
        return np.array([*gravity, *own], dtype=np.int64)

    def _offset_of(self, joint: int) -> int:
        """Return the index of a joint's offset among all parameters."""
        return len(self._form.names) + (joint + 1) * len(self._own_terms()) - 1


def deviation(residual: FloatArray, parameters: int) -> FloatArray:
    """Return (k,) the standard deviation of residuals (N, k) after a fit of `parameters`."""
    joints = residual.shape[1]
    degrees = max(len(residual) - parameters / joints, 1.0)
    found: FloatArray = np.sqrt(np.sum(residual**2, axis=0) / degrees)
    return found


class GravityForm(Protocol):
    """Interface of the columns whose linear combination is the gravity torque.

    Attributes:
        names: Names of the p columns.
        joint: Joint of each column, from 0; None if the columns affect all joints.
    """

    names: tuple[str, ...]
    joint: tuple[int | None, ...]

    def columns(self, q: FloatArray) -> FloatArray:
        """Return (N·n, p) the sample-major columns for positions (N, n)."""


class BaseGravity:
    """Gravity columns of the base parameters of the arm, which are identifiable first moments."""

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._base = base_parameters(robot, gravity_only=True)
        self.names = tuple(self._base.names)
        self.joint: tuple[int | None, ...] = (None,) * len(self.names)

    def columns(self, q: FloatArray) -> FloatArray:
        """Return (N·n, p) the sample-major columns for positions (N, n)."""
        reduced: FloatArray = self._base.reduce(self._robot.gravity_regressor(q))
        return reduced


UR_JOINTS = 6


class PaperGravity:
    """Gravity columns φ₂…φ₅ of eq. 15 of the static paper, for Universal Robots arms.

    The joint angles in eq. 15 are the joint angles of the arm. Joint 2 has six columns, joint 3
    three, joint 4 two and joint 5 one; joints 1 and 6 have no columns. For joint 2, four columns
    would be sufficient, because the six printed columns split two sums whose terms have equal
    coefficients.

    Raises:
        FitError: The robot does not have six joints, or its base is not level.
    """

    names = (
        *(f"joint2.phi{i}" for i in range(1, 7)),
        *(f"joint3.phi{i}" for i in range(1, 4)),
        *(f"joint4.phi{i}" for i in range(1, 3)),
        "joint5.phi1",
    )
    joint: tuple[int | None, ...] = (1, 1, 1, 1, 1, 1, 2, 2, 2, 3, 3, 4)

    def __init__(self, robot: RobotModel) -> None:
        if robot.n != UR_JOINTS:
            raise FitError(
                f"form: paper is for six-joint UR arms, but {robot.name} has {robot.n} joints",
                hint="use form: shared",
            )
        if np.any(robot.gravity_vector[:2]):
            raise FitError(
                "form: paper is for arms on a level base, but gravity is "
                f"{robot.gravity_vector.tolist()} m/s² in the base frame",
                hint="use form: shared",
            )

    def columns(self, q: FloatArray) -> FloatArray:
        """Return (6·N, 12) the sample-major columns; each function of eq. 15 is one column."""
        out = np.zeros((len(q), UR_JOINTS, len(self.names)))
        start = 0
        for joint, functions in enumerate(paper_functions(q), start=1):
            out[:, joint, start : start + functions.shape[1]] = functions
            start += functions.shape[1]
        return out.reshape(-1, len(self.names))


def paper_functions(q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return φ₂ (N, 6), φ₃ (N, 3), φ₄ (N, 2) and φ₅ (N, 1) of eq. 15 for positions (N, 6)."""
    q2, q3, q4, q5 = q[:, 1], q[:, 2], q[:, 3], q[:, 4]
    q23, q234 = q2 + q3, q2 + q3 + q4
    wrist = np.sin(q234), np.cos(q234) * np.sin(q5)
    phi2 = (
        np.cos(q23) * np.cos(q4) * np.sin(q5),
        np.cos(q23) * np.sin(q4),
        np.cos(q23),
        np.cos(q2),
        np.sin(q23) * np.sin(q4) * np.sin(q5),
        np.sin(q23) * np.cos(q4),
    )
    phi3 = (wrist[0], np.cos(q23), wrist[1])
    phi5 = (np.sin(q234) * np.cos(q5),)
    return (
        np.stack(phi2, axis=1),
        np.stack(phi3, axis=1),
        np.stack(wrist, axis=1),
        np.stack(phi5, axis=1),
    )


PROBES = 32
"""Number of random poses from which the dependence of gravity on each joint is computed."""


def reach_of(form: GravityForm, n_joints: int) -> tuple[BoolArray, FloatArray]:
    """Return the dependence of gravity on the joints, and the possible change of each column.

    Returns:
        Mask (n,) of the joints on which the columns depend, and largest change (p,) of each column.
    """
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (PROBES, n_joints))
    columns = form.columns(q)
    turned = [form.columns(q + step) for step in np.eye(n_joints)]
    depends = np.array([not np.allclose(columns, other) for other in turned])
    cube = columns.reshape(PROBES, n_joints, -1)
    return depends, np.asarray(np.ptp(cube, axis=0).max(axis=0))


def one_row_each(dwells: Dataset) -> Dataset:
    """Return the series with their samples averaged to one row, with temperatures."""
    columns = {"t": dwells["t"][dwells.offsets[:-1]]}
    for name in ("q", "effort", "temperature"):
        if name in dwells.columns:
            columns[name] = series_means(dwells, dwells[name])
    return replace(dwells, columns=columns, offsets=np.arange(len(dwells.conditions) + 1))


def pose_numbers(dwells: Dataset) -> IntArray:
    """Return (S,) the pose index of each series, from 0.

    A series without a pose gets a separate pose index.
    """
    known: dict[object, int] = {}
    groups = (group_of(condition, "pose") for condition in dwells.conditions)
    numbers = [known.setdefault(g or index, len(known)) for index, g in enumerate(groups)]
    return np.array(numbers, dtype=np.int64)


def scatter(dwells: Dataset) -> FloatArray:
    """Return (S, n) the variance of the effort about its mean in each series; 0 for one sample."""
    effort = dwells["effort"]
    about = effort - series_means(dwells, effort)[dwells.series_index()]
    degrees = np.maximum(np.diff(dwells.offsets) - 1, 1)
    sums = np.add.reduceat(about**2, dwells.offsets[:-1], axis=0)
    return np.asarray(sums / degrees[:, None])


def short_dwells(dwells: Dataset) -> Iterator[str]:
    """Yield a note if dwells have fewer samples than in the static paper."""
    counts = np.diff(dwells.offsets)
    short = counts[counts < SAMPLES_PER_DWELL]
    if len(short):
        yield (
            f"{len(short)} of {len(counts)} dwells have fewer than {SAMPLES_PER_DWELL} samples "
            f"(the shortest {short.min()}); each is used unchanged"
        )
