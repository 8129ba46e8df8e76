"""Newton–Euler identification in coordinates that are physically consistent by construction.

The model is τ = Y_b(q, q̇, q̈)·B·φ(θ) + friction. θ are the log-Cholesky coordinates of the
pseudo-inertia of every link (Rucker & Wensing 2022). The coordinates of rotor inertias and friction
coefficients exclude negative values by construction, too. The shape parameters of the friction are
fitted together with the other parameters (`hil.estimators.diffnea_friction`). A weak Bregman
divergence (Lee, Wensing & Park 2020) keeps parameters that the data do not determine near the
nominal arm, so that link masses stay realistic.

Structure of the module, from the estimator inwards:

- `RigidDiffnea` is the estimator class. `DiffneaFit` is one fit in three steps: all parameters
  except the shapes; then shapes and all other parameters on a limited number of rows; then all
  parameters except the shapes on all rows.
- `DiffneaArm` computes regressor columns from the motion, and torques from the parameters.
- `Problem` is the cost function: weighted torque residuals plus the divergence from the nominal
  arm.
- `Unknowns` maps free coordinates to coefficients, with the exact Jacobian; `Bodies` is its part
  for links and rotors.
- `minimise` minimises the cost function by damped Newton steps. The regressor is computed a single
  time and compressed to one triangular factor; a step with exact derivatives then takes well under
  a millisecond.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.special import expit

from hil.arms import Payload
from hil.core import FloatArray
from hil.data import MOTION, Dataset, Stream
from hil.dynamics import (
    BaseParameters,
    RobotModel,
    body_parameters,
    coordinate_jacobian,
    from_coordinates,
    nearest_consistent,
    to_coordinates,
    triangle,
    triangle_jacobian,
)
from hil.estimators.base import chunks, payload_torque
from hil.estimators.checks import require_sizes
from hil.estimators.diffnea_friction import FORMS, ArmMotion, BendingRows, Form, sign_of, spread
from hil.estimators.friction_curve import FrictionCurve, curve_of
from hil.estimators.least_squares import (
    JointwiseQR,
    Solution,
    System,
    jointwise_least_squares,
    upper_triangle,
)
from hil.estimators.parameters import choice, number, parameter
from hil.estimators.rigid_linear import RigidLinear
from hil.estimators.streaming import DahlMemory, SampleStream

WELL_CONDITIONED = 1e7
"""Condition number of the column-scaled regressor up to which data determine all parameters."""

MASS_FACTOR = 5.0
"""Upper bound of the mass of a link, as a multiple of its nominal mass.

