"""Regressors of many samples with their derivative, against Pinocchio and finite differences."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from hil.core.typing import FloatArray
from hil.dynamics import RobotModel, base_parameters
from hil.dynamics.base import log_condition, neg_log_det
from hil.dynamics.build import model_from_arm
from hil.dynamics.regressor_gradient import IdentificationColumns, RegressorSweep

SLIDE = """<robot name="slide"><link name="base"/>
<link name="cart"><inertial><mass value="2"/><origin xyz="0.1 0 0.2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="pole"><inertial><mass value="1"/><origin xyz="0 0.1 0.3"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="x" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0.5"/>
<origin xyz="0 0 0.3" rpy="0.1 0.2 0.3"/>
<limit lower="-1" upper="1" effort="10" velocity="1"/></joint>
<joint name="turn" type="revolute"><parent link="cart"/><child link="pole"/><axis xyz="0.2 1 0"/>
<origin xyz="0.2 0.1 0" rpy="0.4 0 0"/>
<limit lower="-1" upper="1" effort="10" velocity="1"/></joint></robot>"""


@pytest.fixture(scope="module")
def ur5() -> RobotModel:
    return RobotModel.from_arm("ur5", gravity=(1.0, -2.0, -9.0))


@pytest.fixture
def slide(tmp_path: Path) -> RobotModel:
    (tmp_path / "slide.urdf").write_text(SLIDE)
    return RobotModel.from_urdf(tmp_path / "slide.urdf")


def motion(robot: RobotModel, samples: int) -> FloatArray:
    return np.random.default_rng(1).uniform(-2.0, 2.0, (3, samples, robot.n))


def differences(
    function: Callable[[FloatArray], float], at: FloatArray, step: float = 1e-6
) -> FloatArray:
    out = np.empty(at.shape)
    for place in np.ndindex(at.shape):
        there, back = at.copy(), at.copy()
        there[place] += step
        back[place] -= step
        out[place] = (function(there) - function(back)) / (2.0 * step)
    return out


def test_the_columns_are_pinocchios_regressor() -> None:
    model = model_from_arm(RobotModel.from_arm("ur5").arm)  # type: ignore[arg-type]
    data, (q, qd, qdd) = model.createData(), motion(RobotModel.from_arm("ur5"), 7)
    theirs = [
        pin.computeJointTorqueRegressor(model, data, *row) for row in zip(q, qd, qdd, strict=True)
    ]
    ours = RegressorSweep.of(RobotModel.from_arm("ur5"), q, qd, qdd).columns
    np.testing.assert_allclose(ours.transpose(2, 1, 0), theirs, atol=1e-12)


@pytest.mark.parametrize("name", ["ur5", "slide"])
def test_any_scalar_of_the_regressor_has_the_gradient_of_finite_differences(
    name: str, request: pytest.FixtureRequest
) -> None:
    robot: RobotModel = request.getfixturevalue(name)
    at = motion(robot, 3)
    weights = np.random.default_rng(2).standard_normal((10 * robot.n, robot.n, 3))

    def scalar(x: FloatArray) -> float:
        return float(np.sum(weights * RegressorSweep.of(robot, *x).columns))

    gradient = np.stack(RegressorSweep.of(robot, *at).pull_back(weights))
    np.testing.assert_allclose(gradient, differences(scalar, at), rtol=1e-6, atol=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("measure", ["raw", "scaled", "log_det"])
def test_conditions_and_determinants_have_the_gradient_of_finite_differences(
    ur5: RobotModel, measure: str
) -> None:
    columns = IdentificationColumns(ur5, rotor=True, friction=True, sign_width=0.5)
    at = motion(ur5, 24)

    def of(x: FloatArray) -> tuple[float, FloatArray]:
        rows = columns.rows(*x)
        G = rows.transposed @ rows.transposed.T
        found = neg_log_det(G) if measure == "log_det" else log_condition(G, 4, measure != "raw")
        return found.value, np.stack(rows.pull_back(2.0 * found.gradient @ rows.transposed))

    some = [(k, i, j) for k in range(3) for i in (0, 11) for j in range(ur5.n)]
    gradient = of(at)[1]
    for place in some:
        there, back = at.copy(), at.copy()
        there[place] += 1e-5
        back[place] -= 1e-5
        slope = (of(there)[0] - of(back)[0]) / 2e-5
        assert gradient[place] == pytest.approx(slope, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("scaled", [False, True])
def test_the_smooth_condition_number_closes_in_on_numpys_from_above(scaled: bool) -> None:
    Y = np.random.default_rng(3).standard_normal((40, 8)) * np.logspace(0, 2, 8)
    unit = Y / np.linalg.norm(Y, axis=0) if scaled else Y
    exact = np.log(np.linalg.cond(unit))
    excess = [log_condition(Y.T @ Y, p, scaled).value - exact for p in (1.0, 10.0, 100.0)]
    assert np.all(np.diff(excess) < 0)
    assert -1e-9 < excess[-1] < np.log(8) / 100
    assert log_condition(Y.T @ Y, 1.0, scaled).exact == pytest.approx(np.exp(exact), rel=1e-6)


def test_rows_with_rotors_and_friction_explain_the_torques_of_a_robot_that_has_both() -> None:
    robot = RobotModel.from_arm("ur5", rotor_inertia=np.arange(1.0, 7.0))
    columns = IdentificationColumns(robot, rotor=True, friction=True)
    q, qd, qdd = motion(robot, 50)
    effort = robot.inverse_dynamics(q, qd, qdd) + 3.0 * np.tanh(qd / 0.01) + 2.0 * qd - 1.0
    base = base_parameters(robot, rotor=True).combine(robot.parameters(rotor=True))
    theta = np.r_[base, np.full(6, 3.0), np.full(6, 2.0), np.full(6, -1.0)]
    assert len(columns) == len(theta)
    torque = theta @ columns.rows(q, qd, qdd).transposed
    np.testing.assert_allclose(torque.reshape(6, 50).T, effort, atol=1e-10)


def test_motors_that_move_two_joints_get_rows_and_gradients_of_their_own() -> None:
    robot = _coupled()
    columns = IdentificationColumns(robot, rotor=True)
    at = motion(robot, 2)
    rows = columns.rows(*at)
    parameters = base_parameters(robot, rotor=True).combine(robot.parameters(rotor=True))
    torque = (parameters @ rows.transposed).reshape(robot.n, 2).T
    np.testing.assert_allclose(torque, robot.inverse_dynamics(*at), atol=1e-9)
    weights = np.random.default_rng(4).standard_normal(rows.transposed.shape)

    def scalar(x: FloatArray) -> float:
        return float(np.sum(weights * columns.rows(*x).transposed))

    gradient = np.stack(rows.pull_back(weights))
    np.testing.assert_allclose(gradient, differences(scalar, at), rtol=1e-5, atol=1e-5)


def _coupled() -> RobotModel:
    from hil.dynamics.robot_model import CoupledModel

    return CoupledModel.from_arm("tx40@motors", rotor_inertia=np.arange(1.0, 7.0))
