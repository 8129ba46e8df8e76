"""Base parameters: published ranks, equal predictions, stability against the samples."""

import numpy as np
import pytest

from hil.core.errors import FitError
from hil.dynamics import BaseParameters, RobotModel, base_parameters, conditioning
from tests.support.dynamics_arms import UR_ARMS, motion


@pytest.mark.parametrize("name", UR_ARMS)
def test_ur_arms_have_36_base_parameters_and_40_with_rotor_inertias(name):
    # 36: e.g. Gaz et al. 2014 for arms of this build; 40 with rotors: Mamedov and Mikhel 2020.
    model = RobotModel.from_arm(name)
    assert base_parameters(model, rotor=False).rank == 36
    assert base_parameters(model, rotor=True).rank == 40


def test_gravity_sees_two_first_moments_of_every_link_but_the_first():
    base = base_parameters(RobotModel.from_arm("ur5"), gravity_only=True)
    assert [name.split()[0] for name in base.names] == [
        f"{moment}_{link}" for link in range(2, 7) for moment in ("mx", "my")
    ]


@pytest.mark.parametrize("gravity_only", [True, False])
def test_base_parameters_predict_the_same_torque_elsewhere(gravity_only):
    model = RobotModel.from_arm("ur10e", [0.7, 3.7, 0.5, 0.1, 0.2, 0.4])
    base = base_parameters(model, gravity_only=gravity_only)
    q, qd, qdd = motion(30, seed=99)
    if gravity_only:
        W, full, torque = (
            model.gravity_regressor(q),
            model.parameters(rotor=False),
            model.gravity(q),
        )
    else:
        W, full = model.regressor(q, qd, qdd), model.parameters()
        torque = model.inverse_dynamics(q, qd, qdd)
    reduced = base.reduce(W) @ base.combine(full)
    np.testing.assert_allclose(reduced, torque.ravel(), atol=1e-9)
    np.testing.assert_allclose(W @ base.expand(base.combine(full)), torque.ravel(), atol=1e-9)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_samples_do_not_decide_what_is_a_base_parameter(seed):
    model = RobotModel.from_arm("ur5")
    first, other = base_parameters(model, seed=0), base_parameters(model, seed=seed)
    assert first.names == other.names
    np.testing.assert_array_equal(first.independent, other.independent)
    np.testing.assert_array_equal(first.combination, other.combination)


def test_names_say_what_is_lumped_together():
    names = base_parameters(RobotModel.from_arm("ur5"), rotor=False).names
    assert "mx_3 - 0.39225 m_4 - 0.39225 m_5 - 0.39225 m_6" in names
    assert "Izz_6" in names


def test_columns_of_another_scale_count_as_much():
    random = np.random.default_rng(0)
    W = random.normal(size=(50, 4)) * [1e6, 1.0, 1e-3, 1.0]
    W[:, 3] = W[:, 1] - 2e3 * W[:, 2]
    base = BaseParameters.from_regressor(W, ("a", "b", "c", "d"))
    assert base.names == ("a", "b + d", "c - 2000 d")


@pytest.mark.parametrize(
    ("W", "message"),
    [
        (np.ones((2, 3)), "cannot tell 3 parameters apart"),
        (np.full((5, 3), np.nan), "NaN"),
        (np.zeros((5, 3)), "zeros"),
    ],
)
def test_a_useless_regressor_is_refused(W, message):
    with pytest.raises(FitError, match=message):
        BaseParameters.from_regressor(W, ("a", "b", "c"))


def test_conditioning_is_that_of_the_singular_values():
    W = np.random.default_rng(1).normal(size=(200, 5)) * [1, 10, 100, 1, 1]
    numbers = conditioning(W)
    singular = np.linalg.svd(W, compute_uv=False)
    assert numbers.raw == pytest.approx(singular[0] / singular[-1])
    scaled = np.linalg.svd(W / np.linalg.norm(W, axis=0), compute_uv=False)
    assert numbers.scaled == pytest.approx(scaled[0] / scaled[-1])
    assert numbers.scaled < numbers.raw
    assert conditioning(np.hstack([W, 0 * W[:, :1]])).raw == np.inf
