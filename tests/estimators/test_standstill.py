"""What fitted models say about an arm at rest, against Pinocchio on an arm that is known."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from hil.arms.payload import Payload
from hil.core.errors import DataError, FitError
from hil.data.prediction import Prediction
from hil.dynamics import load_model
from hil.estimators.rigid_hysteresis import RigidHysteresis
from hil.estimators.rigid_linear import RigidWls
from hil.estimators.standstill import at_rest_effort, dry_friction, gravity_torque
from hil.estimators.static_model import StaticWls
from tests.support.dynamics_arms import urdf, written
from tests.support.synthetic_motion import COULOMB, GAINS, LOAD, OFFSET, dwelling, moving, nominal

POSES = np.random.default_rng(4).uniform(-3.0, 3.0, (30, 6))


@pytest.fixture(scope="module")
def pinocchio_gravity(tmp_path_factory):
    """Torques [N·m] of the UR5's URDF, by Pinocchio alone."""
    path = written(tmp_path_factory.mktemp("arm"), urdf("ur5"))
    model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    return np.array([pin.computeGeneralizedGravity(model, data, q).copy() for q in POSES])


@pytest.mark.parametrize(
    "model",
    [
        StaticWls().fit(dwelling(80, noise_a=0.0), nominal()),
        StaticWls(form="paper").fit(dwelling(80, noise_a=0.0), nominal()),
        RigidWls().fit(moving(1, 2, 3), nominal()),
    ],
    ids=["shared", "paper", "rigid"],
)
def test_torque_is_gravity_alone_in_newton_metres(model, pinocchio_gravity) -> None:
    assert gravity_torque(model, POSES) == pytest.approx(pinocchio_gravity, abs=1e-4)


def test_a_load_is_added(tmp_path) -> None:
    x, y, z = LOAD.com
    tool = (
        '<link name="load"><inertial><mass value="2"/><origin xyz="0 0 0"/><inertia ixx="0.01" '
        'iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="grip" '
        f'type="fixed"><parent link="tool0"/><child link="load"/><origin xyz="{x} {y} {z}"/>'
        "</joint>"
    )
    model = pin.buildModelFromUrdf(str(written(tmp_path, urdf("ur5", extra=tool))))
    data = model.createData()
    expected = [pin.computeGeneralizedGravity(model, data, q).copy() for q in POSES]
    fitted = StaticWls().fit(dwelling(80, noise_a=0.0), nominal())
    assert gravity_torque(fitted, POSES, LOAD) == pytest.approx(np.array(expected), abs=1e-4)


@pytest.mark.parametrize(
    "model",
    [
        StaticWls().fit(dwelling(80, noise_a=0.0), nominal()),
        RigidWls().fit(moving(1, 2, 3), nominal()),
    ],
    ids=["static", "rigid"],
)
def test_offset_is_told_apart_from_gravity(model) -> None:
    assert at_rest_effort(model, POSES)["offset"][3] == pytest.approx(OFFSET / GAINS, abs=1e-4)


def test_dry_friction_of_a_dynamic_model_is_its_coulomb_level() -> None:
    assert dry_friction(RigidWls().fit(moving(1, 2, 3), nominal())) == pytest.approx(
        COULOMB, rel=1e-3
    )


def test_a_model_of_gravity_alone_knows_no_friction() -> None:
    assert dry_friction(StaticWls().fit(dwelling(80), nominal())) is None


def test_a_model_may_say_its_friction_itself() -> None:
    class Sticky(StaticWls):
        def dry_friction(self):
            return np.arange(6.0)

    assert dry_friction(Sticky().fit(dwelling(80), nominal())) == pytest.approx(np.arange(6.0))


@pytest.mark.thorough
def test_friction_with_memory_has_gravity_and_no_one_level_of_dry_friction() -> None:
    fast = {"friction": ("core",), "fit_shapes": False, "consistent": False}
    model = RigidHysteresis(**fast).fit(moving(1, 2, 3), nominal())
    assert dry_friction(model) is None
    assert gravity_torque(model, POSES).shape == POSES.shape


def test_currents_without_gains_have_no_torque() -> None:
    model = StaticWls(form="paper").fit(replace(dwelling(80), drive_gains=None), nominal())
    with pytest.raises(FitError, match="drive gains"):
        gravity_torque(model, POSES)
    assert dry_friction(model) is None


def test_a_model_without_gravity_is_refused() -> None:
    class Lump(StaticWls):
        def predict(self, dataset):
            whole = super().predict(dataset)
            return Prediction(whole.effort, whole.std, whole.valid, {"network": whole.effort})

    with pytest.raises(FitError, match="it predicts network"):
        gravity_torque(Lump().fit(dwelling(80), nominal()), POSES)


def test_positions_of_another_arm_are_refused() -> None:
    model = StaticWls().fit(dwelling(80), nominal())
    with pytest.raises(DataError, match="6 joints"):
        gravity_torque(model, POSES[:, :5])


def test_an_arm_mounted_otherwise_keeps_its_own_gravity() -> None:
    hung = load_model("ur5", gravity=(0.0, 0.0, 9.81))
    data = replace(dwelling(80, noise_a=0.0), gravity=(0.0, 0.0, 9.81))
    upside_down = replace(
        data, columns={**data.columns, "effort": 2 * OFFSET / GAINS - data["effort"]}
    )
    model = StaticWls().fit(upside_down, hung)
    assert gravity_torque(model, POSES) == pytest.approx(hung.gravity(POSES), abs=1e-4)


def test_an_empty_load_changes_nothing() -> None:
    model = StaticWls().fit(dwelling(80), nominal())
    assert np.array_equal(gravity_torque(model, POSES, Payload()), gravity_torque(model, POSES))
