"""Gravity at standstill by weighted least squares (static paper, eq. 15–20).

Two forms share one estimator:

- `shared`: the arm's base gravity regressor, one set of parameters for all joints, plus one offset
  per joint, fitted to K·i. Needs the drive gains.
- `paper`: φ₂…φ₅ of eq. 15, one independent regression per joint plus an offset; needs no drive
  gains while nothing is mounted. Only for the six-joint arms of Universal Robots on a level base.

The column i²·sign(i) of eq. 20 is left out by default: it puts the target into its own regressor,
and a model that needs the current to predict the current predicts nothing. `current_term` adds it
to reproduce the paper's numbers, and the model then says so wherever it shows (`protocol`).
Friction at rest depends on
how the pose was approached and enters as noise; poses approached from both sides average it out.
Every dwell counts once: its ten samples are nearly one sample, and standard errors that counted
all ten would be three times too small.
"""

from __future__ import annotations

from typing import ClassVar, Self

from hil.data import Dataset
from hil.dynamics import RobotModel
from hil.estimators.dwell_rows import one_row_each
from hil.estimators.parameters import choice, flag, number
from hil.estimators.static_model import (
    CURRENT_PART,
    PAPER_PROTOCOL,
    Form,
    StaticModel,
    signed_square,
)

__all__ = ["CURRENT_PART", "PAPER_PROTOCOL", "StaticWls", "signed_square"]


class StaticWls(StaticModel):
    """Gravity and offset of an arm at rest, weighted joint by joint.

    Args:
        form: `shared` or `paper`, see the module.
        weighted: Weight the joints by their residual; makes no difference to `paper`, whose
            joints are independent.
        current_term: Only with `paper`: eq. 20 as printed, measured current included.
        rest_speed: Faster than this [rad/s] a row is not at rest and the model not valid.
    """

    estimator: ClassVar[str] = "static-wls"

    def __init__(
        self,
        *,
        form: Form = "shared",
        weighted: bool = True,
        current_term: bool = False,
        rest_speed: float = 0.01,
    ) -> None:
        self.form = choice("form", form, ("shared", "paper"))
        self.weighted = flag("weighted", weighted)
        self.current_term = flag("current_term", current_term)
        self.rest_speed = number("rest_speed", rest_speed, above=0.0)
        self._require_form()

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
