"""Five linear estimators of Khanesar et al. (eq. 15–24, Table 2, Fig. 4) on one regressor.

`static-wls` solves for all joints together and weights the joints. `static-linear` solves R·θ = i
joint by joint, as in the static paper, and reports the standard error of each parameter. The
functions that are minimised are those of scikit-learn, whose scaling differs from the formulas in
the static paper (n is the number of rows):

| method | minimised | in the paper |
|---|---|---|
| ls, wls | Σ wᵢ rᵢ² | the same (21) |
| ridge | Σ rᵢ² + α Σ θₖ² | α/2 in (22), α in its solution |
| lasso | Σ rᵢ²/(2n) + α Σ abs(θₖ) | Σ rᵢ² + α/2 (Σ abs(θₖ))² in (23) |
| elastic-net | Σ rᵢ²/(2n) + α ρ Σ abs(θₖ) + α (1−ρ)/2 Σ θₖ² | α in place of ρ in (24) |

A value of α = 0.001 is therefore a weak penalty for ridge but a strong one for lasso. Offsets are
never penalised, as in scikit-learn with an intercept, which replaces the column of ones in eq. 20.

The WLS method of the static paper weights every sample by 1/σ², with a separate variance from the
residual of a least-squares fit. A single residual does not determine a variance: a residual near 0
would have a nearly infinite weight, and the fit would pass through its sample. In this module, each
variance v is computed from the m observations of a whole pose or dwell. The variance v is shrunk
towards the mean variance s² of its joint with a weight of `PRIOR_OBSERVATIONS`: (PRIOR·s² + m·v) /
(PRIOR + m).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np

from hil.core import FloatArray, IntArray, SpecError
from hil.data import Dataset
from hil.dynamics import RobotModel
from hil.estimators.checks import require_rank
from hil.estimators.covariance import ClusterSums, clustered_covariance
from hil.estimators.least_squares import Weighted, weighted_least_squares
from hil.estimators.parameters import choice, flag, number, parameter
from hil.estimators.static_model import (
    CURRENT_TERM,
    Form,
    PoseClustered,
    deviation,
    one_row_each,
    pose_numbers,
    scatter,
)

Rows = Literal["dwells", "samples"]
Method = Literal["ls", "ridge", "lasso", "elastic-net", "wls"]
Weights = Literal["paper", "repeats", "pose"]

PENALISED = ("ridge", "lasso", "elastic-net")
NO_STD_ERROR = "none: a penalty biases the parameters by more than their standard error"


class StaticLinear(PoseClustered):
    """Gravity and offset of a static arm, fitted by one of the five methods of the static paper.

    Attributes:
        covariance_, degrees_, std_error_: Covariance, degrees of freedom and standard errors; NaN
            for `ridge`, `lasso` and `elastic-net`.
    """

    estimator: ClassVar[str] = "static-linear"

    method: Method = parameter(
        "ls",
        choice,
        ("ls", *PENALISED, "wls"),
        doc="Regression method; formulas in `hil.estimators.static_linear`.",
    )
    form: Form = parameter(
        "paper",
        choice,
        ("paper", "shared"),
        doc="`paper`: each joint separately, in the unit of the effort; `shared`: all joints "
        "together, in N·m (not for `lasso` and `elastic-net`).",
    )
    alpha: float = parameter(
        0.001, number, at_least=0.0, doc="Weight of the penalty, in scikit-learn's scaling."
    )
    l1_ratio: float = parameter(
        0.5, number, at_least=0.0, doc="Share of Σ abs(θ) in the penalty of `elastic-net`."
    )
    standardise: bool = parameter(
        False,
        flag,
        doc="Penalise as if all columns had standard deviation 1, unlike the static paper.",
    )
    weights: Weights = parameter(
        "paper",
        choice,
        ("paper", "repeats", "pose"),
        doc="Weights of `wls`: `paper` (variances from the residual of a first fit), `repeats` "
        "(variances of the samples of a dwell), `pose` (every pose counts once).",
    )
    rows: Rows = parameter(
        "dwells",
        choice,
        ("dwells", "samples"),
        doc="Rows of the regression: `dwells` (one row per dwell) or `samples` (all samples, as "
        "in the static paper).",
    )
    current_term: bool = CURRENT_TERM

    def _check_together(self) -> None:
        super()._check_together()
        if self.l1_ratio > 1.0:
            raise SpecError(f"l1_ratio is {self.l1_ratio!r}, but must be a share between 0 and 1")
        if self.form == "shared" and self.method in ("lasso", "elastic-net"):
            raise SpecError(
                f"method: {self.method} needs form: paper",
                hint="set form: paper, or choose a different method",
            )

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit the model to the dwells of the data.

        Dwells are detected if the recording has no plan.

        Dwells with fewer than ten samples are used too; `notes_` reports these dwells.

        Raises:
            FitError: There are too few poses, a joint that must move did not move, a parameter is
                not determined, or the data are not finite or are of a different robot or unit. The
                setting `current_term` is on although the efforts are torques.
        """
        dwells = self._enough_dwells(dataset, robot)
        self._assemble([(*each, self._solve_block(*each)) for each in self._blocks(dwells)])
        return self

    def _std_error_facts(self) -> dict[str, Any]:
        return {"given": NO_STD_ERROR} if self.method in PENALISED else super()._std_error_facts()

    def _blocks(self, dwells: Dataset) -> Iterator[tuple[IntArray, Block]]:
        """Yield the regressions, each with the indices of its columns among all parameters."""
        data = one_row_each(dwells) if self.rows == "dwells" else dwells
        (_, W, target) = next(self._observations(data))
        cube = W.reshape(len(data), data.n_joints, -1)
        self._require_excited(data, cube)
        # Variance of the efforts, in the squared unit of the target.
        to_target = self.torque_scale_ / self._unit(np.arange(data.n_joints))
        variance = scatter(dwells) * to_target**2
        series = DwellSeries(pose_numbers(dwells), variance, np.diff(dwells.offsets))
        for joints in self._joint_groups():
            columns = self._columns_of(joints)
            yield (
                columns,
                Block(
                    X=cube[:, joints][:, :, columns].reshape(-1, len(columns)),
                    y=(target[:, joints] / self._unit(joints)).ravel(),
                    joint=np.tile(joints, len(data)),
                    dwell=np.repeat(data.series_index(), len(joints)),
                    offset={
                        int(j): int(np.searchsorted(columns, self._offset_of(j))) for j in joints
                    },
                    series=series,
                ),
            )

    def _solve_block(self, columns: IntArray, block: Block) -> BlockSolution:
        if self.method in PENALISED:
            return penalised(block, self.method, self.alpha, self.l1_ratio, self.standardise)
        found = least_squares(block, self.weights if self.method == "wls" else None)
        names = [self.parameter_names_[k] for k in columns]
        require_rank(found.rank, found.condition, names, block.X)
        return found

    def _assemble(self, solved: list[tuple[IntArray, Block, BlockSolution]]) -> None:
        """Store the parameters of all regressions after converting them to torques."""
        self._allocate()
        for columns, block, found in solved:
            joints = np.fromiter(block.offset, dtype=np.int64)
            unit = float(self._unit(joints)[0])
            self.coefficients_[columns] = unit * found.coefficients
            self.covariance_[np.ix_(columns, columns)] = unit**2 * found.covariance
            self.degrees_[columns] = found.degrees
            self.condition_ = max(self.condition_, found.condition)
            residual = (block.y - block.X @ found.coefficients).reshape(-1, len(joints))
            in_effort = self._unit(joints) / self.torque_scale_[joints]
            self.sigma_[joints] = in_effort * deviation(residual, len(columns))
        self.std_error_ = np.sqrt(np.diag(self.covariance_))


