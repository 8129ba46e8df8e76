"""Collisions on the mock: none without contact, pushes in time and with their sign, loads."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.control.collision_detection import (
    FADES_S,
    CollisionDetector,
    CollisionThresholds,
    RestMargin,
    resting_friction,
)
from hil.core.errors import DataError, FitError, SpecError
from hil.dynamics import load_model
from hil.estimators.conformal import SpeedBands
from hil_mock_robot.plant.truth import draw_truth
from tests.support.collision_parts import (
    MIDDLE,
    RATE_HZ,
    Push,
    collisions_in,
    fitted,
    joint_torque,
    motion,
    quiet,
    recorded,
)
from tests.support.mock_motions import blend, hold

LOAD = Payload(3.0, (0.0, 0.0, 0.06), (0.005, 0.005, 0.004, 0.0, 0.0, 0.0))
FIRST = 150
SHORT_S = 4.0


@pytest.fixture(scope="module")
def model():
    return fitted(5)


@pytest.fixture(scope="module")
def calibration():
    return quiet(5, range(20, 26), SHORT_S)


@pytest.fixture(scope="module")
def thresholds(model, calibration):
    """Six motions: three compare the joints, and three promise one alarm in four."""
    return CollisionThresholds.calibrated(model, calibration, false_alarms=0.25)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [41, 42])
def test_motions_without_contact_alarm_nobody(model, seed) -> None:
    data = recorded(5, motion(seed, SHORT_S), noise=seed)
    found, residuals = collisions_in(CollisionDetector(model), data)
    assert found == []
    assert np.abs(residuals).max() > 0.5  # it does look


@pytest.mark.thorough
def test_another_arm_of_the_type_raises_no_alarm_with_a_model_of_its_own() -> None:
    data = recorded(6, motion(40, SHORT_S), noise=40)
    assert collisions_in(CollisionDetector(fitted(6)), data)[0] == []


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("force", "within_s"),
    [((0.0, 20.0, 0.0), 0.1), ((-40.0, 0.0, 10.0), 0.05)],
)
def test_a_push_at_the_flange_is_found_in_time(model, force, within_s) -> None:
    data = recorded(5, motion(43, SHORT_S), noise=43, push=Push(force, FIRST, FIRST + 40))
    ((collision, *again), _) = collisions_in(CollisionDetector(model), data)
    assert again == []
    start = data["t"][FIRST - 1]
    assert start < collision.since_s < collision.time_s <= start + within_s
    expected = joint_torque(force, data["q"][FIRST + 5])
    assert np.sign(collision.torque) == np.sign(expected[collision.index])
    assert abs(collision.torque) > collision.threshold
    assert collision.joint == model.joint_names_[collision.index]


@pytest.mark.thorough
def test_the_residual_is_the_torque_of_the_push(model) -> None:
    push = Push((0.0, 60.0, 0.0), FIRST, FIRST + 40)
    data = recorded(5, motion(43, SHORT_S), noise=43, push=push)
    _, residuals = collisions_in(CollisionDetector(model), data)
    held = slice(FIRST + 25, FIRST + 40)
    error = residuals[held].mean(axis=0) - joint_torque(push.force, data["q"][FIRST + 32])
    assert np.all(np.abs(error) < [3.0, 3.0, 3.0, 1.0, 1.0, 1.0])


@pytest.mark.thorough
def test_an_unknown_load_alarms_and_a_declared_one_does_not(model) -> None:
    data = recorded(5, motion(44, SHORT_S), noise=44, mounted=LOAD)
    unknown, _ = collisions_in(CollisionDetector(model), data)
    assert unknown[0].time_s < 0.2
    start = data["q"][:1]
    weight = load_model("ur5").payload_effort(LOAD, start, 0 * start, 0 * start)[0]
    assert np.sign(unknown[0].torque) == -np.sign(weight[unknown[0].index])
    assert collisions_in(CollisionDetector(model, LOAD), data)[0] == []


@pytest.mark.thorough
def test_a_declared_load_that_is_not_there_alarms(model) -> None:
    data = recorded(5, motion(44, SHORT_S), noise=44)
    assert collisions_in(CollisionDetector(model, LOAD), data)[0]


@pytest.mark.thorough
def test_calibrated_thresholds_are_lower_and_still_hold(model, thresholds) -> None:
    own = CollisionThresholds.of(model)
    assert thresholds.false_alarms == 0.25
    assert np.all(thresholds.level < own.level)
    data = recorded(5, motion(40, SHORT_S), noise=40)
    assert collisions_in(CollisionDetector(model, thresholds=thresholds), data)[0] == []


@pytest.mark.thorough
def test_calibrated_thresholds_are_those_that_their_motions_reach(
    model, calibration, thresholds
) -> None:
    """Three judged motions and a promise of one in four: the highest peak is the threshold."""

    def alarms(those: CollisionThresholds, motion: dict[str, np.ndarray]) -> bool:
        return bool(collisions_in(CollisionDetector(model, thresholds=those), motion)[0])

    just_below = replace(thresholds, level=0.999 * thresholds.level)
    (highest,) = (k for k in (1, 3, 5) if alarms(just_below, motion_of(calibration, k)))
    assert not alarms(thresholds, motion_of(calibration, highest))


def motion_of(data, k):
    rows = slice(*data.offsets[k : k + 2])
    return {name: data[name][rows] for name in ("t", "q", "qd", "effort")}


@pytest.mark.thorough
def test_a_load_of_the_calibration_counts(model, calibration) -> None:
    loaded = [
        recorded(5, motion(seed, SHORT_S), noise=seed, mounted=LOAD, declared=LOAD)
        for seed in (60, 61)
    ]
    found = CollisionThresholds.calibrated(
        model, type(calibration).concatenate(loaded), false_alarms=0.5
    )
    assert np.all(found.level < 2.0 * CollisionThresholds.of(model).level)


@pytest.mark.thorough
def test_few_motions_promise_little(model, calibration) -> None:
    with pytest.raises(FitError, match="6 motions") as caught:
        CollisionThresholds.calibrated(model, calibration, false_alarms=0.05)
    assert "record 38" in caught.value.hint


def test_bands_that_depend_on_speed_are_the_deviation(monkeypatch) -> None:
    monkeypatch.setattr("hil.control.collision_detection.resting_friction", lambda m: np.ones(1))
    bands = SpeedBands(0.9, np.array([[0.01]]), np.array([[0.4, 0.2]]), np.array([[0.9, 0.9]]))
    fake = SimpleNamespace(
        bands_=bands, torque_scale_=np.array([10.0]), joint_names_=("a",), effort_kind_="current"
    )
    found = CollisionThresholds.of(fake, quantile=6.0)
    ratio = found.at(np.zeros(1)) / found.at(np.ones(1))
    np.testing.assert_allclose(ratio, 2.0)
    np.testing.assert_allclose(found.at(np.ones(1)), 6.0 * 10.0 * 0.2 / 1.6449, rtol=1e-4)


def test_a_joint_that_stands_may_hide_its_dry_friction() -> None:
    margin = RestMargin(np.array([5.0, 2.0]))
    np.testing.assert_array_equal(margin.update(0.0, np.array([0.0, 0.5])), [5.0, 2.0])
    np.testing.assert_allclose(margin.update(FADES_S, np.array([0.0, 0.5])), [5.0, 2.0 / np.e])
    np.testing.assert_allclose(margin.update(9.0, np.array([0.5, 0.0])), [0.0, 2.0], atol=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["rigid-wls", "rigid-hysteresis"])
def test_dry_friction_is_known_of_models_with_and_without_memory(name) -> None:
    level = resting_friction(fitted(5, name))
    true = [joint.friction.coulomb_nm for joint in draw_truth("ur5", 5).joints]
    assert np.all((level > 0.6 * np.array(true)) & (level < 2.2 * np.array(true)))


@pytest.mark.thorough
def test_an_arm_that_rests_between_moves_alarms_nobody(model) -> None:
    """Friction at rest changes unseen by more than thresholds of motion allow."""
    way = blend(MIDDLE, np.add(MIDDLE, [0.6, 0.4, -0.7, 0.5, -0.5, 0.8]), RATE_HZ, 2.0)
    data = recorded(5, np.concatenate([way, hold(way, RATE_HZ, 2.0), way[::-1] * [[1], [-1], [1]]]))
    thresholds = CollisionThresholds.of(model)
    assert collisions_in(CollisionDetector(model, thresholds=thresholds), data)[0] == []
    bare = replace(thresholds, resting=np.zeros(6))
    assert collisions_in(CollisionDetector(model, thresholds=bare), data)[0]


@pytest.mark.thorough
def test_settings_that_cannot_be_are_refused(model, thresholds, calibration) -> None:
    with pytest.raises(SpecError, match="quantile"):
        CollisionThresholds.of(model, quantile=0.0)
    with pytest.raises(SpecError, match="false_alarms"):
        CollisionThresholds.calibrated(model, calibration, false_alarms=1.0)
    with pytest.raises(SpecError, match="are for the joints"):
        CollisionDetector(model, thresholds=replace(thresholds, joint_names=("a",) * 6))
    with pytest.raises(DataError, match="joints"):
        CollisionThresholds.calibrated(model, replace(calibration, joint_names=tuple("abcdef")))
