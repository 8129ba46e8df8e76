"""The static paper's five linear estimators on one regressor (eq. 15–24, Table 2, Fig. 4).

`static-wls` solves for all joints at once and weights joints; this one solves as the paper does,
and tells how sure each parameter is. Its standard errors are clustered by pose: what the samples
of a dwell, and the dwells of a pose, have in common does not count twice, see
`hil.estimators.covariance`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, Literal, Self

import numpy as np

from hil.core import IntArray, SpecError
from hil.data import Dataset
from hil.dynamics import RobotModel
from hil.estimators.checks import require_rank
from hil.estimators.dwell_rows import one_row_each, pose_numbers, scatter
from hil.estimators.parameters import choice, flag, number
from hil.estimators.static_clustered import PoseClustered, deviation
from hil.estimators.static_least_squares import (
    PENALISED,
    Block,
    DwellSeries,
    Method,
    Solution,
    Weights,
    least_squares,
    penalised,
)
from hil.estimators.static_model import Form

Rows = Literal["dwells", "samples"]

NO_STD_ERROR = "none: a penalty pulls the parameters towards 0 by more than their scatter tells"


class StaticLinear(PoseClustered):
    """Gravity and offset of an arm at rest by one of the paper's five methods.

    Args:
        method: `ls`, `ridge`, `lasso`, `elastic-net` or `wls`, see
        `hil.estimators.static_least_squares`.
        form: `paper`, each joint by itself in the unit of the effort, or `shared`, all joints at
            once in N·m (not for `lasso` and `elastic-net`).
        alpha: Weight of the penalty, in scikit-learn's scaling.
        l1_ratio: Share of Σ abs(θ) in the penalty of `elastic-net`.
        standardise: Penalise as if all columns had standard deviation 1. The paper does not.
        weights: Of `wls`: `paper` (variances from the residual of a first fit), `repeats`
            (variances of the samples of a dwell), `pose` (every pose counts once), see
            `hil.estimators.pose_weights`.
        rows: `dwells`, one row each, or `samples`, all of them, as the paper.
        current_term: Only with `form: paper`: eq. 20 as printed, measured current included.
        rest_speed: Faster than this [rad/s] a row is not at rest and the model not valid.

    Attributes:
        covariance_, degrees_, std_error_: NaN for `ridge`, `lasso` and `elastic-net`.
    """

    estimator: ClassVar[str] = "static-linear"

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
            raise SpecError(
                f"method: {method} goes with form: paper only",
                hint="add form: paper, or choose another method",
            )

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit to the dwells of the data, or to the stays found in motions without a plan.

        Dwells with fewer than ten samples are used as they are, and `notes_` says so.

        Raises:
            FitError: There are too few poses, a joint that has to move did not, a parameter is not
                determined, data are not finite or of another robot or unit; or `current_term`
                meets efforts that are no currents.
        """
        dwells = self._enough_dwells(dataset, robot)
        self._take([(*each, self._solved(*each)) for each in self._blocks(dwells)])
        return self

    def _std_error_facts(self) -> dict[str, Any]:
        return {"given": NO_STD_ERROR} if self.method in PENALISED else super()._std_error_facts()

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

    def _solved(self, columns: IntArray, block: Block) -> Solution:
        if self.method in PENALISED:
            return penalised(block, self.method, self.alpha, self.l1_ratio, self.standardise)
        found = least_squares(block, self.weights if self.method == "wls" else None)
        names = [self.parameter_names_[k] for k in columns]
        require_rank(found.rank, found.condition, names, block.X)
        return found

    def _take(self, solved: list[tuple[IntArray, Block, Solution]]) -> None:
        """Put the regressions' parameters together, in the torque domain."""
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