@dataclass(frozen=True, slots=True, eq=False)
class DwellSeries:
    """Dwells to which the rows of a regression belong.

    Attributes:
        pose: (D,) index of the pose of each dwell; the errors of one pose form a cluster.
        scatter: (D, n) variance of the samples of each dwell, in the unit of `Block.y` squared.
        samples: (D,) number of samples of each dwell.
    """

    pose: IntArray
    scatter: FloatArray
    samples: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Data of one regression: all joints (`shared`) or one joint (`paper`).

    Attributes:
        X: (N, p) regressor, including offset columns.
        y: (N,) target.
        joint: (N,) index of the joint of each row, from 0.
        dwell: (N,) index of the dwell of each row, from 0.
        offset: Index of the column of ones of each joint.
        series: All dwells.
    """

    X: FloatArray
    y: FloatArray
    joint: IntArray
    dwell: IntArray
    offset: dict[int, int]
    series: DwellSeries

    @property
    def pose(self) -> IntArray:
        """Index (N,) of the pose of each row, from 0."""
        return self.series.pose[self.dwell]


class BlockSolution(NamedTuple):
    """Solution of one least-squares regression.

    Attributes:
        coefficients: (p,) coefficients.
        covariance: (p, p) covariance, clustered by pose; NaN if the method does not provide it.
        degrees: (p,) degrees of freedom of the confidence intervals; NaN if the method does not
            provide them.
        rank: Number of excited parameter directions.
        condition: Condition number of the column-scaled, weighted regressor.
    """

    coefficients: FloatArray
    covariance: FloatArray
    degrees: FloatArray
    rank: int
    condition: float


def least_squares(block: Block, weights: Weights | None) -> BlockSolution:
    """Return the least-squares solution, weighted on request, with pose-clustered CR2 errors."""
    if weights == "paper":
        return _weighted_by_residual(block)
    weight = np.ones_like(block.y)
    if weights == "pose":  # every pose has the same weight for any number of dwells and samples
        weight = 1.0 / np.bincount(block.pose)[block.pose]
    elif weights == "repeats":
        weight = _repeat_weights(block)
    fit = weighted_least_squares(block.X, block.y, weight)
    return _solution(fit, _residual_sums(block, fit, weight))


def _residual_sums(block: Block, fit: Weighted, weight: FloatArray) -> ClusterSums:
    return ClusterSums.of(block.X, block.y - block.X @ fit.coefficients, weight, block.pose)


def _solution(fit: Weighted, sums: ClusterSums) -> BlockSolution:
    errors = clustered_covariance(fit.bread, sums)
    return BlockSolution(fit.coefficients, *errors, fit.rank, fit.condition)


PRIOR_OBSERVATIONS = 4.0
"""Weight of the mean variance of the joint, in observations.

