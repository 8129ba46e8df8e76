"""Gravity at standstill by weighted least squares (static paper, eq. 15–20).

Two forms share one estimator:

- `shared`: the arm's base gravity regressor, one set of parameters for all joints, plus one offset
  per joint, fitted to K·i. Needs the drive gains.
- `paper`: φ₂…φ₅ of eq. 15, one independent regression per joint plus an offset, directly in the
  unit of the effort. Only for the six-joint arms of Universal Robots.

The column i²·sign(i) of eq. 20 is not used: it puts the target into its own regressor, and a
model that needs the current to predict the current predicts nothing. Friction at rest depends on
how the pose was approached and enters as noise; poses approached from both sides average it out.
Every dwell counts once: its ten samples are nearly one sample, and standard errors that counted
all ten would be three times too small.
"""

from __future__ import annotations

from typing import ClassVar, Literal, Self

import numpy as np

from hil.data.dataset import Dataset, SeriesKind
from hil.data.dwells import DwellRule, dwells_of, series_means
from hil.data.prediction import Prediction
from hil.dynamics import RobotModel
from hil.errors import SpecError
from hil.identify.base import load_of, payload_torque
from hil.identify.checks import require_clean, require_robot, require_samples, torque_scale
from hil.identify.compress import JointwiseQR
from hil.identify.gravity import BaseGravity, GravityForm, PaperGravity
from hil.identify.wls import WlsEstimator
from hil.typing import BoolArray, FloatArray


class StaticWls(WlsEstimator):
    """Gravity and offset of an arm at rest.

    Args:
        form: `shared` or `paper`, see the module.
        weighted: Weight the joints by their residual; makes no difference to `paper`, whose
            joints are independent.
        rest_speed: Faster than this [rad/s] a row is not at rest and the model not valid.

    Attributes:
        parameter_names_: Gravity parameters, then one `offset` per joint.
        samples_: Number of dwells.
    """

    estimator: ClassVar[str] = "static-wls"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("dwell",), ("trajectory",))

    def __init__(
        self,
        *,
        form: Literal["shared", "paper"] = "shared",
        weighted: bool = True,
        rest_speed: float = 0.01,
    ) -> None:
        if form not in ("shared", "paper"):
            raise SpecError(f"form is {form!r}, but must be 'shared' or 'paper'")
        if not rest_speed > 0:
            raise SpecError(f"rest_speed is {rest_speed}, but must be a speed in rad/s")
        self.form = form
        self.weighted = weighted
        self.rest_speed = rest_speed

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit to the dwells of the data, or to the stays found in motions without a plan.

        Raises:
            FitError: The data are too few, not finite, of another robot or unit, or do not
                excite all parameters.
        """
        require_robot(dataset, robot)
        self._remember(dataset, robot, self._scale(dataset))
        require_clean(dataset, ("t", "q", "effort"))
        self._open()
        dwells = dwells_of(dataset, DwellRule(speed=self.rest_speed / 2))
        self.samples_ = len(dwells.conditions)
        require_samples(self.samples_, len(self.parameter_names_), "dwells")
        self._solve(self._observe(_one_row_each(dwells)), weighted=self.weighted)
        return self

    def predict(self, dataset: Dataset) -> Prediction:
        """Gravity, offset and payload per row, from the measured positions.

        Rows in motion are predicted too, but marked as not valid.

        Raises:
            DataError: The data are of another robot or unit.
        """
        self._require_match(dataset)
        still = np.zeros_like(dataset["q"])
        whole = self._predict(dataset, dataset["q"], still, still)
        valid = whole.valid & self._at_rest(dataset)[:, None]
        return Prediction(whole.effort, whole.std, valid, whole.components)

    def _scale(self, dataset: Dataset) -> FloatArray:
        """Currents need no gains when every joint is on its own and nothing is mounted."""
        loaded = any(not load_of(condition).is_empty for condition in dataset.conditions)
        if self.form == "paper" and not loaded:
            return np.ones(dataset.n_joints)
        return torque_scale(dataset)

    def _open(self) -> None:
        robot = self.robot_
        self._form: GravityForm = (
            PaperGravity(robot) if self.form == "paper" else BaseGravity(robot)
        )
        offsets = (f"{joint}.offset" for joint in self.joint_names_)
        self.parameter_names_ = (*self._form.names, *offsets)

    def _observe(self, dwells: Dataset) -> JointwiseQR:
        q, still = dwells["q"], np.zeros_like(dwells["q"])
        load = payload_torque(self.robot_, dwells, q, still, still)
        observed = JointwiseQR(dwells.n_joints)
        observed.add(self._columns(q), dwells["effort"] * self.torque_scale_ - load)
        return observed

    def _columns(self, q: FloatArray) -> FloatArray:
        offset = np.tile(np.eye(q.shape[1]), (len(q), 1))
        return np.hstack([self._form.columns(q), offset])

    def _parts(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> dict[str, FloatArray]:
        gravity, offset = np.split(self.coefficients_, [-q.shape[1]])
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


def _one_row_each(dwells: Dataset) -> Dataset:
    """The same series with their samples averaged to one row."""
    from dataclasses import replace

    columns = {"t": dwells["t"][dwells.offsets[:-1]]}
    columns |= {name: series_means(dwells, dwells[name]) for name in ("q", "effort")}
    return replace(dwells, columns=columns, offsets=np.arange(len(dwells.conditions) + 1))
