"""Rigid-body models that are linear in base parameters and friction.

The regressor consists of the base regressor of the arm (including rotor inertias) and three
friction columns per joint, tanh(qd/width), qd and 1. The target is K·i. `RigidLinear` contains the
common parts of all methods: subtraction of declared payloads, filtering, and prediction. The
subclass of a method overrides one step: `_estimate` computes coefficients from compressed
observations, or `_learn` if the method needs every sample.

- `RigidWls` (`rigid-wls`) computes ordinary least squares, followed by least squares with every
  joint weighted by the reciprocal variance of its residual (Jubien, Gautier & Janot 2014, "Method
  1" of the PINN paper). Reference results on the UR10e recordings of Mamedov & Mikhel use the
  filters of `hil.data.filters`, the drive gains of the literature and a width of 0.01 rad/s. For
  the UR10e, training on 30s12h + 40s12h + 50s12h + 20s8h gives an RMSE on the whole of 14h50 of
  .234 .327 .172 .045 .052 .040 A raw (mean .1450) and .1145 A against the filtered current.
  Training on 30s12h alone gives a mean RMSE of .1485 with tanh and of .1642 with the discontinuous
  sign.
- `RigidClassical` adds features for the comparison of methods: standard errors for correlated
  samples, friction columns filtered like the effort, and a report on the excitation.
  `RigidClassical` is also the base of `rigid-lmi` and `rigid-irls`.
- `RigidLeastSquares` (`rigid-linear`) fits by OLS, WLS, ridge or total least squares under equal
  conditions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, ClassVar, Literal, Self

import numpy as np

from hil.core import BoolArray, FitError, FloatArray, IntArray, SpecError
from hil.data import (
    MOTION,
    Conditions,
    Dataset,
    FilterSettings,
    Group,
    Prediction,
    SeriesKind,
    downsample,
    filter_columns,
    group_of,
)
from hil.dynamics import BaseParameters, RobotModel, base_parameters, friction_terms, joint_columns
from hil.estimators.base import WlsEstimator, chunks, payload_torque, prepared, training_rows
from hil.estimators.checks import (
    Needs,
    require_clean,
    require_motion,
    require_plausible,
    require_robot,
    torque_scale,
)
from hil.estimators.covariance import (
    Scores,
    correlated_samples,
    hac_covariance,
    hac_window,
    interval,
    trajectory_covariance,
)
from hil.estimators.friction_curve import FrictionCurve, curve_of
from hil.estimators.identifiability import condition_report, essential_parameters
from hil.estimators.least_squares import (
    JointwiseQR,
    Solution,
    jointwise_least_squares,
    left_out_ridge,
    ridge,
    rough,
    total_least_squares,
)
from hil.estimators.parameters import choice, flag, number, parameter, settings

TERMS = ("coulomb", "viscous", "offset")
"""Names of the friction columns of each joint."""


SIGN_WIDTH = parameter(
    0.01,
    number,
    at_least=0.0,
    doc="Width of the tanh that approximates sign(qd) [rad/s]; 0 for the exact sign.",
)
FILTERS = parameter(
    None,
    settings,
    FilterSettings,
    doc="Preprocessing for training and prediction: a `FilterSettings` object or its dict.",
)


class RigidLinear(WlsEstimator):
    """Base class of estimators of base rigid-body parameters and Coulomb–viscous friction.

    Attributes:
        parameter_names_: Base parameters, followed by `coulomb`, `viscous`, `offset` of each joint.
    """

    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",), ("move",))

    sign_width: float = SIGN_WIDTH
    filters: FilterSettings = FILTERS

    def _estimate(self, observed: JointwiseQR) -> Solution:
        """Return the coefficients from compressed observations; subclasses override this step."""
        return jointwise_least_squares(observed, weighted=True)

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return the minimum data requirements: as many samples as parameters, and drive gains."""
        links = base_parameters(robot, rotor=True).rank
        return Needs({"samples": links + robot.n * len(self._joint_terms())}, gains=True)

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit the model to all series; the torques of declared payloads are subtracted.

        Raises:
            FitError: The data are too few, not finite, or are of a different robot or unit, contain
                impossible efforts, or do not excite all parameters.
            DataError: A series cannot be filtered.
        """
        require_robot(dataset, robot)
        self._remember(dataset, robot, torque_scale(dataset))
        require_clean(dataset, ("t", "q", "effort"))
        require_plausible(dataset, robot)
        self._open()
        self.needs(robot).require(samples=len(dataset))
        require_motion(dataset)
        data = self._training_rows(dataset)
        self.samples_ = len(data)
        self._learn(data)
        return self

    def predict(self, dataset: Dataset) -> Prediction:
        """Return the effort of every row from the filtered motion, and its physical components.

        Raises:
            DataError: The data are of a different robot or unit, or cannot be filtered.
        """
        self.require_match(dataset)
        data = prepared(dataset, self.filters)
        return self._predict(data, *(data[name] for name in MOTION))

    def friction_curve(self, qd: FloatArray) -> FrictionCurve | None:
        """Return the friction torque at velocities (N, n) [rad/s]."""
        columns = np.stack(list(self._friction(qd).values()), axis=-1)
        of_joints = (-1, len(TERMS))
        values, errors = (
            every[-len(TERMS) * qd.shape[1] :].reshape(of_joints)
            for every in (self.coefficients_, self.std_error_)
        )
        return curve_of(TERMS, columns, values, errors)

    def _training_rows(self, dataset: Dataset) -> Dataset:
        """Return the prepared rows for the fit, down-sampled as the filter settings require."""
        return training_rows(dataset, self.filters)

    def _learn(self, data: Dataset) -> None:
        """Fit the model to prepared data, and set the fitted attributes."""
        self._adopt(data, self._estimate(self._compressed(data)))

    def _joint_terms(self) -> tuple[str, ...]:
        """Return the names of the friction terms of each joint."""
        return TERMS

    def _open(self) -> None:
        self._base = base_parameters(self.robot_, rotor=True)
        friction = (f"{joint}.{term}" for joint in self.joint_names_ for term in TERMS)
        self.parameter_names_ = (*self._base.names, *friction)

    def _observations(self, data: Dataset) -> Iterator[tuple[slice, FloatArray, FloatArray]]:
        motion = tuple(data[name] for name in MOTION)
        load = payload_torque(self.robot_, data, *motion)
        target = data["effort_f"] * self.torque_scale_ - load
        terms = self._friction_terms(data)
        for rows in chunks(data):
            q, qd, qdd = (values[rows] for values in motion)
            W = self._base.regressor(self.robot_, q, qd, qdd)
            friction = joint_columns({name: term[rows] for name, term in terms.items()})
            yield rows, np.hstack([W, friction]), target[rows]

    def _friction_terms(self, data: Dataset) -> dict[str, FloatArray]:
        """Return the friction columns used in the fit by name, each (N, n)."""
        return self._friction(data["qd_f"])

    def _friction(self, qd: FloatArray) -> dict[str, FloatArray]:
        """Return the friction terms for velocities (N, n) by name, each (N, n)."""
        return friction_terms(qd, self.sign_width)

    def _parts(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        rigid, friction = np.split(self.coefficients_, [-len(TERMS) * q.shape[1]])
        bodies, still = self._base.expand(rigid), np.zeros_like(q)
        gravity = self.robot_.torque(bodies, q, still, still)
        parts = {
            "gravity": gravity,
            "inertia": self.robot_.torque(bodies, q, qd, qdd) - gravity,
            "friction": (joint_columns(self._friction(qd)) @ friction).reshape(q.shape),
        }
        return {name: part / self.torque_scale_ for name, part in parts.items()}


class RigidWls(RigidLinear):
    """Base rigid-body parameters and Coulomb–viscous friction, fitted by weighting the joints."""

    estimator: ClassVar[str] = "rigid-wls"

    sign_width: float = SIGN_WIDTH
    weighted: bool = parameter(
        True,
        flag,
        doc="Weight the joints by their residuals; False uses ordinary least squares.",
    )
    filters: FilterSettings = FILTERS

    def _estimate(self, observed: JointwiseQR) -> Solution:
        return jointwise_least_squares(observed, weighted=self.weighted)


Covariance = Literal["hac", "clustered"]
COVARIANCES = ("hac", "clustered")

FILTERED = "filtered "
"""Prefix of dataset columns with friction terms that were filtered before down-sampling."""

MEANING = {
    "hac": "Newey-West covariance, over lags up to ten correlation times of the residual and "
    "between joints",
    "clustered": "clustered by trajectory, with small-sample correction (CR2, Satterthwaite's t)",
}


class RigidClassical(RigidLinear):
    """Base class of `rigid-linear`, `rigid-lmi` and `rigid-irls`.

    Attributes:
        covariance_: (p, p) covariance of the coefficients; NaN if the method does not provide it.
        degrees_: (p,) degrees of freedom of Student's t distribution for confidence intervals.
        excitation_: Report with the condition numbers, the least determined directions and, for
            least-squares methods, the number of essential parameters.
    """

    sign_width: float = SIGN_WIDTH
    filter_columns: bool = parameter(
        True, flag, doc="Filter the friction columns with the filter of the effort."
    )
    covariance: Covariance = parameter(
        "hac", choice, COVARIANCES, doc="Covariance for the standard errors: `hac` or `clustered`."
    )
    filters: FilterSettings = FILTERS

    certain: ClassVar[bool] = True
    """Whether the standard formula for the covariance of least squares is valid."""

    bends: ClassVar[bool] = False
    """Whether the fit changes the form of its friction columns, which then cannot be stored."""

    covariance_: FloatArray
    degrees_: FloatArray
    excitation_: dict[str, Any]

    @property
    def base(self) -> BaseParameters:
        """Base parameters, in the order of the first coefficients."""
        return self._base

    def interval(self, level: float = 0.95) -> FloatArray:
        """Return (p, 2) the confidence intervals of the coefficients at `level`."""
        return interval(self.coefficients_, self.std_error_, self.degrees_, level)

    def friction_curve(self, qd: FloatArray) -> FrictionCurve | None:
        """Return the friction at velocities (N, n) [rad/s]; no standard errors unless `certain`."""
        curve = super().friction_curve(qd)
        if curve is None or self.certain:
            return curve
        # Bounds, penalties and exponents change coefficients by more than their standard errors.
        return replace(curve, std_error=np.full_like(curve.torque, np.nan))

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Return the arrays of a linear model, and the covariance matrix."""
        return super().fitted_arrays() | {
            "covariance": self.covariance_,
            "degrees": self.degrees_,
        }

    def fitted_facts(self) -> dict[str, Any]:
        """Return the entries of a linear model, the kind of standard errors and the excitation."""
        facts = super().fitted_facts()
        facts["std_error"]["method"] = MEANING[self.covariance]
        return facts | {"excitation": self.excitation_}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Restore the fitted attributes from the output of `fitted_arrays` and `fitted_facts`."""
        super().restore(arrays, facts)
        self.covariance_, self.degrees_ = arrays["covariance"], arrays["degrees"]
        self.excitation_ = dict(facts.get("excitation", {}))

    def _training_rows(self, dataset: Dataset) -> Dataset:
        if self.covariance == "clustered" and len(dataset.conditions) < 2:
            raise FitError(
                "standard errors clustered by trajectory need at least two trajectories",
                hint="record more trajectories, or choose covariance: hac",
            )
        data = prepared(dataset, self.filters)
        if self.filters.downsamples and self.filter_columns and not self.bends:
            # After down-sampling, steps would be aliased and the ends filtered unlike the effort.
            terms = self._friction_terms(data)
            data = data.with_columns(**{FILTERED + name: term for name, term in terms.items()})
        return downsample(data, self.filters)

    def _friction_terms(self, data: Dataset) -> dict[str, FloatArray]:
        terms = super()._friction_terms(data)
        if not self.filter_columns:
            return terms
        if FILTERED + next(iter(terms)) in data.columns:
            return {name: data[FILTERED + name] for name in terms}
        return {name: filter_columns(term, data, self.filters) for name, term in terms.items()}

    def _set_uncertainty(self, data: Dataset, solution: Solution) -> None:
        p = len(solution.coefficients)
        scores, residual = self._scores(data, solution)
        self.correlated_samples_ = correlated_samples(residual, data.offsets)
        if self.covariance == "clustered":
            errors = trajectory_covariance(solution.bread, scores)
        else:
            window = hac_window(self.correlated_samples_, len(data))
            errors = hac_covariance(solution.bread, scores, window)
        self.covariance_ = errors.covariance if self.certain else np.full((p, p), np.nan)
        self.degrees_ = errors.degrees
        self.excitation_ = self._excitation_report(solution, len(data))
        self.std_error_ = np.sqrt(np.diag(errors.covariance))

    def _excitation_report(self, solution: Solution, samples: int) -> dict[str, Any]:
        X, y = solution.weighted_system()
        report = condition_report(X, self.parameter_names_).facts()
        if not self.certain:
            return report
        # Correlated samples count once, so that the test has its nominal level.
        times = self.correlated_samples_
        root = np.sqrt(times)[solution.system[2]]
        independent = float(np.sum(samples / times))
        names = self.parameter_names_
        essential = essential_parameters(X / root[:, None], y / root, names, independent)
        return report | {"essential": essential.facts()}

    def _scores(self, data: Dataset, solution: Solution) -> tuple[Scores, FloatArray]:
        """Return the scores of the weighted least-squares fit, and its residual (N, n).

        The matrix XᵀWX of each series is computed only if the errors are clustered, and is 0 if
        not.
        """
        p = len(solution.coefficients)
        score, gram = np.empty((len(data), p)), np.zeros((len(data.conditions), p, p))
        residual = np.empty_like(data["q"])
        series = data.series_index()
        for rows, W, target in self._observations(data):
            rest = target - (W @ solution.coefficients).reshape(target.shape)
            residual[rows] = rest
            drive, curvature = self._sample_weights(rest, solution)
            cube = W.reshape(*rest.shape, p)
            score[rows] = np.einsum("tjp,tj->tp", cube, drive * rest)
            if self.covariance == "clustered":  # takes as long as the fit
                weighted = cube * curvature[:, :, None]
                for number, own in _series_in(series[rows]):
                    gram[number] += np.tensordot(cube[own], weighted[own], ((0, 1), (0, 1)))
        return Scores(score, gram, data.offsets, data.n_joints), residual

    def _sample_weights(
        self, rest: FloatArray, solution: Solution
    ) -> tuple[FloatArray, FloatArray]:
        """Return the weight ψ(r)/r and the sensitivity ψ′(r) of residuals (N, n), each (N, n).

        For a quadratic loss, ψ(r)/r and ψ′(r) are equal.
        """
        weight = np.broadcast_to(solution.weight, rest.shape)
        return weight, weight


def _series_in(series: IntArray) -> list[tuple[int, slice]]:
    """Return number and rows of each series, from the series numbers of successive rows (N,)."""
    ends = [0, *(np.flatnonzero(np.diff(series)) + 1).tolist(), len(series)]
    return [(int(series[i]), slice(i, j)) for i, j in pairwise(ends) if j > i]


Method = Literal["ols", "wls", "ridge", "tls"]
METHODS = ("ols", "wls", "ridge", "tls")

KNOWN_EXACTLY = 1e-9
"""Share of the norm of a column below which the noise of this column counts as zero."""


class RigidLeastSquares(RigidClassical):
    """Base rigid-body parameters and Coulomb–viscous friction, fitted by a linear method.

    All methods of `rigid-linear` use the same filters and the same smoothed sign. All methods of
    `rigid-linear` except `ols` weight the joints by the reciprocal variance of their residual.

    Attributes:
        covariance_, std_error_: Covariance and standard errors; NaN for `ridge` and `tls`.
        alpha_: Penalty that `ridge` chose; 0 for the other methods.
        gap_: Distance of `tls` from an ill-posed problem, see `total_least_squares`; infinite for
            the other methods.
    """

    estimator: ClassVar[str] = "rigid-linear"
    alpha_: float
    gap_: float

    method: Method = parameter("wls", choice, METHODS, doc="`ols`, `wls`, `ridge` or `tls`.")
    alpha: float | None = parameter(
        None,
        number,
        at_least=0.0,
        optional=True,
        doc="Penalty of `ridge` as a share of each column's sum of squares; by default the value "
        "with the smallest error in cross-validation over the training trajectories.",
    )

    def _check_together(self) -> None:
        if self.alpha is not None and self.method != "ridge":
            raise SpecError(
                f"alpha belongs to method ridge, not to {self.method}",
                hint="leave alpha out, or set method: ridge",
            )

    @property
    def certain(self) -> bool:  # type: ignore[override]
        """Whether the standard errors of least squares are valid: only for `ols` and `wls`.

        For `ridge`, the penalty causes a bias that exceeds the scatter, and so does the column
        noise for `tls`.
        """
        return self.method in ("ols", "wls")

    def fitted_facts(self) -> dict[str, Any]:
        """Return the JSON entries of a classical method, and the values that the method chose."""
        own = {"ridge": {"alpha": self.alpha_}, "tls": {"gap": self.gap_}}
        return super().fitted_facts() | own.get(self.method, {})

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Restore the fitted attributes from the output of `fitted_arrays` and `fitted_facts`."""
        super().restore(arrays, facts)
        self.alpha_ = float(facts.get("alpha", 0.0))
        self.gap_ = float(facts.get("gap") or np.inf)

    def _set_uncertainty(self, data: Dataset, solution: Solution) -> None:
        super()._set_uncertainty(data, solution)
        if not self.certain:
            self.std_error_ = np.full_like(self.std_error_, np.nan)

    def _learn(self, data: Dataset) -> None:
        self.alpha_, self.gap_ = 0.0, float("inf")
        # Only these methods need single rows, which compressed observations do not contain.
        chooses = self.method == "ridge" and self.alpha is None
        self._parts_of = self._by_trajectory(data) if chooses else []
        self._noise = self._noise_of(data) if self.method == "tls" else None
        super()._learn(data)
        del self._parts_of, self._noise

    def _estimate(self, observed: JointwiseQR) -> Solution:
        solution = jointwise_least_squares(observed, weighted=self.method != "ols")
        if self.method not in ("ridge", "tls"):
            return solution
        X, y = solution.weighted_system()
        if self.method == "tls":
            coefficients = self._total(solution, X, y)
        elif self.alpha is not None:
            self.alpha_ = self.alpha
            coefficients = ridge(X, y, self.alpha, self._penalised(X.shape[1]))
        else:
            coefficients = self._left_out(solution)
        sigma = observed.residual_std(coefficients)
        return replace(solution, coefficients=coefficients, sigma=sigma)

    def _left_out(self, solution: Solution) -> FloatArray:
        parts = []
        for part in self._parts_of:
            X, y, joint = part.system()
            root = np.sqrt(solution.weight)[joint]
            parts.append((X * root[:, None], y * root))
        best = left_out_ridge(parts, self._penalised(parts[0][0].shape[1]))
        self.alpha_ = best.alpha
        return best.coefficients

    def _total(self, solution: Solution, X: FloatArray, y: FloatArray) -> FloatArray:
        assert self._noise is not None
        # (n, p + 1) noise per joint, scaled like the weighted rows and pooled over the joints.
        noise = np.sqrt(np.mean(solution.weight[:, None] * self._noise**2, axis=0))
        columns, target = noise[:-1], float(noise[-1])
        # Rows of the compressed system represent many samples each; only ratios matter.
        exact = columns <= KNOWN_EXACTLY * np.linalg.norm(X, axis=0)
        best = total_least_squares(X, y, columns, target, exact)
        self.gap_ = best.gap
        self.notes_ = (best.note,) if best.note else ()
        return best.coefficients

    def _penalised(self, p: int) -> BoolArray:
        """Return (p,) a mask of the penalised coefficients: all except the offsets."""
        keep = np.ones(p, dtype=bool)
        offsets = p - len(TERMS) * len(self.joint_names_) + TERMS.index("offset")
        keep[offsets :: len(TERMS)] = False
        return keep

    def _noise_of(self, data: Dataset) -> FloatArray:
        """Return (n, p + 1) the noise standard deviation of each joint's columns and target."""
        n = data.n_joints
        squares, count = np.zeros((n, len(self.parameter_names_) + 1)), 0
        series = data.series_index()
        for rows, W, target in self._observations(data):
            cube = np.concatenate([W.reshape(*target.shape, -1), target[:, :, None]], axis=2)
            for number_ in np.unique(series[rows]):
                own = cube[series[rows] == number_]
                squares += len(own) * np.stack([rough(own[:, j]) ** 2 for j in range(n)])
                count += len(own)
        return np.sqrt(squares / max(count, 1))

    def _by_trajectory(self, data: Dataset) -> list[JointwiseQR]:
        """Return the compressed observations of each trajectory."""
        groups = dict.fromkeys(group_of(condition, "trajectory") for condition in data.conditions)
        if len(groups) < 2:
            raise FitError(
                "ridge chooses alpha by leaving trajectories out, and there is only one",
                hint="set alpha, or pass more trajectories",
            )
        return [self._compressed(data.select(partial(_belongs, group))) for group in groups]


def _belongs(group: Group | None, condition: Conditions) -> bool:
    return group_of(condition, "trajectory") == group
