"""The static paper's five linear estimators on one regressor (eq. 15–24, Table 2, Fig. 4).

`static-wls` solves for all joints at once and weights joints; this one solves as the paper does,
and tells how sure each parameter is. Its standard errors are clustered by pose: what the samples
of a dwell, and the dwells of a pose, have in common does not count twice, see
`hil.identify.clustered`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, Literal, Self

import numpy as np

from hil.data.dataset import Dataset
from hil.dynamics import RobotModel
from hil.errors import SpecError
from hil.identify.checks import require_motion, require_rank, require_samples, require_varied
from hil.identify.dwell_rows import one_row_each, pose_numbers, scatter, short_dwells
from hil.identify.gravity import reach_of
from hil.identify.linear_methods import (
    PENALISED,
    Block,
    DwellSeries,
    Method,
    Solution,
    Weights,
    least_squares,
    penalised,
)
from hil.identify.parameters import choice, flag, number
from hil.identify.static_model import Form, StaticModel
from hil.typing import FloatArray, IntArray

Rows = Literal["dwells", "samples"]

STD_ERROR_GIVEN = (
    "exact drive gains, declared loads, kinematics and form of the model; poses independent of "
    "each other, whatever the samples and dwells of one pose share (clustered by pose, CR2, "
    "Student's t with Satterthwaite's degrees of freedom)"
)
STD_ERROR_LEAVES_OUT = (
    "errors of the gains, loads and kinematics; gravity of another form; friction that depends on "
    "the pose and not on the approach; what all poses have in common, such as temperature"
)
NO_STD_ERROR = "none: a penalty pulls the parameters towards 0 by more than their scatter tells"


class StaticLinear(StaticModel):
    """Gravity and offset of an arm at rest by one of the paper's five methods.

    Args:
        method: `ls`, `ridge`, `lasso`, `elastic-net` or `wls`, see `hil.identify.linear_methods`.
        form: `paper`, each joint by itself in the unit of the effort, or `shared`, all joints at
            once in N·m (not for `lasso` and `elastic-net`).
        alpha: Weight of the penalty, in scikit-learn's scaling.
        l1_ratio: Share of Σ abs(θ) in the penalty of `elastic-net`.
        standardise: Penalise as if all columns had standard deviation 1. The paper does not.
        weights: Of `wls`: `paper` (variances from the residual of a first fit), `repeats`
            (variances of the samples of a dwell), `pose` (every pose counts once), see
            `hil.identify.pose_weights`.
        rows: `dwells`, one row each, or `samples`, all of them, as the paper.
        current_term: Only with `form: paper`: eq. 20 as printed, measured current included.
        rest_speed: Faster than this [rad/s] a row is not at rest and the model not valid.

    Attributes:
        covariance_: (p, p) of the parameters, clustered by pose; 0 between regressions, NaN where
            the method gives none.
        degrees_: (p,) of Student's t for `interval`.
        poses_: Number of poses.
        notes_: What was done about data that are not as they should be, in words.
    """

    estimator: ClassVar[str] = "static-linear"

    covariance_: FloatArray
    degrees_: FloatArray
    poses_: int

    def __init__(
        self,
        *,
        method: Method = "ls",
        form: Form = "paper",
        alpha: float = 0.001,
        l1_ratio: float = 0.5,
        standardise: bool = False,
        weights: Weights = "paper",
        rows: Rows = "dwells",
        current_term: bool = False,
        rest_speed: float = 0.01,
    ) -> None:
        self.method = choice("method", method, ("ls", *PENALISED, "wls"))
        self.form = choice("form", form, ("paper", "shared"))
        self.alpha = number("alpha", alpha, at_least=0.0)
        self.l1_ratio = number("l1_ratio", l1_ratio, at_least=0.0)
        self.standardise = flag("standardise", standardise)
        self.weights = choice("weights", weights, ("paper", "repeats", "pose"))
        self.rows = choice("rows", rows, ("dwells", "samples"))
        self.current_term = flag("current_term", current_term)
        self.rest_speed = number("rest_speed", rest_speed, above=0.0)
        self._require_form()
        if l1_ratio > 1.0:
            raise SpecError(f"l1_ratio is {l1_ratio!r}, but must be a share between 0 and 1")
        if form == "shared" and method in ("lasso", "elastic-net"):
            raise SpecError(f"method: {method} goes with form: paper only")

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit to the dwells of the data, or to the stays found in motions without a plan.

        Dwells with fewer than ten samples are used as they are, and `notes_` says so.

        Raises:
            FitError: There are too few poses, a joint that has to move did not, a parameter is not
                determined, data are not finite or of another robot or unit; or `current_term`
                meets efforts that are no currents.
        """
        dwells = self._dwells(dataset, robot)
        self.samples_ = len(dwells.conditions)
        self.poses_ = len(set(pose_numbers(dwells).tolist()))
        widest = max(len(self._columns_of(joints)) for joints in self._joint_groups())
        require_samples(self.poses_, widest + 1, "poses")
        self.notes_ = tuple(short_dwells(dwells))
        self._take([(*each, self._solved(*each)) for each in self._blocks(dwells)])
        return self

    def interval(self, level: float = 0.95) -> FloatArray:
        """(p, 2) in which each parameter lies with probability `level`; NaN with a penalty."""
        from hil.identify.clustered import interval

        return interval(self.coefficients_, self.std_error_, self.degrees_, level)

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Parameters, their covariance, gains and residual deviations."""
        own = {"covariance": self.covariance_, "degrees": self.degrees_}
        return super().fitted_arrays() | own

    def fitted_facts(self) -> dict[str, Any]:
        """As of every linear model; what the standard errors are given, and the notes."""
        told = {"given": STD_ERROR_GIVEN, "leaves_out": STD_ERROR_LEAVES_OUT}
        errors = {"given": NO_STD_ERROR} if self.method in PENALISED else told
        return super().fitted_facts() | {"std_error": errors, "poses": self.poses_}

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        super().restore(arrays, facts)
        self.covariance_, self.degrees_ = arrays["covariance"], arrays["degrees"]
        self.poses_ = int(facts["poses"])

    def _blocks(self, dwells: Dataset) -> Iterator[tuple[IntArray, Block]]:
        """The regressions, each with its columns among all parameters."""
        data = one_row_each(dwells) if self.rows == "dwells" else dwells
        (_, W, target) = next(self._observations(data))
        cube = W.reshape(len(data), data.n_joints, -1)
        self._require_excited(data, cube)
        series = DwellSeries(pose_numbers(dwells), scatter(dwells), np.diff(dwells.offsets))
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

    def _require_excited(self, data: Dataset, cube: FloatArray) -> None:
        """Refuse joints that never moved though gravity depends on them, and constant columns."""
        turn, span = reach_of(self._form, data.n_joints)
        require_motion(data, np.flatnonzero(turn).tolist())
        change, names = np.ptp(cube, axis=0).max(axis=0), self.parameter_names_
        gravity = slice(0, len(span))
        require_varied(change[gravity], span, names[gravity])

    def _solved(self, columns: IntArray, block: Block) -> Solution:
        if self.method in PENALISED:
            return penalised(block, self.method, self.alpha, self.l1_ratio, self.standardise)
        found = least_squares(block, self.weights if self.method == "wls" else None)
        names = [self.parameter_names_[k] for k in columns]
        require_rank(found.rank, found.condition, names, block.X)
        return found

    def _take(self, solved: list[tuple[IntArray, Block, Solution]]) -> None:
        """Put the regressions' parameters together, in the torque domain."""
        count, n = len(self.parameter_names_), len(self.joint_names_)
        self.coefficients_, self.degrees_ = np.empty(count), np.empty(count)
        self.covariance_, self.sigma_ = np.zeros((count, count)), np.empty(n)
        self.condition_ = max(found.condition for _, _, found in solved)
        self.correlated_samples_ = np.ones(n)
        for columns, block, found in solved:
            joints = np.fromiter(block.offset, dtype=np.int64)
            unit = float(self._unit(joints)[0])
            self.coefficients_[columns] = unit * found.coefficients
            self.covariance_[np.ix_(columns, columns)] = unit**2 * found.covariance
            self.degrees_[columns] = found.degrees
            residual = (block.y - block.X @ found.coefficients).reshape(-1, len(joints))
            degrees = max(len(residual) - len(columns) / len(joints), 1.0)
            deviation = np.sqrt(np.sum(residual**2, axis=0) / degrees)
            self.sigma_[joints] = deviation * self._unit(joints) / self.torque_scale_[joints]
        self.std_error_ = np.sqrt(np.diag(self.covariance_))

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
        terms = 1 + self.current_term
        own = [self._offset_of(j) - terms + 1 + t for j in joints for t in range(terms)]
        return np.array([*gravity, *own], dtype=np.int64)

    def _offset_of(self, joint: int) -> int:
        """Column of a joint's offset among all parameters."""
        return len(self._form.names) + (joint + 1) * (1 + self.current_term) - 1
