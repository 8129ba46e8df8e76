"""The regressor of rigid dynamics, interpreted and compiled, and its gradient."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import hil.dynamics.regressor as module
from hil.arms import arm_names
from hil.core.errors import DataError
from hil.core.typing import FloatArray
from hil.dynamics import RobotModel, base_parameters
from hil.dynamics.base import log_condition, neg_log_det
from hil.dynamics.build import model_from_arm
from hil.dynamics.regressor_gradient import IdentificationColumns, RegressorSweep
from tests.support.dynamics_arms import motion

# Regressors of many samples at once against Pinocchio, sample by sample


SAMPLES = 203
URDF = """<robot name="odd"><link name="base"/>
<link name="plate"/>
<joint name="bolted" type="fixed"><parent link="base"/><child link="plate"/>
<origin xyz="0.1 -0.2 0.3" rpy="0.3 -0.2 0.1"/></joint>
{links}
</robot>"""
LINK = """<link name="l{i}"><inertial><origin xyz="0.1 {i}e-2 -0.05" rpy="0.1 0.2 0.3"/>
<mass value="{i}.5"/><inertia ixx="0.2" iyy="0.3" izz="0.4" ixy="0.01" ixz="-0.02" iyz="0.03"/>
</inertial></link>
<joint name="j{i}" type="{kind}"><parent link="{parent}"/><child link="l{i}"/>
<origin xyz="0.2 0.{i} -0.1" rpy="{i} 0.5 -0.4"/><axis xyz="{axis}"/>
<limit lower="-3" upper="3" velocity="2" effort="9"/></joint>"""


@pytest.fixture
def _compiled_from_a_hundred(monkeypatch):
    monkeypatch.setattr(module, "COMPILED_FROM", 100)


JOINTS = (
    ("revolute", "0.2 -0.5 0.7"),
    ("prismatic", "0 1 0"),
    ("continuous", "-1 0 0"),
    ("revolute", "0 0 -1"),
    ("prismatic", "0.6 0.3 -0.2"),
    ("revolute", "0 1 0"),
    ("revolute", "1 1 0"),
)


@pytest.fixture
def odd(tmp_path):
    """Sliding and oblique joints behind a fixed one, with rotors, hung from a slope."""
    parents = ("plate", *(f"l{i}" for i in range(1, 7)))
    links = (
        LINK.format(i=i, kind=kind, axis=axis, parent=parent)
        for i, ((kind, axis), parent) in enumerate(zip(JOINTS, parents, strict=True), start=1)
    )
    path = tmp_path / "odd.urdf"
    path.write_text(URDF.format(links="\n".join(links)))
    return RobotModel.from_urdf(path, rotor_inertia=np.arange(7.0), gravity=(3.0, -4.0, 7.0))


def sample_by_sample(robot, q, qd, qdd):
    model = robot._model
    data = model.createData()
    rows = zip(q, qd, qdd, strict=True)
    body = [np.array(pin.computeJointTorqueRegressor(model, data, *row)) for row in rows]
    rotors = [np.diag(row) for row in qdd]
    return np.hstack([np.vstack(body), np.vstack(rotors)])


@pytest.mark.usefixtures("_compiled_from_a_hundred")
@pytest.mark.parametrize("name", arm_names())
def test_many_samples_give_pinocchios_regressor(name):
    robot = RobotModel.from_arm(name)
    rows = motion(SAMPLES, robot.n)
    np.testing.assert_allclose(
        robot.regressor(*rows), sample_by_sample(robot, *rows), rtol=0, atol=1e-10
    )


@pytest.mark.usefixtures("_compiled_from_a_hundred")
def test_oblique_and_sliding_joints_behind_fixed_ones_on_a_slope(odd):
    rows = motion(SAMPLES, odd.n)
    np.testing.assert_allclose(
        odd.regressor(*rows), sample_by_sample(odd, *rows), rtol=0, atol=1e-10
    )


@pytest.mark.usefixtures("_compiled_from_a_hundred")
def test_torques_of_the_odd_arm_follow_from_its_parameters(odd):
    rows = motion(SAMPLES, odd.n)
    torque = odd.regressor(*rows) @ odd.parameters()
    np.testing.assert_allclose(torque, odd.inverse_dynamics(*rows).ravel(), atol=1e-9)


@pytest.mark.usefixtures("_compiled_from_a_hundred")
@pytest.mark.parametrize("samples", [3, SAMPLES])
def test_chosen_columns_are_those_of_the_whole_regressor(odd, samples):
    rows = motion(samples, odd.n)
    columns = np.array([0, 3, 17, 22, 23, 29, 40, 69, 71, 76])
    np.testing.assert_allclose(
        odd.regressor(*rows, columns=columns), odd.regressor(*rows)[:, columns], atol=1e-12
    )


@pytest.mark.usefixtures("_compiled_from_a_hundred")
def test_base_columns_are_those_that_reduce_picks():
    robot, rows = RobotModel.from_arm("ur10e"), motion(SAMPLES)
    base = base_parameters(robot)
    np.testing.assert_array_equal(base.regressor(robot, *rows), base.reduce(robot.regressor(*rows)))


@pytest.mark.usefixtures("_compiled_from_a_hundred")
def test_without_numba_the_regressor_is_the_same(monkeypatch, odd):
    rows = motion(SAMPLES, odd.n)
    compiled = odd.regressor(*rows)
    monkeypatch.setattr(module, "_has_numba", lambda: False)
    np.testing.assert_allclose(odd.regressor(*rows), compiled, rtol=0, atol=1e-10)


@pytest.mark.usefixtures("_compiled_from_a_hundred")
def test_many_torques_are_pinocchios(odd):
    q, qd, qdd = motion(SAMPLES, odd.n)
    data = odd._model.createData()
    expected = [pin.rnea(odd._model, data, *row) for row in zip(q, qd, qdd, strict=True)]
    np.testing.assert_allclose(odd.inverse_dynamics(q, qd, qdd), expected, rtol=0, atol=1e-10)


@pytest.mark.usefixtures("_compiled_from_a_hundred")
@pytest.mark.parametrize("samples", [3, SAMPLES])
def test_torque_of_any_parameters_is_regressor_times_parameters(odd, samples):
    rows = motion(samples, odd.n)
    parameters = np.random.default_rng(0).normal(size=11 * odd.n)
    np.testing.assert_allclose(
        odd.torque(parameters, *rows).ravel(),
        odd.regressor(*rows) @ parameters,
        rtol=0,
        atol=1e-9,
    )


@pytest.mark.usefixtures("_compiled_from_a_hundred")
def test_torque_of_base_parameters_set_among_zeros_is_the_robots():
    robot, rows = RobotModel.from_arm("ur5", rotor_inertia=[0.5] * 6), motion(SAMPLES)
    base = base_parameters(robot)
    some = base.expand(base.combine(robot.parameters()))
    np.testing.assert_allclose(robot.torque(some, *rows), robot.inverse_dynamics(*rows), atol=1e-8)


@pytest.mark.usefixtures("_compiled_from_a_hundred")
def test_rows_without_any_sample_are_an_empty_regressor():
    assert RobotModel.from_arm("ur5").regressor(*np.empty((3, 0, 6))).shape == (0, 66)


@pytest.mark.usefixtures("_compiled_from_a_hundred")
@pytest.mark.parametrize("columns", [[3, 3], [5, 2], [-1, 4], [60, 66]])
def test_columns_that_do_not_ascend_or_exist_are_refused(columns):
    with pytest.raises(DataError, match="are not in ascending order"):
        RobotModel.from_arm("ur5").regressor(*motion(1), columns=np.array(columns))


# Regressors of many samples with their derivative, against Pinocchio and finite differences


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


def smooth_motion(robot: RobotModel, samples: int) -> FloatArray:
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
    data, (q, qd, qdd) = model.createData(), smooth_motion(RobotModel.from_arm("ur5"), 7)
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
    at = smooth_motion(robot, 3)
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
    at = smooth_motion(ur5, 24)

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
    q, qd, qdd = smooth_motion(robot, 50)
    effort = robot.inverse_dynamics(q, qd, qdd) + 3.0 * np.tanh(qd / 0.01) + 2.0 * qd - 1.0
    base = base_parameters(robot, rotor=True).combine(robot.parameters(rotor=True))
    theta = np.r_[base, np.full(6, 3.0), np.full(6, 2.0), np.full(6, -1.0)]
    assert len(columns) == len(theta)
    torque = theta @ columns.rows(q, qd, qdd).transposed
    np.testing.assert_allclose(torque.reshape(6, 50).T, effort, atol=1e-10)


def test_motors_that_move_two_joints_get_rows_and_gradients_of_their_own() -> None:
    robot = _coupled()
    columns = IdentificationColumns(robot, rotor=True)
    at = smooth_motion(robot, 2)
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
