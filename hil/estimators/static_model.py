"""Linear models of an arm at rest: gravity, an offset per joint, and how sure their parameters are.

At rest, gravity is the motor's torque, φ_j·θ_j = K₂·i²·sign(i) + K₁·i + K₀ (static paper, eq. 18).
Gravity comes in two forms (`BaseGravity`, `PaperGravity`):

- `shared`: the arm's base gravity regressor, one set of parameters for all joints, plus one offset
  per joint, fitted to K·i. Needs the drive gains.
- `paper`: φ₂…φ₅ of eq. 15, one independent regression per joint plus an offset; needs no drive
  gains while nothing is mounted. Only for the six-joint arms of Universal Robots on a level base.

The column i²·sign(i) of eq. 20 is left out by default: it puts the target into its own regressor,
and a model that needs the current to predict the current predicts nothing. `current_term` adds it
to reproduce the paper's numbers, and the model then says so wherever it shows (`protocol`).

`StaticModel` is the base of all, with regressor, predictions and refusals; `StaticWls`
(`static-wls`) solves it by weighted least squares. `PoseClustered` is the base of those that report
how sure each parameter is, with standard errors clustered by pose. Friction at rest depends on how
the pose was approached and enters as noise; poses approached from both sides average it out. Every
dwell counts once: its ten samples are nearly one sample, and standard errors that counted all ten
would be three times too small. Models that know the approach are in
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
"""Component of a prediction that is made of what is to be predicted."""


class StaticModel(WlsEstimator):
    """Gravity and offset of an arm at rest, linear in the parameters.

    Divided by K₁ (eq. 19), eq. 18 is linear: with `current_term` joint j's regressor is
    R_j = [φ_j, i²·sign(i), 1] (eq. 20), and its last two coefficients are −K₂/K₁ and −K₀/K₁ after
    division by `torque_scale_[j]`.

    Attributes:
        form, current_term: Parameters, or constants of a subclass.
        parameter_names_: Gravity parameters, then per joint `offset`, or `current_squared` and
            `offset`.
        samples_: Number of dwells.
    """

    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("dwell",), ("trajectory",))
    tells_friction: ClassVar[bool] = False

    form: Form
    current_term: bool
    rest_speed: float = parameter(
        0.01,
        number,
        above=0.0,
        doc="Faster than this [rad/s] a row is not at rest and the model not valid.",
    )

    @property
    def protocol(self) -> str:
        """`honest`, or with `current_term` that the target is among the inputs."""
        return PAPER_PROTOCOL if self.current_term else HONEST

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what a fit cannot do without: as many dwells as parameters.

        Currents need no gains when every joint is on its own and nothing is mounted.

        Raises:
            FitError: `form: paper` does not support this robot.
        """
        return Needs(
            {"dwells": len(self._form_of(robot).names) + robot.n * len(self._own_terms())},
            gains=loaded or self.form != "paper",
            effort="current" if self.current_term else "",
        )

    def _dwells(self, dataset: Dataset, robot: RobotModel) -> Dataset:
        """The dwells to fit to, or the stays found in motions without a plan; sets the regressor.

        Raises:
            FitError: The data are not finite, of another robot or unit, or hold efforts that
                cannot be; or `current_term` meets efforts that are no currents.
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
        """Gravity, offset and payload per row, from the measured positions.

        Rows in motion are predicted too, but marked as not valid. With `current_term` the
        *measured* effort of the dataset is an input as well: such numbers reproduce the paper
        and say nothing about how well a current can be predicted.

        Raises:
            DataError: The data are of another robot or unit.
            FitError: A load is mounted, and the fit knew no drive gains.
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
        """A predictor for one sample at a time.

        Raises:
            FitError: With `current_term`, for want of the current that is to be predicted; or a
                load is mounted, and the fit knew no drive gains.
        """
        if self.current_term:
            raise FitError(
                "a model with current_term cannot be streamed: it needs the measured current to "
                f"predict the current ({self.protocol})",
                hint="fit without current_term",
            )
        self._require_gains(payload is not None and not payload.is_empty)
        return super().stream(payload)

    def _check_together(self) -> None:
        if self.current_term and self.form != "paper":
            raise SpecError(
                "current_term is eq. 20 of the paper and goes with form: paper only",
                hint="add form: paper, or leave current_term out",
            )

    def _require_effort(self, dataset: Dataset, needed: str) -> None:
        if needed and dataset.effort_kind != needed:
            raise FitError(
                f"current_term needs motor currents, the data hold a {dataset.effort_kind}",
                hint="fit without current_term, or on a recording of currents",
            )

    def _require_gains(self, loaded: bool) -> None:
        """A load adds a torque; without gains nobody knows how much current that is."""
        if loaded and not self.knows_gains:
            raise FitError(
                "a load is mounted, but the model was fitted to currents without drive gains",
                hint="fit again on data that say their drive gains",
            )

    def _open(self) -> None:
        self._form = self._form_of(self.robot_)
        own = (f"{joint}.{term}" for joint in self.joint_names_ for term in self._own_terms())
        self.parameter_names_ = (*self._form.names, *own)

    def _form_of(self, robot: RobotModel) -> GravityForm:
        return PaperGravity(robot) if self.form == "paper" else BaseGravity(robot)

    def _own_terms(self) -> tuple[str, ...]:
        """What every joint has for itself beside gravity, the offset last."""
        return ("current_squared", "offset") if self.current_term else ("offset",)

    def _observations(self, data: Dataset) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        q, still = data["q"], np.zeros_like(data["q"])
        load = payload_torque(self.robot_, data, q, still, still)
        own = {"current": signed_square(data["effort"])} if self.current_term else {}
        columns = joint_columns(own | {"offset": np.ones_like(q)})
        W = np.hstack([self._form.columns(q), columns])
        yield slice(0, len(data)), W, data["effort"] * self.torque_scale_ - load

    def _own_coefficients(self) -> FloatArray:
        """(n, k) of the k terms that every joint has for itself, the offset last."""
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
        """(N,) rows of dwells, and rows of motions in which every joint is slow enough."""
        kinds = np.array([c.kind in ("dwell", "reference") for c in dataset.conditions], dtype=bool)
        resting: BoolArray = kinds[dataset.series_index()]
        if "qd" in dataset.columns:
            resting = resting | (np.max(np.abs(dataset["qd"]), axis=1) < self.rest_speed)
        return resting


