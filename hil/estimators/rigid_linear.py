"""Rigid-body models that are linear in base parameters and friction, whatever solves them.

The base regressor of the arm (rotor inertias included) is set beside three friction columns per
joint, tanh(qd/width), qd and 1, and fitted to K·i. What is subtracted (declared loads), how signals
are filtered and how a fitted model predicts is the same for every method; a method overrides the
one step that turns observations into coefficients.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, Self

import numpy as np

from hil.core import FloatArray
from hil.data import Dataset, FilterSettings, Prediction, SeriesKind
from hil.dynamics import RobotModel, base_parameters, friction_terms, joint_columns
from hil.estimators.base import chunks, payload_torque, prepared, training_rows
from hil.estimators.checks import Needs, require_clean, require_motion, require_robot, torque_scale
from hil.estimators.friction_curve import FrictionCurve, curve_of
from hil.estimators.least_squares import JointwiseQR, Solution
from hil.estimators.parameters import number, settings
from hil.estimators.plausible import require_plausible
from hil.estimators.wls import WlsEstimator

MOTION = ("q_f", "qd_f", "qdd_f")
TERMS = ("coulomb", "viscous", "offset")
"""Friction columns per joint."""


class RigidLinear(WlsEstimator):
    """Base of the estimators of base rigid-body parameters and Coulomb–viscous friction.

    Args:
        sign_width: Width of the tanh that stands for sign(qd) [rad/s]; 0 for the hard sign.
        filters: Preprocessing of training and prediction alike, a `FilterSettings` or its dict.

    Attributes:
        parameter_names_: Base parameters, then `coulomb`, `viscous`, `offset` per joint.
    """

    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",), ("move",))

    def __init__(
        self,
        *,
        sign_width: float = 0.01,
        filters: FilterSettings | dict[str, Any] | None = None,
    ) -> None:
        self.sign_width = number("sign_width", sign_width, at_least=0.0)
        self.filters = settings("filters", filters, FilterSettings)

    @abstractmethod
    def _estimate(self, observed: JointwiseQR) -> Solution:
        """The step in which methods differ: coefficients from compressed observations."""

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what a fit cannot do without: as many samples as parameters, and drive gains."""
        links = base_parameters(robot, rotor=True).rank
        return Needs({"samples": links + robot.n * len(self._joint_terms())}, gains=True)

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit to every series given; declared loads are subtracted from the target.

        Raises:
            FitError: The data are too few, not finite, of another robot or unit, hold efforts
                that cannot be, or do not excite all parameters.
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
        """Effort per row from the filtered motion, split into its physical parts.

        Raises:
            DataError: The data are of another robot or unit, or cannot be filtered.
        """
        self.require_match(dataset)
        data = prepared(dataset, self.filters)
        return self._predict(data, *(data[name] for name in MOTION))

    def friction_curve(self, qd: FloatArray) -> FrictionCurve | None:
        """Friction at velocities (N, n) [rad/s]."""
        columns = np.stack(list(self._friction(qd).values()), axis=-1)
        of_joints = (-1, len(TERMS))
        values, errors = (
            every[-len(TERMS) * qd.shape[1] :].reshape(of_joints)
            for every in (self.coefficients_, self.std_error_)
        )
        return curve_of(TERMS, columns, values, errors)

    def _training_rows(self, dataset: Dataset) -> Dataset:
        """Prepared data, as many rows of them as the filters ask for."""
        return training_rows(dataset, self.filters)

    def _learn(self, data: Dataset) -> None:
        """Fit to prepared data; sets the fitted attributes."""
        self._adopt(data, self._estimate(self._compressed(data)))

    def _joint_terms(self) -> tuple[str, ...]:
        """Return the names of the terms that each joint has of its own."""
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
        """The friction columns of the fit by name, each (N, n)."""
        return self._friction(data["qd_f"])

    def _friction(self, qd: FloatArray) -> dict[str, FloatArray]:
        """Friction terms of velocities (N, n) by name, each (N, n)."""
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
