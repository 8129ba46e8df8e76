"""A loaded recording as a least-squares problem in the ten parameters of its load.

A rigid load is linear in its parameters, with the columns of `RobotModel.payload_regressor`. What a
model adds to that, such as friction that grows with the torque, is found by differences: small
point masses are added to the load, which leave it a body that can exist.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from hil.arms import Payload
from hil.core import BoolArray, FitError, FloatArray
from hil.data import Dataset, FilterSettings, Prediction, is_prepared, rows_of
from hil.dynamics import joint_columns
from hil.estimators.base import RobotEstimator, prepared
from hil.estimators.load_body import LENGTH_M, payload_of, point_masses

Friction = Literal["model", "offset", "scale"]

PROBE = 1e-3
"""Point masses of the differences, as a share of the load's mass."""

ROUNDING = 1e-9
"""Effort beyond a rigid load's that all probes together have to make, or there is none."""

LEAST_ROWS = 200


def with_identified(dataset: Dataset, payload: Payload) -> Dataset:
    """The same samples, with this load instead of the declared one."""
    conditions = tuple(replace(c, payload_identified=payload) for c in dataset.conditions)
    return replace(dataset, conditions=conditions)


class Linearised(NamedTuple):
    """A prediction and its derivatives at the rows that count.

    Attributes:
        effort: (M, n) predicted.
        load: (M·n, 10) derivative by the load's parameters.
        friction: (M·n, k) columns of the correction.
    """

    effort: FloatArray
    load: FloatArray
    friction: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LoadProblem:
    """What does not change from step to step.

    Attributes:
        model: The model of the arm.
        data: Filtered, every row.
        keep: (N,) rows that count.
        kept: The rows that count.
        bare: Their prediction with nothing mounted.
        rigid: (M·n, 10) derivative of the effort by a rigid load alone.
        friction: See `hil.estimators.payload_fit.estimate_payload`.
    """

    model: RobotEstimator
    data: Dataset
    keep: BoolArray
    kept: Dataset
    bare: Prediction
    rigid: FloatArray
    friction: Friction

    @staticmethod
    def of(
        model: RobotEstimator, dataset: Dataset, friction: Friction, rows: BoolArray | None
    ) -> LoadProblem:
        """Filter a recording as the model was fitted, and take the rows (N,) that count.

        Raises:
            FitError: They are too few.
            DataError: The recording is not for this model.
        """
        data = _filtered(model, dataset)
        bare = model.predict(with_identified(data, Payload()))
        keep = np.all(bare.valid, axis=1)
        if rows is not None:
            keep = keep & np.asarray(rows, dtype=bool)
        kept = rows_of(data, keep)
        if len(kept) < LEAST_ROWS:
            raise FitError(
                f"{len(kept)} rows are too few to tell a load: at least {LEAST_ROWS} are needed",
                hint="record the arm with the load on a motion of some seconds",
            )
        W = model.robot_.payload_regressor(*(kept[name] for name in ("q_f", "qd_f", "qdd_f")))
        rigid = W / np.tile(model.torque_scale_, len(kept))[:, None]
        return LoadProblem(model, data, keep, kept, _only(bare, keep), rigid, friction)

    @property
    def target(self) -> FloatArray:
        """(M, n) measured effort, filtered."""
        return self.kept["effort_f"]

    def predict(self, parameters: FloatArray) -> Prediction:
        """Of the rows that count, under a load (10,)."""
        load = payload_of(parameters)
        return _only(self.model.predict(with_identified(self.data, load)), self.keep)

    def columns(self, prediction: Prediction) -> FloatArray:
        """(M·n, k) of the correction of friction."""
        terms = {"offset": np.ones_like(prediction.effort)}
        if self.friction == "scale" and "friction" in prediction.components:
            terms["scale"] = prediction.components["friction"]
        if self.friction == "model":
            return np.empty((prediction.effort.size, 0))
        return joint_columns(terms)

    def jacobian(self, parameters: FloatArray, here: Prediction) -> FloatArray:
        """(M·n, 10) derivative at a load, all that the model adds to a rigid one included.

        Eleven predictions where it adds something, one where it does not.
        """
        probes = point_masses(PROBE * float(parameters[0]), LENGTH_M)
        together = self._beyond_rigid(here, parameters, probes.sum(axis=0))
        if np.max(np.abs(together)) <= ROUNDING:
            return self.rigid
        beyond = np.array([self._beyond_rigid(here, parameters, probe) for probe in probes])
        # Row by row: beyond = probes · ∂/∂φ.
        return self.rigid + np.linalg.solve(probes, beyond).T

    def _beyond_rigid(
        self, here: Prediction, parameters: FloatArray, added: FloatArray
    ) -> FloatArray:
        """(M·n,) by how much a prediction changes more than the torque of a rigid load."""
        change = self.predict(parameters + added).effort - here.effort
        left: FloatArray = change.ravel() - self.rigid @ added
        return left


def _filtered(model: RobotEstimator, dataset: Dataset) -> Dataset:
    if is_prepared(dataset):
        return dataset
    given = getattr(model, "filters_", None) or getattr(model, "filters", None)
    return prepared(dataset, given if isinstance(given, FilterSettings) else FilterSettings())


def _only(prediction: Prediction, keep: BoolArray) -> Prediction:
    return Prediction(
        prediction.effort[keep],
        prediction.std[keep],
        prediction.valid[keep],
        {name: part[keep] for name, part in prediction.components.items()},
    )