If the nominal mass is below a tenth of the mass of the arm, the multiple refers to this tenth
instead, because tools on small flanges are not always declared.
"""


class RigidDiffnea(RigidLinear):
    """Physically consistent rigid-body dynamics and friction, fitted by Gauss–Newton.

    Attributes:
        inertial_: (11n,) full inertial parameters in the order of
            `RobotModel.parameters(rotor=True)`, always physically consistent.
        parameter_names_: Names of base parameters, friction coefficients of each joint, then
            shapes.
        gear_rigid_: (b,) base parameters with which the torque through the gears was computed.
        coefficients_: Values of the parameters in `parameter_names_`; their standard errors come
            from the delta method.
    """

    estimator: ClassVar[str] = "rigid-diffnea"

    friction: str = parameter(
        "stribeck",
        choice,
        tuple(FORMS),
        doc="`coulomb-viscous`, `stribeck`, `stribeck-power` or `memory`, see "
        "`hil.estimators.diffnea_friction`.",
    )
    prior: float = parameter(
        1.0,
        number,
        above=0.0,
        doc="Weight of the nominal arm as prior: number of samples that one unit of Bregman "
        "divergence counts as.",
    )
    mass_factor: float = parameter(
        MASS_FACTOR,
        number,
        above=1.0,
        doc="Largest link mass as a multiple of the nominal mass (small links: of a tenth of the "
        "arm's mass), above 1.",
    )

    inertial_: FloatArray
    gear_rigid_: FloatArray

    def stream(self, payload: Payload | None = None) -> Stream:
        """Return a predictor for one sample at a time, with friction states if the law has any."""
        arm, values, mounted = self._arm, self.coefficients_, payload or Payload()
        if not arm.form.multiples:
            return super().stream(payload)

        def effort(
            q: FloatArray, qd: FloatArray, qdd: FloatArray, states: Mapping[float, FloatArray]
        ) -> FloatArray:
            load = np.zeros_like(q)
            if not mounted.is_empty:
                load = self.robot_.payload_effort(mounted, q, qd, qdd)
            transmitted = arm.rigid(self.gear_rigid_, q, qd, qdd) + load
            friction = arm.friction(arm.moment(qd, transmitted, states), values)
            return (arm.rigid(values, q, qd, qdd) + friction + load) / self.torque_scale_

        length = arm.friction_values(values)[1][:, 0]
        return SampleStream(self.robot_.n, DahlMemory(length, arm.form.multiples), effort)

    def friction_curve(self, qd: FloatArray) -> FrictionCurve | None:
        """Return the friction at velocities (N, n) [rad/s]; None for friction with memory."""
        form = self._arm.form
        if form.multiples:
            return None
        values, shapes = self._arm.friction_values(self.coefficients_)
        errors, of_shapes = self._arm.friction_values(self.std_error_)
        columns, slope = form.evaluate(self._arm.moment(qd), shapes)
        curve = curve_of(form.terms, columns, values, errors)
        bent = np.abs(np.einsum("Njks,jk->Njs", slope, values)) * of_shapes
        return replace(curve, std_error=curve.std_error + bent.sum(axis=-1))

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Return the arrays of a linear model, and the full inertial parameters."""
        own = {"inertial": self.inertial_, "gear_rigid": self.gear_rigid_}
        return super().fitted_arrays() | own

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Restore the fitted attributes from the output of `fitted_arrays` and `fitted_facts`."""
        super().restore(arrays, facts)
        self.inertial_, self.gear_rigid_ = arrays["inertial"], arrays["gear_rigid"]
        own = self.robot_.n * len(self._joint_terms())
        require_sizes(
            self,
            gear_rigid=self._base.rank,
            inertial=11 * self.robot_.n,
            coefficients=self._base.rank + own,
        )

    def _joint_terms(self) -> tuple[str, ...]:
        form = FORMS[self.friction]
        return (*form.terms, *(shape.name for shape in form.shapes))

    def _open(self) -> None:
        super()._open()
        form, joints = FORMS[self.friction], self.joint_names_
        self._arm = DiffneaArm(self.robot_, self._base, form, self.sign_width)
        terms = (f"{joint}.{term}" for joint in joints for term in form.terms)
        shapes = (f"{joint}.{shape.name}" for joint in joints for shape in form.shapes)
        self.parameter_names_ = (*self._base.names, *terms, *shapes)

    def _learn(self, data: Dataset) -> None:
        """Fit all parameters of the model in three steps.

        The first step fits all parameters except the shapes, which have their initial values. The
        second step fits the shapes of the friction on a limited number of rows. The third step fits
        all parameters except the shapes on all rows.
        """
        scale = np.ones((data.n_joints, len(self._arm.form.terms)))
        bodies, fold = Bodies.nominal(self.robot_, self.mass_factor), folding(self._base)
        unknowns = Unknowns(bodies, fold, self._arm.form, scale)
        self._start_from(unknowns.at(unknowns.start())[0])
        observed = self._compressed(data)
        fit = DiffneaFit.begun(unknowns, observed, self.prior)
        if self._arm.form.shapes:
            self._start_from(fit.values)
            fit = fit.bent(self._arm.bending_rows(data, self._target(data), self.gear_rigid_))
            self._start_from(fit.values)
            observed = self._compressed(data)
            fit = fit.finished(observed)
        self.inertial_ = fit.inertial
        self.notes_ = fit.notes(self.joint_names_)
        self._adopt(data, fit.solution(observed))

    def _start_from(self, values: FloatArray) -> None:
        """Set the parameter values at which the regressor columns are evaluated."""
        self.coefficients_, self.gear_rigid_ = values, values[: self._base.rank]

    def _estimate(self, observed: JointwiseQR) -> Solution:
        """Return the unconstrained least-squares solution with the same columns, for comparison."""
        return jointwise_least_squares(observed, weighted=True)

    def _adopt(self, data: Dataset, found: Solution) -> None:
        self.coefficients_, self.condition_ = found.coefficients, found.condition
        self.sigma_ = found.sigma / self.torque_scale_
        if found.condition > WELL_CONDITIONED:
            self.notes_ += (
                f"the data determine only {found.rank} directions of the parameters (condition "
                f"number {found.condition:.2g}); in all other directions the values are those of "
                "the nominal arm",
            )
        self._set_uncertainty(data, found)

    def _residual(self, data: Dataset, coefficients: FloatArray) -> FloatArray:
        # Columns of shapes are derivatives and do not contribute to the prediction.
        straight = np.array(coefficients)
        straight[len(straight) - len(self._arm.form.shapes) * data.n_joints :] = 0.0
        return super()._residual(data, straight)

    def _target(self, data: Dataset) -> FloatArray:
        return data["effort_f"] * self.torque_scale_ - self._arm.load(data)

    def _observations(self, data: Dataset) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        target = self._target(data)
        return self._arm.observations(data, target, self.coefficients_, self.gear_rigid_)

    def _all_parts(
        self, dataset: Dataset, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> dict[str, FloatArray]:
        motion = self._arm.motion(dataset, self.gear_rigid_)
        friction = self._arm.friction(motion, self.coefficients_)
        parts = super()._all_parts(dataset, q, qd, qdd)
        return {**parts, "friction": friction / self.torque_scale_}

    def _parts(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        values, still = self.coefficients_, np.zeros_like(q)
        gravity = self._arm.rigid(values, q, still, still)
        parts = {"gravity": gravity, "inertia": self._arm.rigid(values, q, qd, qdd) - gravity}
        if not self._arm.form.multiples:
            parts["friction"] = self._arm.friction(self._arm.moment(qd), values)
        return {name: part / self.torque_scale_ for name, part in parts.items()}


ROUNDS = 2
"""Number of fits of the friction shapes; the joint weights are updated after each fit."""

LEAST_NOISE = 1e-6
"""Lower bound of the residual standard deviation of a joint, as a share of its torque.