If there is one residual per pose, the weights of the poses equal those of one step towards the
maximum likelihood of Student's t distribution with 4 degrees of freedom.
"""


def _weighted_by_residual(block: Block) -> BlockSolution:
    """Return the two-step solution of the static paper.

    The standard errors take into account that the weights are estimated.

    All rows of a pose count as one observation of its variance, because these rows share the
    remaining friction. A pose with a large residual has a small weight, so its influence does not
    grow with the residual. The second fit is therefore less sensitive to an error than the weights
    suggest.

    The weights of the second fit depend on the first fit. With B₀ = XᵀX and C = Σ_g κ_g s_g s_gᵀ, a
    change δβ of the first fit changes the summed score by +C·δβ. The term C·B₀⁻¹·s is therefore
    added to the score s of each pose (s_g = X_gᵀ r_g, κ_g = 2/((PRIOR + 1)·m_g·v_g²)).
    """
    ones = np.ones_like(block.y)
    first = weighted_least_squares(block.X, block.y)
    residual = block.y - block.X @ first.coefficients
    weight, gap, prior = np.empty_like(block.y), np.zeros_like(first.bread), PRIOR_OBSERVATIONS
    for joint in block.offset:
        rows = block.joint == joint
        pose, joint_residual = block.pose[rows], residual[rows]
        count = np.bincount(pose)
        mean_square = np.bincount(pose, joint_residual**2) / count
        common = max(float(np.mean(mean_square)), _variance_floor(block))
        variance = (prior * common + mean_square) / (prior + 1.0)
        weight[rows] = 1.0 / variance[pose]
        kappa = 2.0 / ((prior + 1.0) * count * variance**2)
        score = ClusterSums.of(block.X[rows], joint_residual, ones[rows], pose).score
        gap += (score.T * kappa) @ score
    second = weighted_least_squares(block.X, block.y, weight)
    sums = _residual_sums(block, second, weight)
    inherited = ClusterSums.of(block.X, residual, ones, block.pose).score @ first.bread @ gap
    return _solution(second, replace(sums, score=sums.score + inherited))


def _repeat_weights(block: Block) -> FloatArray:
    """Return (N,) for each row the reciprocal variance of the samples in its dwell."""
    weight, prior = np.empty_like(block.y), PRIOR_OBSERVATIONS
    degrees = block.series.samples - 1.0  # a single sample has no variance
    for joint in block.offset:
        rows, variance = block.joint == joint, block.series.scatter[:, joint]
        # Quantised samples can all be equal.
        mean = float(variance @ degrees) / max(float(np.sum(degrees)), 1.0)
        common = max(mean, _variance_floor(block))
        shrunk = (prior * common + degrees * variance) / (prior + degrees)
        weight[rows] = 1.0 / shrunk[block.dwell[rows]]
    return weight


def _variance_floor(block: Block) -> float:
    """Return the variance below which data count as noise-free."""
    return max((1e-12 * float(np.max(np.abs(block.y), initial=0.0))) ** 2, 1e-60)


def penalised(
    block: Block, method: str, alpha: float, l1_ratio: float, standardise: bool
) -> BlockSolution:
    """Return the ridge, lasso or elastic-net solution of scikit-learn.

    A penalised solution has no standard errors, because the penalty causes a bias.

    Args:
        block: Data of the regression to be solved.
        method: Name of the method: `ridge`, `lasso` or `elastic-net`.
        alpha: Weight of the penalty in the minimised function.
        l1_ratio: Share of Σ abs(θ) in the penalty of the elastic net.
        standardise: Whether the penalty applies to columns scaled to a standard deviation of 1.
    """
    gravity_columns = [k for k in range(block.X.shape[1]) if k not in block.offset.values()]
    mean_X, mean_y = (
        _joint_means(block, block.X[:, gravity_columns]),
        _joint_means(block, block.y[:, None]),
    )
    X = block.X[:, gravity_columns] - mean_X[block.joint]
    y = block.y - mean_y[block.joint, 0]
    scale = np.std(X, axis=0) if standardise else np.ones(len(gravity_columns))
    scale = np.where(scale > 0, scale, 1.0)
    coefficients = np.zeros(block.X.shape[1])
    if gravity_columns:
        fitted = _regressor(method, alpha, l1_ratio).fit(X / scale, y)
        coefficients[gravity_columns] = fitted.coef_ / scale
    for joint, column in block.offset.items():
        coefficients[column] = mean_y[joint, 0] - mean_X[joint] @ coefficients[gravity_columns]
    p = len(coefficients)
    unpenalised = weighted_least_squares(block.X, block.y)
    unknown = np.full((p, p), np.nan)
    return BlockSolution(coefficients, unknown, unknown[0], unpenalised.rank, unpenalised.condition)


def _joint_means(block: Block, values: FloatArray) -> FloatArray:
    """Return (n, k) the mean of values (N, k) over the rows of each joint; 0 if it has none."""
    count = np.bincount(block.joint)
    sums = np.zeros((len(count), values.shape[1]))
    np.add.at(sums, block.joint, values)
    means: FloatArray = sums / np.maximum(count, 1)[:, None]
    return means


def _regressor(method: str, alpha: float, l1_ratio: float) -> Any:
    from sklearn.linear_model import ElasticNet, Lasso, LinearRegression, Ridge

    if alpha == 0.0:  # scikit-learn advises against coordinate descent without a penalty
        return LinearRegression(fit_intercept=False)
    if method == "ridge":
        return Ridge(alpha=alpha, fit_intercept=False)
    # The tolerance of the coordinate descent is that of the static paper.
    descent: dict[str, Any] = {"fit_intercept": False, "tol": 1e-8, "max_iter": 100_000}
    if method == "lasso":
        return Lasso(alpha=alpha, **descent)
    return ElasticNet(alpha=alpha, l1_ratio=l1_ratio, **descent)
