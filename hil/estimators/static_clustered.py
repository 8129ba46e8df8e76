"""Static models whose parameters come with standard errors clustered by pose."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hil.core import FloatArray, IntArray
from hil.data import Dataset
from hil.dynamics import RobotModel
from hil.estimators.checks import Needs, require_motion, require_varied
from hil.estimators.covariance import interval
from hil.estimators.dwell_rows import pose_numbers, short_dwells
from hil.estimators.gravity import reach_of
from hil.estimators.static_model import StaticModel

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