The lower bound of the standard deviation avoids a division by zero for exact data.
"""

USUAL_FRICTION = 0.1
"""Share of the torque of a joint that defines the scale of its friction coefficients."""


@dataclass(frozen=True, slots=True, eq=False)
class DiffneaFit:
    """State of a fit: cost function and current parameter coordinates.

    Attributes:
        problem: Cost function.
        u: (U,) free coordinates.
        floor: (n,) lower bound of the standard deviation of each joint [N·m].
        iterations: Number of Newton steps so far.
    """

    problem: Problem
    u: FloatArray
    floor: FloatArray
    iterations: int = 0

    @classmethod
    def begun(cls, unknowns: Unknowns, observed: JointwiseQR, prior: float) -> DiffneaFit:
        """Return the fit of all parameters except the shapes, starting from the nominal arm.

        The regressor columns of the observations are evaluated at the initial shapes. Joints are
        weighted by the residual of an unconstrained fit with equal weights.
        """
        torque = _torque(observed)
        unknowns = replace(unknowns, scale=_usual_scale(unknowns, observed, torque))
        plain = jointwise_least_squares(observed, weighted=False)
        floor = np.maximum(LEAST_NOISE * torque, 1e-12)
        problem = Problem(unknowns, np.maximum(plain.sigma, floor), prior)
        return cls(problem, unknowns.start(), floor).finished(observed)

    def bent(self, rows: BendingRows) -> DiffneaFit:
        """Return the fit of all parameters including the shapes, with updated joint weights."""
        fit = self
        for _ in range(ROUNDS):
            found = fit.problem.bending(rows, fit.u)
            sigma = np.maximum(rows.deviation(fit.problem.unknowns.at(found.u)[0]), self.floor)
            problem = replace(fit.problem, sigma=sigma)
            fit = replace(
                fit, problem=problem, u=found.u, iterations=fit.iterations + found.iterations
            )
        return fit

    def finished(self, observed: JointwiseQR) -> DiffneaFit:
        """Return the fit of all parameters except the shapes on all observations."""
        found = self.problem.frozen(observed.system(), self.u)
        return replace(self, u=found.u, iterations=self.iterations + found.iterations)

    @property
    def values(self) -> FloatArray:
        """Vector of the base parameters, friction coefficients and shapes."""
        return self.problem.unknowns.at(self.u)[0]

    @property
    def inertial(self) -> FloatArray:
        """Full inertial parameters (11n,)."""
        return self.problem.unknowns.bodies.parameters(self.u)

    def notes(self, joints: tuple[str, ...]) -> tuple[str, ...]:
        """Return notes on the parameters that reached a bound."""
        return self.problem.unknowns.notes(self.u, joints)

    def solution(self, observed: JointwiseQR) -> Solution:
        """Return the least-squares solution, with the data for its standard errors."""
        return self.problem.solution(self.u, observed)


def _torque(observed: JointwiseQR) -> FloatArray:
    """Return (n,) the root mean square of each joint's target [N·m]."""
    _, y, joint = observed.system()
    squares = np.bincount(joint, y**2, minlength=len(observed.rows))
    return np.asarray(np.sqrt(squares / np.maximum(observed.rows, 1)))


