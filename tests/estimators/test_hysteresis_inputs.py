"""What `rigid-hysteresis` makes of robots, recordings and parameters that are not the usual."""

import numpy as np
import pytest

from hil.core.errors import DataError, FitError, SpecError
from hil.data import Dataset
from hil.dynamics import RobotModel
from hil.estimators import estimator
from hil.estimators.friction_library import LOADED
from hil.estimators.rigid_hysteresis import BANDWIDTHS, MOTION_HZ, filters_for
from tests.estimators.test_rigid_hysteresis import made, rms
from tests.support.dynamics_arms import urdf, written
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import dwelling, moving, nominal, raw


@pytest.fixture(scope="module")
def train():
    return remembering(1, 2, noise_a=0.0)


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ({"friction": ["nonsense"]}, "nonsense"),
        ({"friction": "stribek"}, "stribek"),
        ({"friction": ["load", 3]}, "3"),
        ({"gear_ratio": -101.0}, "gear_ratio"),
        ({"gear_ratio": 0.0}, "gear_ratio"),
        ({"fit_shapes": "perhaps"}, "fit_shapes"),
        ({"filters": {"velocity": -1.0}}, "filters"),
        ({"frictions": "auto"}, "frictions"),
    ],
)
def test_parameters_that_cannot_be_are_refused(params, said) -> None:
    with pytest.raises(SpecError, match=said):
        estimator("rigid-hysteresis", **params)


def test_a_misspelt_group_is_guessed() -> None:
    with pytest.raises(SpecError) as caught:
        estimator("rigid-hysteresis", friction="stribek")
    assert "stribeck" in str(caught.value.hint)


def test_the_core_need_not_be_named() -> None:
    assert estimator("rigid-hysteresis", friction=["load"]).friction == ("core", "load")
    assert estimator("rigid-hysteresis", friction=()).friction == ("core",)


@pytest.mark.thorough
def test_one_trajectory_is_noted_and_two_are_not(train) -> None:
    alone = made(friction="auto").fit(remembering(1), nominal())
    assert any("one trajectory only" in note for note in alone.notes_)
    assert made().fit(train, nominal()).notes_ == ()


@pytest.mark.thorough
def test_a_robot_of_a_urdf_has_no_ripple_unless_its_gear_ratio_is_given(train, tmp_path) -> None:
    robot = RobotModel.from_urdf(written(tmp_path, urdf("ur5")))
    plain = made(friction="auto").fit(train, robot)
    assert not any("ripple" in name for name in plain.parameter_names_)
    assert "ripple" not in plain.predict(train).components
    geared = made(friction=("load", "ripple 1"), gear_ratio=101.0).fit(train, robot)
    assert sum("ripple 1" in name for name in geared.parameter_names_) == 12
    assert "ripple" in geared.predict(train).components


@pytest.mark.thorough
def test_warm_joints_are_learnt_where_temperature_varied() -> None:
    ramp, other = (15.0, 45.0), (45.0, 15.0)
    warm = remembering(1, 2, celsius=ramp, noise_a=0.0)
    test = remembering(9, celsius=other, noise_a=0.0)
    groups = ("load", "memory 30", "temperature")
    model = made(friction=groups, fit_shapes=True).fit(warm, nominal())
    blind = made(friction=groups[:2], fit_shapes=True).fit(warm, nominal())
    assert np.all(rms(model, test)[[0, 2]] < 0.5 * rms(blind, test)[[0, 2]])


@pytest.mark.thorough
def test_temperature_with_gaps_is_left_alone(train) -> None:
    celsius = np.linspace(20.0, 40.0, len(train))[:, None] * np.ones(6)
    celsius[5, 3] = np.nan
    model = made(friction="auto").fit(train.with_columns(temperature=celsius), nominal())
    assert not any("temperature" in name for name in model.parameter_names_)
    assert np.all(np.isfinite(model.predict(train).effort))


def test_a_gap_in_the_temperature_that_is_predicted_with_stands_for_the_reference() -> None:
    warm = remembering(1, 2, celsius=(15.0, 45.0))
    model = made(friction=("temperature",)).fit(warm, nominal())
    gaps = warm.with_columns(temperature=np.full((len(warm), 6), np.nan))
    usual = warm.with_columns(temperature=np.full((len(warm), 6), 30.0))
    assert np.array_equal(model.predict(gaps).effort, model.predict(usual).effort)


@pytest.mark.thorough
def test_joints_that_transmit_next_to_nothing_have_no_load_columns() -> None:
    chosen = made(friction="auto").fit(remembering(1, 2, 3), nominal()).law_.chosen
    assert LOADED & set(chosen[1])
    assert LOADED & set(chosen[2])
    assert not LOADED & set(chosen[5])
    assert "memory 30" in chosen[5]


def test_dwells_are_predicted_with_gravity_and_offset(train) -> None:
    model = made().fit(train, nominal())
    parts = model.predict(dwelling(4)).components
    offsets = model.fitted_arrays()["friction"].reshape(6, 6)[:, 0] / model.torque_scale_
    assert parts["friction"] == pytest.approx(np.tile(offsets, (40, 1)), abs=1e-12)
    assert np.all(parts["inertia"] == 0.0)


@pytest.mark.parametrize("samples", [1, 5])
def test_a_series_too_short_for_the_filter_is_named(train, samples) -> None:
    short = remembering(9, samples=samples)
    for act in (
        lambda: made().fit(Dataset.concatenate([train, short]), nominal()),
        lambda: made().fit(train, nominal()).predict(short),
    ):
        with pytest.raises(DataError, match="t9"):
            act()


def test_too_few_samples_or_no_motion_are_refused() -> None:
    with pytest.raises(FitError, match="samples"):
        made().fit(remembering(1, samples=40), nominal())
    still = remembering(1)
    held = still.with_columns(q=np.zeros_like(still["q"]), qd=np.zeros_like(still["qd"]))
    with pytest.raises(FitError):
        made().fit(held, nominal())


def test_another_robots_or_units_data_are_not_predicted(train) -> None:
    model = made().fit(train, nominal())
    with pytest.raises(DataError, match="torque"):
        model.predict(moving(1, kind="torque"))
    with pytest.raises(FitError, match="not fitted"):
        made().predict(train)


def test_filters_follow_the_motion_not_the_sample_rate() -> None:
    slow = raw(moving(1, samples=800))
    assert filters_for(slow).unit == "hz"
    assert filters_for(slow).velocity == filters_for(slow).acceleration == MOTION_HZ
    t = np.arange(800) / 100.0
    quick = slow.with_columns(qd=np.sin(2 * np.pi * 3.0 * t)[:, None] * np.ones(6))
    assert filters_for(quick).velocity == pytest.approx(BANDWIDTHS * 3.0, rel=0.2)
    assert filters_for(slow.with_columns(t=5.0 * t)).effort <= 0.75 * 10.0