def signed_square(current: FloatArray) -> FloatArray:
    """i²·sign(i) of eq. 16, elementwise."""
    squared: FloatArray = current * np.abs(current)
    return squared


CURRENT_TERM = parameter(
    False, flag, doc="Only with `form: paper`: eq. 20 as printed, measured current included."
)


class StaticWls(StaticModel):
    """Gravity and offset of an arm at rest, weighted joint by joint."""

    estimator: ClassVar[str] = "static-wls"

    form: Form = parameter("shared", choice, ("shared", "paper"), doc="`shared` or `paper`.")
    weighted: bool = parameter(
        True,
        flag,
        doc="Weight the joints by their residual; makes no difference to `paper`, whose joints are "
        "independent.",
    )
    current_term: bool = CURRENT_TERM

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit to the dwells of the data, or to the stays found in motions without a plan.

        Raises:
            FitError: The data are too few, not finite, of another robot or unit, or do not
                excite all parameters; or `current_term` meets efforts that are no currents.
        """
        dwells = self._dwells(dataset, robot)
        self.samples_ = len(dwells.conditions)
        self.needs(robot).require(dwells=self.samples_)
        self._solve(one_row_each(dwells), weighted=self.weighted)
        return self


STD_ERROR_GIVEN = (
    "exact drive gains, declared loads, kinematics and form of the model; poses independent of "
    "each other, whatever the samples and dwells of one pose share (clustered by pose, CR2, "
    "Student's t with Satterthwaite's degrees of freedom)"
)

STD_ERROR_LEAVES_OUT = (
    "errors of the gains, loads and kinematics; gravity of another form; friction that depends on "
    "the pose and not on the approach; what all poses have in common, such as temperature"
)


class PoseClustered(StaticModel):
    """A static model solved joint by joint (`form: paper`) or for all joints at once (`shared`).

    Attributes:
        covariance_: (p, p) of the parameters, clustered by pose; 0 between regressions.
        degrees_: (p,) of Student's t for `interval`.
        poses_: Number of poses.
    """

    covariance_: FloatArray
    degrees_: FloatArray
    poses_: int

    def interval(self, level: float = 0.95) -> FloatArray:
        """(p, 2) in which each parameter lies with probability `level`; NaN if not told."""
        return interval(self.coefficients_, self.std_error_, self.degrees_, level)

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Parameters, their covariance, gains and residual deviations."""
        own = {"covariance": self.covariance_, "degrees": self.degrees_}
        return super().fitted_arrays() | own

    def fitted_facts(self) -> dict[str, Any]:
        """As of every linear model; what the standard errors are given, and the notes."""
        errors = self._std_error_facts()
        return super().fitted_facts() | {"std_error": errors, "poses": self.poses_}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        super().restore(arrays, facts)
        self.covariance_, self.degrees_ = arrays["covariance"], arrays["degrees"]
        self.poses_ = int(facts["poses"])

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what a fit cannot do without: a pose more than the widest regression has columns.

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
        """The dwells to fit to, if there are enough poses; sets what is known of them.

        Raises:
            FitError: There are fewer poses than parameters of one regression and one more, or see
                `StaticModel._dwells`.
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
        """Refuse joints that never moved though gravity depends on them, and constant columns."""
        turn, span = reach_of(self._form, data.n_joints)
        require_motion(data, np.flatnonzero(turn).tolist())
        change, names = np.ptp(cube, axis=0).max(axis=0), self.parameter_names_
        gravity = slice(0, len(span))
        require_varied(change[gravity], span, names[gravity])

    def _unit(self, joints: IntArray) -> FloatArray:
        """(k,) torque per unit in which the joints are fitted: their efforts, or torques."""
        alone = self.form == "paper"
        return self.torque_scale_[joints] if alone else np.ones(len(joints))

    def _joint_groups(self) -> list[IntArray]:
        joints = np.arange(len(self.joint_names_))
        return list(joints[:, None]) if self.form == "paper" else [joints]

    def _columns_of(self, joints: IntArray) -> IntArray:
        """Ascending: gravity columns of the joints, then what each has for itself."""
        gravity = [k for k, j in enumerate(self._form.joint) if j is None or j in joints]
        terms = len(self._own_terms())
        own = [self._offset_of(j) - terms + 1 + t for j in joints for t in range(terms)]
        return np.array([*gravity, *own], dtype=np.int64)

    def _offset_of(self, joint: int) -> int:
        """Column of a joint's offset among all parameters."""
        return len(self._form.names) + (joint + 1) * len(self._own_terms()) - 1


