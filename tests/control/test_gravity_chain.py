"""Gravity in plain arithmetic against Pinocchio's."""

import numpy as np
import pinocchio as pin
import pytest

from hil.control.hand_guiding import GravityChain
from hil.dynamics import RobotModel
from hil.estimators.standstill import gravity_torque
from hil.estimators.static_model import StaticWls
from tests.support.dynamics_arms import urdf, written
from tests.support.synthetic_motion import LOAD, dwelling, nominal, plant

POSES = np.random.default_rng(8).uniform(-3.0, 3.0, (20, 6))


def torques(chain, poses):
    out, rows = [0.0] * poses.shape[1], []
    for q in poses:
        chain.write(q, out)
        rows.append(list(out))
    return np.array(rows)


def skewed(text: str) -> str:
    """The same arm with an axis along no coordinate, and one joint that slides."""
    parts = text.split('<axis xyz="0 0 1"/>')
    text = '<axis xyz="0 0 1"/>'.join(parts[:2]) + '<axis xyz="0.36 0.48 0.8"/>'
    text += '<axis xyz="0 0 1"/>'.join(parts[2:])
    return text.replace(
        'name="wrist_1_joint" type="revolute"', 'name="wrist_1_joint" type="prismatic"'
    )


@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.81), (3.0, -5.0, 7.0)], ids=["level", "tilted"])
@pytest.mark.parametrize("change", [str, skewed], ids=["ur5", "skew and sliding"])
def test_chain_of_a_urdf_arm_has_pinocchios_gravity(tmp_path, change, gravity) -> None:
    path = written(tmp_path, change(urdf("ur5")))
    model = pin.buildModelFromUrdf(str(path))
    model.gravity.linear = np.array(gravity)
    data = model.createData()
    expected = [pin.computeGeneralizedGravity(model, data, q).copy() for q in POSES]
    moments = [body.toDynamicParameters()[:4] for body in list(model.inertias)[1:]]
    chain = GravityChain(RobotModel.from_urdf(path, gravity=gravity), np.array(moments))
    assert torques(chain, POSES) == pytest.approx(np.array(expected), abs=1e-10)


@pytest.mark.parametrize("load", [None, LOAD], ids=["bare", "loaded"])
def test_chain_of_a_fitted_model_is_its_gravity(load) -> None:
    model = StaticWls().fit(dwelling(80, noise_a=0.05), nominal())
    chain = GravityChain.of(model, load)
    assert torques(chain, POSES) == pytest.approx(gravity_torque(model, POSES, load), abs=1e-8)


def test_chain_of_a_perfect_fit_is_the_plants_gravity() -> None:
    chain = GravityChain.of(StaticWls().fit(dwelling(80, noise_a=0.0), nominal()))
    assert torques(chain, POSES) == pytest.approx(plant().gravity(POSES), abs=1e-4)


def test_joints_fitted_each_by_itself_have_no_chain() -> None:
    model = StaticWls(form="paper").fit(dwelling(80, noise_a=0.05), nominal())
    assert GravityChain.of(model) is None