def _usual_scale(unknowns: Unknowns, observed: JointwiseQR, torque: FloatArray) -> FloatArray:
    """Return (n, k) the scales of the friction coefficients.

    A friction coefficient equal to its scale produces the share `USUAL_FRICTION` of the torque of
    the joint.
    """
    X, _, joint = observed.system()
    n, k = unknowns.scale.shape
    first = unknowns.counts[0]
    scale = np.ones((n, k))
    for j in range(n):
        own = X[joint == j, first + j * k : first + (j + 1) * k]
        size = np.linalg.norm(own, axis=0) / np.sqrt(max(int(observed.rows[j]), 1))
        usual = USUAL_FRICTION * max(torque[j], 1e-9)
        scale[j] = usual / np.where(size > 0, np.maximum(size, 1e-3), 1.0)
    return scale


MOST_ROWS = 10_000
"""Largest number of rows used to fit the shapes; longer recordings are sampled evenly."""


@dataclass(frozen=True, slots=True, eq=False)
class DiffneaArm:
    """Computation of regressor columns from a motion, and of torques from parameters.

    Attributes:
        robot: Nominal robot model.
        base: Base parameters of the robot.
        form: Friction law of every joint.
        width: Width of the smoothed sign function [rad/s].
    """

    robot: RobotModel
    base: BaseParameters
    form: Form
    width: float

    def friction_values(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the friction coefficients (n, k) and the shapes (n, S) of all joints."""
        n, k = self.robot.n, len(self.form.terms)
        own = values[self.base.rank :]
        return own[: n * k].reshape(n, k), own[n * k :].reshape(n, -1)

    def rigid_rows(self, data: Dataset) -> Iterator[tuple[slice, FloatArray]]:
        """Yield row ranges with their base regressor (N·n, b), in the order of time."""
        for rows in chunks(data):
            yield rows, self.base.regressor(self.robot, *(data[name][rows] for name in MOTION))

    def load(self, data: Dataset) -> FloatArray:
        """Return (N, n) the torque of the payloads [N·m]."""
        return payload_torque(self.robot, data, *(data[name] for name in MOTION))

    def motion(self, data: Dataset, gear: FloatArray) -> ArmMotion:
        """Return the inputs of the friction law for a dataset.

        The torque through the gears is computed with the base parameters `gear` (b,).
        """
        transmitted = np.zeros_like(data["q_f"])
        if self.form.multiples:
            transmitted = self.load(data)
            for rows, Y in self.rigid_rows(data):
                transmitted[rows] += (Y @ gear).reshape(-1, self.robot.n)
        return ArmMotion.of(data, transmitted, self.width)

    def moment(
        self,
        qd: FloatArray,
        transmitted: FloatArray | None = None,
        states: Mapping[float, FloatArray] | None = None,
    ) -> ArmMotion:
        """Return the inputs of the friction law for single samples (N, n).

        The single samples do not form a path; friction states are passed if the friction law has
        memory.
        """
        still = np.zeros_like(qd)
        load = still if transmitted is None else transmitted
        return ArmMotion(qd, sign_of(qd, self.width), load, still, (), states or {})

    def observations(
        self, data: Dataset, target: FloatArray, values: FloatArray, gear: FloatArray
    ) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        """Yield row range, regressor (N·n, b + nk + nS) and target torques (N, n), in time order.

        The regressor is [Y | C | ∂C/∂s·c].
        """
        c, shapes = self.friction_values(values)
        C, slope = self.form.evaluate(self.motion(data, gear), shapes)
        bent = np.einsum("Njks,jk->Njs", slope, c)
        for rows, Y in self.rigid_rows(data):
            yield rows, np.hstack([Y, spread(C[rows]), spread(bent[rows])]), target[rows]

    def bending_rows(self, data: Dataset, target: FloatArray, gear: FloatArray) -> BendingRows:
        """Return a limited number of rows, on which the shapes are fitted."""
        every = -(-len(data) // MOST_ROWS)
        shape = (-1, self.robot.n, self.base.rank)
        parts = [
            Y.reshape(shape)[-rows.start % every :: every] for rows, Y in self.rigid_rows(data)
        ]
        motion = self.motion(data, gear)
        return BendingRows(np.concatenate(parts), target[::every], motion, self.form, every)

    def friction(self, motion: ArmMotion, values: FloatArray) -> FloatArray:
        """Return (N, n) the friction torque [N·m]."""
        c, shapes = self.friction_values(values)
        return np.asarray(np.einsum("Njk,jk->Nj", self.form.evaluate(motion, shapes)[0], c))

    def rigid(self, values: FloatArray, *motion: FloatArray) -> FloatArray:
        """Return (N, n) the rigid-body torque of a motion q, q̇, q̈ [N·m]."""
        torque = self.base.regressor(self.robot, *motion) @ values[: self.base.rank]
        return np.asarray(torque).reshape(motion[0].shape)


class Local(NamedTuple):
    """Quadratic approximation of a cost function at a point.

    Attributes:
        cost: Value of the cost function.
        gradient: (U,) gradient.
        curvature: (U, U) positive semidefinite curvature matrix of Gauss–Newton type.
    """

    cost: float
    gradient: FloatArray
    curvature: FloatArray


Cost = Callable[[FloatArray], Local]

Observed = Callable[[FloatArray], System]
"""Function that maps parameter values to an equivalent small system with columns of shapes."""

BENT_ENOUGH = 1e-6
"""Relative decrease of the cost below which the fit of the shapes ends."""


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Cost function Σⱼ |rⱼ|²/σⱼ² + prior · divergence from the nominal arm.

    Attributes:
        unknowns: Map from free coordinates to parameter values.
        sigma: (n,) assumed standard deviation of each joint [N·m].
        prior: Number of samples that one unit of divergence counts as.
    """

    unknowns: Unknowns
    sigma: FloatArray
    prior: float

    def frozen(self, system: System, start: FloatArray) -> Minimum:
        """Return the coordinates of minimum cost at constant shapes, for all rows."""
        X, y, joint = system
        linear = self.unknowns.linear
        weighted = np.column_stack([X[:, :linear], y]) / self.sigma[joint, None]
        R = upper_triangle(weighted)
        moved = start.size - self.unknowns.counts[2]

        def cost(moving: FloatArray) -> Local:
            u = np.concatenate([moving, start[moved:]])
            values, slope = self.unknowns.at(u)
            r = R[:, :-1] @ values[:linear] - R[:, -1]
            return _cut(self._local(u, r, R[:, :-1] @ slope[:linear]), moved)

        found = minimise(cost, start[:moved])
        return replace(found, u=np.concatenate([found.u, start[moved:]]))

    def bending(self, observed: Observed, start: FloatArray) -> Minimum:
        """Return the coordinates of minimum cost over all parameters, including the shapes.

        The friction columns of the regressor are evaluated again at every step.
        """
        return minimise(self.bending_cost(observed), start, tolerance=BENT_ENOUGH)

    def bending_cost(self, observed: Observed) -> Cost:
        """Return the cost as a function of all coordinates, including the shapes."""
        linear = self.unknowns.linear

        def cost(u: FloatArray) -> Local:
            values, slope = self.unknowns.at(u)
            X, y, joint = observed(values)
            root = 1.0 / self.sigma[joint]
            r = root * (X[:, :linear] @ values[:linear] - y)
            return self._local(u, r, root[:, None] * (X @ slope))

        return cost

    def solution(self, u: FloatArray, observed: JointwiseQR) -> Solution:
        """Return the parameter values at u and their covariance, by the delta method.

        With D the Jacobian of the parameter values and H half the curvature, D H⁻¹ Dᵀ replaces
        (XᵀWX)⁻¹.
        """
        values, slope = self.unknowns.at(u)
        system = X, _, joint = observed.system()
        weight = 1.0 / self.sigma**2
        scaled = X * np.sqrt(weight)[joint, None]
        H = 0.5 * self._local(u, np.zeros(len(X)), scaled @ slope).curvature
        length = np.sqrt(np.diag(H))
        length[length == 0] = 1.0
        inverse = np.linalg.pinv(H / np.outer(length, length), rcond=1e-13, hermitian=True)
        to = slope / length
        linear = self.unknowns.linear
        straight = np.concatenate([values[:linear], np.zeros(len(values) - linear)])
        rank, condition = _excited(scaled[:, :linear])
        sigma = observed.residual_std(straight)
        return Solution(values, sigma, weight, to @ inverse @ to.T, rank, condition, system)

    def _local(self, u: FloatArray, r: FloatArray, J: FloatArray) -> Local:
        away, pull = self.unknowns.divergence(u), self.prior
        return Local(
            float(r @ r) + pull * away.cost,
            2.0 * J.T @ r + pull * away.gradient,
            2.0 * J.T @ J + pull * away.curvature,
        )


def _cut(local: Local, moved: int) -> Local:
    """Return the quadratic approximation restricted to the first `moved` coordinates."""
    return Local(local.cost, local.gradient[:moved], local.curvature[:moved, :moved])


def _excited(X: FloatArray) -> tuple[int, float]:
    """Return rank and condition number of X (m, p) with columns scaled to length 1."""
    length = np.linalg.norm(X, axis=0)
    singular = np.linalg.svd(X / np.where(length > 0, length, 1.0), compute_uv=False)
    kept = singular > 1e-9 * singular[0]
    return int(kept.sum()), float(singular[0] / singular[-1]) if singular[-1] > 0 else np.inf


SHAPE_EDGE = 0.01
"""Distance from a bound below which a shape counts as at the bound, as a share of its log range."""

AT_ZERO = 1e-3
"""Relative size of a friction coefficient below which the coefficient counts as 0.

The size is relative to the scale of the coefficient.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """Map from free coordinates u to parameter values.

    The coordinates are those of links and rotors (`Bodies`), followed by the friction coefficients
    of every joint, followed by the shapes of every joint. A non-negative coefficient is softplus(u)
    times a scale. A shape is mapped between its bounds by a logistic function. The values are base
    parameters, friction coefficients and shapes, joint by joint.

    Attributes:
        bodies: Links and rotors.
        fold: (b, 11n) matrix from full to base parameters.
        form: Friction law of every joint.
        scale: (n, k) scales of the friction coefficients, in their units.
    """

    bodies: Bodies
    fold: FloatArray
    form: Form
    scale: FloatArray

    @property
    def counts(self) -> tuple[int, int, int]:
        """Sizes: number of base parameters b, of friction coefficients n·k and of shapes n·s."""
        return len(self.fold), self.scale.size, len(self.scale) * len(self.form.shapes)

    @property
    def linear(self) -> int:
        """Number of those parameter values that are regressor coefficients."""
        return len(self.fold) + self.scale.size

    def start(self) -> FloatArray:
        """Return the coordinates of the nominal arm with typical friction coefficients."""
        friction = np.where(self.form.nonnegative, np.log(np.expm1(1.0)), 0.0)
        shapes = [np.log(s.start / s.low) / np.log(s.high / s.low) for s in self.form.shapes]
        middle = np.log(np.array(shapes) / (1.0 - np.array(shapes)))
        n = len(self.scale)
        return np.concatenate([self.bodies.start, np.tile(friction, n), np.tile(middle, n)])

    def at(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the parameter values (b + nk + ns,) and their Jacobian (b + nk + ns, U)."""
        b, nk, ns = self.counts
        inner = self.fold.shape[1]
        slope = np.zeros((b + nk + ns, inner + nk + ns))
        slope[:b, :inner] = self.fold @ self.bodies.jacobian(u)
        friction, friction_slope = self._friction(u[inner : inner + nk])
        shapes, shapes_slope = self._shapes(u[inner + nk :])
        diagonal = np.concatenate([friction_slope, shapes_slope])
        slope[np.arange(b, b + nk + ns), np.arange(inner, inner + nk + ns)] = diagonal
        base = self.fold @ self.bodies.parameters(u)
        return np.concatenate([base, friction, shapes]), slope

    def divergence(self, u: FloatArray) -> Local:
        """Return the divergence of links, rotors and friction from their nominal values.

        A non-negative friction coefficient is treated as a 1×1 pseudo-inertia.
        """
        inner, nk = self.fold.shape[1], self.scale.size
        bodies = self.bodies.divergence(u[:inner])
        x, bounded = u[inner : inner + nk], np.tile(self.form.nonnegative, len(self.scale))
        ratio = np.where(bounded, np.logaddexp(0.0, x), 1.0)
        slope = np.where(bounded, expit(x), 0.0) / ratio
        gradient, curvature = np.zeros(len(u)), np.zeros((len(u), len(u)))
        gradient[:inner], curvature[:inner, :inner] = bodies.gradient, bodies.curvature
        own = np.arange(inner, inner + nk)
        gradient[own], curvature[own, own] = slope * (ratio - 1.0), slope**2
        friction = float(np.sum(ratio - np.log(ratio) - 1.0))
        return Local(bodies.cost + friction, gradient, curvature)

    def notes(self, u: FloatArray, joints: tuple[str, ...]) -> tuple[str, ...]:
        """Return notes for the user on the parameters that reached a bound."""
        _, nk, ns = self.counts
        values = self.at(u)[0]
        k, terms = len(self.form.terms), self.form.terms
        share = (values[self.linear - nk : self.linear].reshape(-1, k) / self.scale) < AT_ZERO
        zero = np.argwhere(share & self.form.nonnegative)
        found = [f"{joints[j]}.{terms[i]} is at its bound 0" for j, i in zip(*zero.T, strict=True)]
        place = expit(u[len(u) - ns :]).reshape(len(joints), -1)
        for j, i in np.argwhere((place < SHAPE_EDGE) | (place > 1.0 - SHAPE_EDGE)):
            shape = self.form.shapes[i]
            bound = shape.low if place[j, i] < 0.5 else shape.high
            found.append(f"{joints[j]}.{shape.name} is at its bound {bound:g}")
        return tuple(found)

    def _friction(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        scale, bounded = self.scale.ravel(), np.tile(self.form.nonnegative, len(self.scale))
        value = np.where(bounded, np.logaddexp(0.0, x), x)
        return scale * value, scale * np.where(bounded, expit(x), 1.0)

    def _shapes(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        n = len(self.scale)
        low = np.tile([s.low for s in self.form.shapes], n)
        width = np.tile([np.log(s.high / s.low) for s in self.form.shapes], n)
        place = expit(x)
        value = low * np.exp(width * place)
        return value, value * width * place * (1.0 - place)


def folding(base: BaseParameters) -> FloatArray:
    """Return the (b, p) matrix that maps full parameters to base parameters."""
    fold = np.zeros((base.rank, len(base.independent) + len(base.dependent)))
    fold[np.arange(base.rank), base.independent] = 1.0
    fold[:, base.dependent] = base.combination
    return fold


LEAST_SHARE = 1e-6
"""Minimum relative eigenvalue of a nominal pseudo-inertia; lower eigenvalues are raised to it."""

ROTOR_SHARE = 0.3
"""Initial rotor inertia, if unknown, as a share of the inertia that its joint drives."""

LIGHT = 0.1
"""Share of the arm's mass that replaces smaller link masses in the mass bound."""


@dataclass(frozen=True, slots=True, eq=False)
class Bodies:
    """Links and rotors of an arm in free coordinates, and their divergence from the nominal arm.

    The coordinates are the log-Cholesky coordinates of every link (10 each) and the logarithm of
    every rotor inertia divided by its initial value. The divergence is the Bregman divergence of
    −log det for each link, tr(J₀⁻¹J) − log det(J₀⁻¹J) − 4. A rotor inertia is treated as a 1×1
    pseudo-inertia with the same divergence. The divergence is convex in the inertial parameters.
    The curvature tr(J⁻¹dJ J⁻¹dJ) of the divergence, transformed to the coordinates, is positive
    semidefinite. The transformation omits the product of the gradient with the second derivative of
    the coordinates; at the minimum, the total gradient is zero.

    Attributes:
        theta: (n, 10) log-Cholesky coordinates of the nominal links.
        rotor: (n,) nominal or guessed rotor inertias [kg·m²].
        mass_factor: Upper bound of each link mass, as a multiple (above 1) of the nominal mass. The
            mass coordinate is α = α₀ + h·tanh((u − α₀)/h), with h half the logarithm of the largest
            ratio of mass to nominal mass.
    """

    theta: FloatArray
    rotor: FloatArray
    mass_factor: float = MASS_FACTOR

    @classmethod
    def nominal(cls, robot: RobotModel, mass_factor: float = MASS_FACTOR) -> Bodies:
        """Return the bodies of a robot model, with inconsistent links made consistent."""
        links = robot.parameters(rotor=False).reshape(robot.n, -1)
        links = np.where(links[:, :1] > 0, links, _unknown_link())
        known = np.asarray(robot.rotor_inertia)
        rotor = np.where(known > 0, known, ROTOR_SHARE * _driven_inertia(robot))
        return cls(to_coordinates(nearest_consistent(links, LEAST_SHARE)), rotor, mass_factor)

    @property
    def start(self) -> FloatArray:
        """Coordinates (11n,) of the nominal arm."""
        return np.concatenate([self.theta.ravel(), np.zeros(len(self.rotor))])

    def parameters(self, u: FloatArray) -> FloatArray:
        """Return (11n,) the inertial parameters, ordered as `RobotModel.parameters(rotor=True)`."""
        theta, log_rotor, _ = self._split(u)
        return np.concatenate([from_coordinates(theta).ravel(), self.rotor * np.exp(log_rotor)])

    def jacobian(self, u: FloatArray) -> FloatArray:
        """Return (11n, 11n) the Jacobian ∂parameters/∂u."""
        theta, log_rotor, bent = self._split(u)
        return _blocks(coordinate_jacobian(theta) * bent[:, None], self.rotor * np.exp(log_rotor))

    def divergence(self, u: FloatArray) -> Local:
        """Return the divergence from the nominal arm as a function of the coordinates (11n,)."""
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
        """Return the sum of the link divergences and its gradient.

        The divergence of a link is |W|² − 2 Σ log Wᵢᵢ − 4 with W = U₀⁻¹U.
        """
        back = np.linalg.inv(triangle(self.theta))
        W, dW = back @ U, back[:, None] @ slope
        diagonal = np.diagonal(W, axis1=-2, axis2=-1)
        value = np.sum(W**2) - 2.0 * np.sum(np.log(diagonal)) - 4.0 * len(W)
        bent = np.diagonal(dW, axis1=-2, axis2=-1) / diagonal[:, None]
        gradient = 2.0 * np.einsum("lij,lkij->lk", W, dW) - 2.0 * np.sum(bent, axis=-1)
        return float(value), gradient

    def _split(self, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return θ (n, 10), the logarithms (n,) of the rotors and the diagonal of ∂θ/∂u (n, 10)."""
        n, middle = len(self.rotor), self.theta[:, 0]
        mass = np.exp(2.0 * middle)
        half = 0.5 * np.log(self.mass_factor * np.maximum(1.0, LIGHT * mass.sum() / mass))
        theta = u[: 10 * n].reshape(n, 10).copy()
        share = np.tanh((theta[:, 0] - middle) / half)
        bent = np.ones_like(theta)
        theta[:, 0], bent[:, 0] = middle + half * share, 1.0 - share**2
        return theta, u[10 * n : 11 * n], bent


def _blocks(links: FloatArray, rotors: FloatArray) -> FloatArray:
    """Return the (11n, 11n) block-diagonal matrix of links (n, 10, 10) and rotors (n,)."""
    n = len(rotors)
    full = np.zeros((11 * n, 11 * n))
    for i, block in enumerate(links):
        full[10 * i : 10 * i + 10, 10 * i : 10 * i + 10] = block
    full[np.arange(10 * n, 11 * n), np.arange(10 * n, 11 * n)] = rotors
    return full


def _driven_inertia(robot: RobotModel) -> FloatArray:
    """Return (n,) the inertia that each joint accelerates, averaged over the workspace [kg·m²]."""
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (50, robot.n))
    mean = np.mean(np.diagonal(robot.mass_matrix(q), axis1=1, axis2=2), axis=0)
    return np.asarray(np.maximum(mean, 1e-3))


def _unknown_link() -> FloatArray:
    """Return the default link without model data: 1 kg with a radius of gyration of 0.1 m."""
    return body_parameters(1.0, (0.0, 0.0, 0.0), 0.01 * np.eye(3))


FIRST_DAMPING, MOST_DAMPING = 1e-3, 1e16

LITTLE_DAMPING = 1e-2
"""Largest damping at which an accepted step may end the minimisation as converged."""

LONGEST_STEP = 3.0
"""Largest change of any coordinate in one step.

Because the coordinates are logarithms and ratios, larger steps would only cause overflow.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Result of a minimisation.

    Attributes:
        u: (U,) coordinates of the minimum.
        cost: Value of the cost function at the minimum.
        iterations: Number of steps tried, accepted or rejected.
        converged: False if the step limit or the damping limit was reached first.
    """

    u: FloatArray
    cost: float
    iterations: int
    converged: bool


def minimise(
    cost: Cost, start: FloatArray, *, iterations: int = 300, tolerance: float = 1e-10
) -> Minimum:
    """Return the minimum of a cost function, by Levenberg–Marquardt iterations.

    The damping follows the ratio of actual and predicted decrease (Nielsen 1999, as in Madsen,
    Nielsen & Tingleff, 'Methods for non-linear least squares problems', 2004, algorithm 3.16). The
    damping is scaled by the largest diagonal of the curvature so far (Moré 1978), because the
    curvature of a coordinate vanishes near its bound. The iteration ends if a step predicts a cost
    decrease below `tolerance` times the cost.

    With the same cost as residuals, including the roots of the divergence,
    `scipy.optimize.least_squares` needs more than the 300 allowed steps and 4 to 25 times the time,
    because the roots have poor curvature. For a cold start, the SciPy method `trust-exact` ends at
    a cost 7 to 35 % higher.
    """
    u = np.array(start, dtype=np.float64)
    here, damping, growth = cost(u), FIRST_DAMPING, 2.0
    scale = np.zeros(len(u))
    for count in range(1, iterations + 1):
        scale = np.maximum(scale, np.diag(here.curvature))
        step = _damped_step(here, damping * np.where(scale > 0, scale, 1.0))
        if step is not None:
            promised = -float(step @ (here.gradient + 0.5 * here.curvature @ step))
            if promised <= tolerance * here.cost and damping <= LITTLE_DAMPING:
                return Minimum(u, here.cost, count, True)
            there = cost(u + step)
            if there.cost < here.cost:
                gain = (here.cost - there.cost) / promised
                u, here, growth = u + step, there, 2.0
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
                continue
        damping, growth = damping * growth, 2.0 * growth
        if damping > MOST_DAMPING:
            return Minimum(u, here.cost, count, False)
    return Minimum(u, here.cost, iterations, False)


def _damped_step(here: Local, damping: FloatArray) -> FloatArray | None:
    """Return the damped step; None if the matrix is not definite or the step is too long."""
    try:
        factor = cho_factor(here.curvature + np.diag(damping), check_finite=False)
    except LinAlgError:
        return None
    step: FloatArray = -cho_solve(factor, here.gradient, check_finite=False)
    return step if np.all(np.abs(step) <= LONGEST_STEP) else None