def deviation(residual: FloatArray, parameters: int) -> FloatArray:
    """(k,) standard deviation of residuals (N, k) that `parameters` fitted together."""
    joints = residual.shape[1]
    degrees = max(len(residual) - parameters / joints, 1.0)
    found: FloatArray = np.sqrt(np.sum(residual**2, axis=0) / degrees)
    return found


class GravityForm(Protocol):
    """Columns that gravity is a linear combination of.

    Attributes:
        names: Length p.
        joint: The joint, from 0, that a column belongs to alone; None for shared columns.
    """

    names: tuple[str, ...]
    joint: tuple[int | None, ...]

    def columns(self, q: FloatArray) -> FloatArray:
        """(N·n, p), sample-major, for positions (N, n)."""


class BaseGravity:
    """The arm's base gravity parameters: first moments that gravity can tell apart."""

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._base = base_parameters(robot, gravity_only=True)
        self.names = tuple(self._base.names)
        self.joint: tuple[int | None, ...] = (None,) * len(self.names)

    def columns(self, q: FloatArray) -> FloatArray:
        """(N·n, p), sample-major."""
        reduced: FloatArray = self._base.reduce(self._robot.gravity_regressor(q))
        return reduced


UR_JOINTS = 6


class PaperGravity:
    """φ₂…φ₅ of the static paper's eq. 15, for Universal Robots arms in their own joint angles.

    Six columns for joint 2, three for 3, two for 4, one for 5; joints 1 and 6 have none. Four
    would do for joint 2: the printed six split two sums whose parts have equal coefficients.

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
                f"the paper's form is for six-joint UR arms, {robot.name} has {robot.n} joints",
                hint="use form: shared",
            )
        if np.any(robot.gravity_vector[:2]):
            raise FitError(
                "the paper's form is for arms on a level base, but gravity is "
                f"{robot.gravity_vector.tolist()} m/s² in the base frame",
                hint="use form: shared",
            )

    def columns(self, q: FloatArray) -> FloatArray:
        """(6·N, 12), sample-major, each joint's functions in its own columns."""
        out = np.zeros((len(q), UR_JOINTS, len(self.names)))
        start = 0
        for joint, functions in enumerate(paper_functions(q), start=1):
            out[:, joint, start : start + functions.shape[1]] = functions
            start += functions.shape[1]
        return out.reshape(-1, len(self.names))


