"""Hand guiding: what it commands, what it refuses, and an arm of the mock led by it."""

from dataclasses import replace

import numpy as np
import pytest

from hil.control.hand_guiding import HandGuiding
from hil.core.errors import DataError, FitError, SpecError
from hil.estimators.rigid_hysteresis import RigidHysteresis
from hil.estimators.rigid_linear import RigidWls
from hil.estimators.static_model import StaticWls
from tests.support.synthetic_motion import (
    COULOMB,
    GAINS,
    LOAD,
    OFFSET,
    dwelling,
    moving,
    nominal,
    plant,
)

Q = np.array([0.3, -1.2, 0.9, -0.4, 0.7, 0.2])
STILL = np.zeros(6)


@pytest.fixture(scope="module")
def static():
    return StaticWls().fit(dwelling(80, noise_a=0.0), nominal())


@pytest.fixture(scope="module")
def rigid():
    return RigidWls().fit(moving(1, 2, 3), nominal())


def test_at_rest_it_is_gravity_and_offset_in_the_models_unit(rigid) -> None:
    guiding = HandGuiding(rigid)
    expected = (plant().gravity(Q[None])[0] + OFFSET) / GAINS
    assert guiding.unit == "A"
    assert guiding(Q, STILL) == pytest.approx(expected, abs=1e-4)


def test_a_model_of_torques_gives_torques() -> None:
    model = RigidWls().fit(moving(1, 2, 3, kind="torque"), nominal())
    guiding = HandGuiding(model)
    assert guiding.unit == "N·m"
    assert guiding(Q, STILL) == pytest.approx(plant().gravity(Q[None])[0] + OFFSET, abs=1e-3)


def test_the_load_is_carried(static) -> None:
    guiding = HandGuiding(static, LOAD, friction_share=0.0)
    held = plant().with_payload(LOAD).gravity(Q[None])[0]
    assert guiding(Q, STILL) == pytest.approx((held + OFFSET) / GAINS, abs=1e-4)


def test_a_share_of_the_models_friction_goes_with_the_motion(rigid) -> None:
    guiding = HandGuiding(rigid, friction_share=0.6)
    forth, back = guiding(Q, np.full(6, 0.2)), guiding(Q, np.full(6, -0.2))
    assert forth - guiding(Q, STILL) == pytest.approx(0.6 * COULOMB / GAINS, rel=1e-3)
    assert back - guiding(Q, STILL) == pytest.approx(-0.6 * COULOMB / GAINS, rel=1e-3)


def test_within_the_dead_band_there_is_no_friction(static) -> None:
    guiding = HandGuiding(static, friction=COULOMB, dead_band=0.02)
    assert np.array_equal(guiding(Q, np.full(6, 0.02)), guiding(Q, STILL))


def test_friction_sets_in_without_a_step(static) -> None:
    guiding = HandGuiding(static, friction=COULOMB)
    speeds = np.linspace(-0.1, 0.1, 2001)
    efforts = np.array([guiding(Q, np.full(6, v)) for v in speeds])
    steepest = np.abs(np.diff(efforts, axis=0)).max(axis=0) / (speeds[1] - speeds[0])
    assert np.all(steepest < 1.6 * 0.7 * COULOMB / GAINS / 0.04)
    assert np.all(np.diff(efforts, axis=0) >= -1e-12)


def test_it_never_puts_in_more_power_than_its_share_of_friction_takes_out(static) -> None:
    guiding = HandGuiding(static, friction=COULOMB, friction_share=0.7)
    rest = guiding(Q, STILL)
    for qd in np.random.default_rng(0).normal(0.0, 0.05, (300, 6)):
        given = (guiding(Q, qd) - rest) * GAINS * qd
        assert np.all(given <= 0.7 * COULOMB * np.abs(qd) + 1e-9)
        assert np.all(given >= -1e-9)


def test_efforts_end_at_the_limits(static) -> None:
    limit = np.array([0.1, 2.0, 0.5, 0.1, 0.1, 0.1])
    effort = HandGuiding(static, friction=COULOMB, limit=limit)(Q, np.ones(6))
    assert np.all(np.abs(effort) <= limit)
    assert effort[0] == 0.1


def test_by_default_the_limits_are_the_robots_torques() -> None:
    heavy = replace(LOAD, mass=500.0)
    model = StaticWls().fit(dwelling(80, noise_a=0.0), nominal())
    effort = HandGuiding(model, heavy, friction_share=0.0)(Q, STILL)
    assert np.abs(effort[1]) == pytest.approx(nominal().effort_max[1] / GAINS[1])


@pytest.mark.parametrize("broken", ["position", "velocity"])
def test_sensors_that_are_not_read_stop_it(static, broken) -> None:
    guiding, out = HandGuiding(static, friction=COULOMB), np.full(6, 9.0)
    bad = np.where(np.arange(6) == 2, np.nan, 0.1)
    with pytest.raises(DataError, match="elbow_joint"):
        guiding.write(
            bad if broken == "position" else Q, STILL if broken == "position" else bad, out
        )
    assert not out.any()


def test_the_drift_margin_is_the_friction_that_is_left(static) -> None:
    guiding = HandGuiding(static, friction=COULOMB, friction_share=0.75)
    assert guiding.drift_margin == pytest.approx(0.25 * COULOMB)


def test_a_model_without_friction_asks_for_it(static) -> None:
    with pytest.raises(FitError, match="contains no dry friction"):
        HandGuiding(static)


def test_friction_that_remembers_gives_what_it_slides_with() -> None:
    fast = {"friction": ("core",), "fit_shapes": False, "consistent": False}
    guiding = HandGuiding(RigidHysteresis(**fast).fit(moving(1, 2, 3), nominal()))
    assert guiding.drift_margin == pytest.approx(0.5 * COULOMB, rel=0.2)


@pytest.mark.parametrize("share", [1.0, -0.1, float("nan")])
def test_a_share_that_could_drive_the_arm_is_refused(static, share) -> None:
    with pytest.raises(SpecError, match="below 1"):
        HandGuiding(static, friction=COULOMB, friction_share=share)


def test_currents_without_gains_need_limits_of_their_own() -> None:
    model = StaticWls(form="paper").fit(replace(dwelling(80), drive_gains=None), nominal())
    with pytest.raises(FitError, match="do not limit currents"):
        HandGuiding(model, friction_share=0.0)
    guiding = HandGuiding(model, friction_share=0.0, limit=[20.0] * 6)
    expected = (plant().gravity(Q[None])[0] + OFFSET) / GAINS
    assert guiding(Q, STILL) == pytest.approx(expected, abs=0.01)


def test_friction_of_another_arm_is_refused(static) -> None:
    with pytest.raises(SpecError, match="6 numbers"):
        HandGuiding(static, friction=[1.0, 2.0])
