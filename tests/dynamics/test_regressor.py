"""Regressors of many samples at once against Pinocchio, sample by sample."""

import numpy as np
import pinocchio as pin
import pytest

import hil.dynamics.regressor as module
from hil.arms import arm_names
from hil.core.errors import DataError
from hil.dynamics import RobotModel, base_parameters
from tests.support.dynamics_arms import motion

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


@pytest.fixture(autouse=True)
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


@pytest.mark.parametrize("name", arm_names())
def test_many_samples_give_pinocchios_regressor(name):
    robot = RobotModel.from_arm(name)
    rows = motion(SAMPLES, robot.n)
    np.testing.assert_allclose(
        robot.regressor(*rows), sample_by_sample(robot, *rows), rtol=0, atol=1e-10
    )


def test_oblique_and_sliding_joints_behind_fixed_ones_on_a_slope(odd):
    rows = motion(SAMPLES, odd.n)
    np.testing.assert_allclose(
        odd.regressor(*rows), sample_by_sample(odd, *rows), rtol=0, atol=1e-10
    )


def test_torques_of_the_odd_arm_follow_from_its_parameters(odd):
    rows = motion(SAMPLES, odd.n)
    torque = odd.regressor(*rows) @ odd.parameters()
    np.testing.assert_allclose(torque, odd.inverse_dynamics(*rows).ravel(), atol=1e-9)


@pytest.mark.parametrize("samples", [3, SAMPLES])
def test_chosen_columns_are_those_of_the_whole_regressor(odd, samples):
    rows = motion(samples, odd.n)
    columns = np.array([0, 3, 17, 22, 23, 29, 40, 69, 71, 76])
    np.testing.assert_allclose(
        odd.regressor(*rows, columns=columns), odd.regressor(*rows)[:, columns], atol=1e-12
    )


def test_base_columns_are_those_that_reduce_picks():
    robot, rows = RobotModel.from_arm("ur10e"), motion(SAMPLES)
    base = base_parameters(robot)
    np.testing.assert_array_equal(base.regressor(robot, *rows), base.reduce(robot.regressor(*rows)))


def test_without_numba_the_regressor_is_the_same(monkeypatch, odd):
    rows = motion(SAMPLES, odd.n)
    compiled = odd.regressor(*rows)
    monkeypatch.setattr(module, "_has_numba", lambda: False)
    np.testing.assert_allclose(odd.regressor(*rows), compiled, rtol=0, atol=1e-10)


def test_many_torques_are_pinocchios(odd):
    q, qd, qdd = motion(SAMPLES, odd.n)
    data = odd._model.createData()
    expected = [pin.rnea(odd._model, data, *row) for row in zip(q, qd, qdd, strict=True)]
    np.testing.assert_allclose(odd.inverse_dynamics(q, qd, qdd), expected, rtol=0, atol=1e-10)


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


def test_torque_of_base_parameters_set_among_zeros_is_the_robots():
    robot, rows = RobotModel.from_arm("ur5", rotor_inertia=[0.5] * 6), motion(SAMPLES)
    base = base_parameters(robot)
    some = base.expand(base.combine(robot.parameters()))
    np.testing.assert_allclose(robot.torque(some, *rows), robot.inverse_dynamics(*rows), atol=1e-8)


def test_rows_without_any_sample_are_an_empty_regressor():
    assert RobotModel.from_arm("ur5").regressor(*np.empty((3, 0, 6))).shape == (0, 66)


@pytest.mark.parametrize("columns", [[3, 3], [5, 2], [-1, 4], [60, 66]])
def test_columns_that_do_not_ascend_or_exist_are_refused(columns):
    with pytest.raises(DataError, match="do not ascend"):
        RobotModel.from_arm("ur5").regressor(*motion(1), columns=np.array(columns))