def paper_functions(q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Eq. 15: φ₂ (N, 6), φ₃ (N, 3), φ₄ (N, 2) and φ₅ (N, 1) for positions (N, 6)."""
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
"""Random poses that show which joints gravity depends on, and how far its columns can reach."""


def reach_of(form: GravityForm, n_joints: int) -> tuple[BoolArray, FloatArray]:
    """What there is to excite.

    Returns:
        (n,) which joints the columns depend on, and (p,) by how much each column can change.
    """
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (PROBES, n_joints))
    columns = form.columns(q)
    turned = [form.columns(q + step) for step in np.eye(n_joints)]
    depends = np.array([not np.allclose(columns, other) for other in turned])
    cube = columns.reshape(PROBES, n_joints, -1)
    return depends, np.asarray(np.ptp(cube, axis=0).max(axis=0))


def one_row_each(dwells: Dataset) -> Dataset:
    """The same series with their samples averaged to one row, temperatures too if measured."""
    columns = {"t": dwells["t"][dwells.offsets[:-1]]}
    for name in ("q", "effort", "temperature"):
        if name in dwells.columns:
            columns[name] = series_means(dwells, dwells[name])
    return replace(dwells, columns=columns, offsets=np.arange(len(dwells.conditions) + 1))


def pose_numbers(dwells: Dataset) -> IntArray:
    """(S,) pose of each series, numbered from 0; a series without a pose is one of its own."""
    known: dict[object, int] = {}
    groups = (group_of(condition, "pose") for condition in dwells.conditions)
    numbers = [known.setdefault(g or index, len(known)) for index, g in enumerate(groups)]
    return np.array(numbers, dtype=np.int64)


def scatter(dwells: Dataset) -> FloatArray:
    """(S, n) variance of each series' effort about its mean; 0 with a single sample."""
    effort = dwells["effort"]
    about = effort - series_means(dwells, effort)[dwells.series_index()]
    degrees = np.maximum(np.diff(dwells.offsets) - 1, 1)
    sums = np.add.reduceat(about**2, dwells.offsets[:-1], axis=0)
    return np.asarray(sums / degrees[:, None])


def short_dwells(dwells: Dataset) -> Iterator[str]:
    """A note when dwells have fewer samples than the static paper asks for."""
    counts = np.diff(dwells.offsets)
    short = counts[counts < SAMPLES_PER_DWELL]
    if len(short):
        yield (
            f"{len(short)} of {len(counts)} dwells have fewer than {SAMPLES_PER_DWELL} samples "
            f"(the shortest {short.min()}); each is used as it is"
        )
