"""Friction at rest: columns against Dahl's model, models on dwells whose friction is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from hil.core.errors import DataError, FitError
from hil.data import Dataset
from hil.data.arrivals import ARRIVAL_POINTS, ARRIVAL_Q, ARRIVAL_QD
from hil.data.dwells import series_means
from hil.data.splits import split
from hil.estimators.friction_memory import states_at_rest
from hil.estimators.static_friction import (
    Rest,
    StaticCoulomb,
    StaticHysteresis,
    correction_features,
    drive_terms,
    memory_terms,
    smooth,
)
from tests.support.synthetic_motion import (
    COULOMB,
    GAINS,
    LOAD,
    OFFSET,
    arrivals_of,
    arriving,
    dwelling,
    nominal,
    plant,
)

STILL = np.zeros(6)


@pytest.fixture(scope="module")
def dwells():
    return arriving(100, load_share=0.07, per_k=-0.01)


@pytest.fixture(scope="module")
def coulomb(dwells):
    return StaticCoulomb().fit(dwells, nominal())


@pytest.fixture(scope="module")
def hysteresis(dwells):
    return StaticHysteresis().fit(dwells, nominal())


def held_out(**changes):
    """Noise-free dwells at other poses."""
    return arriving(40, **{"seed": 5, "load_share": 0.07, "per_k": -0.01, "noise_a": 0.0} | changes)


def error(model, data):
    """RMSE per joint [A] of the mean currents."""
    left = series_means(data, data["effort"] - model.predict(data).effort)
    return np.sqrt(np.mean(left**2, axis=0))


def own(model, term):
    """(n,) coefficients of a term; NaN for joints without it."""
    found = dict(zip(model.parameter_names_, model.coefficients_, strict=True))
    return np.array([found.get(f"{joint}.{term}", np.nan) for joint in model.joint_names_])


def without_slide(**changes):
    return arriving(60, slide_rad=0.0, **changes)


def test_coulomb_recovers_a_known_friction_and_offset() -> None:
    model = StaticCoulomb().fit(without_slide(), nominal())
    assert own(model, "coulomb") == pytest.approx(COULOMB, abs=0.01)
    assert own(model, "offset") == pytest.approx(OFFSET, abs=0.01)
    assert model.dry_friction() == pytest.approx(COULOMB, abs=0.01)
    assert np.max(error(model, without_slide(seed=5, noise_a=0.0))) < 0.001


def test_parts_are_gravity_offset_and_friction_with_the_sign_of_the_approach() -> None:
    model = StaticCoulomb().fit(without_slide(noise_a=0.0), nominal())
    test = without_slide(seed=3, noise_a=0.0)
    found = model.predict(test)
    side = np.array([c.approach for c in test.conditions])[test.series_index(), None]
    assert found.components["friction"] == pytest.approx(side * COULOMB / GAINS, abs=1e-6)
    gravity = plant().gravity(test["q"]) / GAINS
    assert found.components["gravity"] == pytest.approx(gravity, abs=1e-6)
    assert sum(found.components.values()) == pytest.approx(found.effort)


@pytest.mark.thorough
def test_the_approach_is_taken_from_the_motion_not_from_the_plan(dwells, coulomb) -> None:
    unplanned = replace(dwells, conditions=tuple(replace(c, approach=0) for c in dwells.conditions))
    assert np.array_equal(coulomb.predict(unplanned).effort, coulomb.predict(dwells).effort)


@pytest.mark.thorough
def test_hysteresis_beats_the_sign_where_joints_slide_back(coulomb, hysteresis) -> None:
    test = held_out()
    assert np.all(error(hysteresis, test) < 0.2 * error(coulomb, test))
    assert np.max(error(hysteresis, test)) < 0.025


def test_hysteresis_equals_the_sign_where_nothing_slides_back() -> None:
    training, test = without_slide(), without_slide(seed=5, noise_a=0.0)
    sign = StaticCoulomb().fit(training, nominal())
    ours = StaticHysteresis(correction=False).fit(training, nominal())
    assert ours.predict(test).effort == pytest.approx(sign.predict(test).effort, abs=0.003)


def test_memory_that_does_not_help_on_new_poses_is_left_out_and_told() -> None:
    data = without_slide()
    model, plain = StaticHysteresis().fit(data, nominal()), StaticCoulomb().fit(data, nominal())
    assert any("memory is left out" in note for note in model.notes_)
    assert model.predict(data).effort == pytest.approx(plain.predict(data).effort, abs=1e-12)


@pytest.mark.thorough
def test_a_path_that_is_infinite_is_refused(dwells) -> None:
    paths = np.array(dwells.arrivals)
    paths[3, 0, 0, 1] = np.inf
    with pytest.raises(FitError, match="infinite"):
        StaticHysteresis().fit(replace(dwells, arrivals=paths), nominal())


@pytest.mark.thorough
def test_hysteresis_gives_its_dry_friction_as_what_a_joint_slides_with(hysteresis) -> None:
    assert hysteresis.dry_friction() == pytest.approx(COULOMB, rel=0.2)


@pytest.mark.thorough
def test_a_fit_sees_nothing_of_the_held_out_dwells(dwells, hysteresis) -> None:
    parts = split(dwells, "pose", 0.2, seed=3)
    fitted = StaticHysteresis().fit(parts.train, nominal())
    secret = parts.test.with_columns(effort=parts.test["effort"] + 9.0)
    again = StaticHysteresis().fit(
        Dataset.concatenate([parts.train, secret]).select(
            lambda c: c.pose in {t.pose for t in parts.train.conditions}
        ),
        nominal(),
    )
    assert np.array_equal(again.coefficients_, fitted.coefficients_)
    assert not np.array_equal(hysteresis.coefficients_, fitted.coefficients_)


@pytest.mark.thorough
def test_the_deviation_told_covers_new_poses() -> None:
    model = StaticHysteresis().fit(arriving(100, noise_a=0.02), nominal())
    test = arriving(100, seed=8, noise_a=0.02)
    found = model.predict(test)
    left = series_means(test, test["effort"] - found.effort)
    inside = np.abs(left) < 1.96 * series_means(test, found.std)
    assert 0.92 < np.mean(inside) < 0.98


def test_the_deviation_told_covers_new_poses_after_training_on_few() -> None:
    few = arriving(22, load_share=0.07, per_k=-0.01, noise_a=0.02)
    model, test = StaticHysteresis().fit(few, nominal()), held_out(noise_a=0.02)
    found = model.predict(test)
    left = series_means(test, test["effort"] - found.effort) / series_means(test, found.std)
    assert np.mean(np.abs(left) < 1.96) > 0.9


@pytest.mark.thorough
def test_a_joint_without_load_has_no_terms_of_load(hysteresis) -> None:
    shoulder = [n for n in hysteresis.parameter_names_ if n.startswith("shoulder_pan_joint.")]
    assert "shoulder_pan_joint.memory1" in shoulder
    assert not [name for name in shoulder if name.endswith(("_load", "square", "gain"))]
    assert np.isfinite(own(hysteresis, "memory1_load")[1:5]).all()


def test_the_gain_of_one_joint_is_fixed_and_those_of_the_others_are_found() -> None:
    wrong = np.array([1.0, 1.0, 1.04, 1.0, 1.0, 1.0])
    data = arriving(80, noise_a=0.0)
    data = data.with_columns(effort=data["effort"] * wrong)
    model = StaticHysteresis(correction=False).fit(data, nominal())
    gain = own(model, "gain")
    assert np.isnan(gain[1])
    assert gain[2] == pytest.approx(0.04, abs=0.005)


@pytest.mark.thorough
def test_without_temperatures_the_rest_of_the_friction_is_predicted(dwells) -> None:
    def cold(data):
        return replace(data, columns={n: v for n, v in data.columns.items() if n != "temperature"})

    model = StaticHysteresis(correction=False).fit(cold(dwells), nominal())
    assert not [name for name in model.parameter_names_ if "temperature" in name]
    test = held_out(per_k=0.0)
    assert np.max(error(model, cold(test))) < 0.03
    assert np.array_equal(model.predict(cold(test)).effort, model.predict(test).effort)


@pytest.mark.thorough
def test_friction_falls_as_joints_get_warm(hysteresis) -> None:
    test = held_out()
    warm = test.with_columns(temperature=test["temperature"] + 5.0)
    ratio = (
        hysteresis.predict(warm).components["friction"]
        / hysteresis.predict(test).components["friction"]
    )
    assert np.median(ratio) == pytest.approx(0.95, abs=0.01)


@pytest.mark.thorough
def test_temperatures_that_hardly_changed_in_training_are_no_input(dwells) -> None:
    drift = np.repeat(np.linspace(31.2, 31.4, 200), 10)[:, None] * np.ones(6)
    drifting = dwells.with_columns(temperature=drift)
    model = StaticHysteresis(correction=False).fit(drifting, nominal())
    test = held_out()
    warm = test.with_columns(temperature=test["temperature"] + 40.0)
    assert np.array_equal(model.predict(warm).effort, model.predict(test).effort)


@pytest.mark.thorough
def test_the_correction_takes_up_what_stopping_one_joint_does_to_another() -> None:
    def coupled(data):
        side = np.array([c.approach for c in data.conditions])[data.series_index()]
        efforts = np.array(data["effort"])
        efforts[:, 0] += 0.01 * side * np.abs(plant().gravity(data["q"])[:, 1]) / GAINS[0]
        return data.with_columns(effort=efforts)

    training, test = coupled(arriving(100)), coupled(arriving(40, seed=5, noise_a=0.0))
    with_it, without = (
        StaticHysteresis(correction=on).fit(training, nominal()) for on in (True, False)
    )
    assert error(with_it, test)[0] < 0.5 * error(without, test)[0]
    assert np.all(without.penalty_ == np.empty(0))


@pytest.mark.thorough
def test_dwells_without_a_temperature_are_predicted_at_the_usual_one(hysteresis) -> None:
    test = held_out()
    unknown = test.with_columns(temperature=np.full_like(test["q"], np.nan))
    usual = np.broadcast_to(hysteresis.celsius_, test["q"].shape)
    expected = hysteresis.predict(test.with_columns(temperature=usual)).effort
    assert np.array_equal(hysteresis.predict(unknown).effort, expected)


@pytest.mark.thorough
def test_friction_grows_with_a_load_that_was_not_in_training(hysteresis) -> None:
    loaded = held_out(load=LOAD)
    assert np.max(error(hysteresis, loaded)) < 0.05
    unaware = StaticHysteresis().fit(arriving(100, per_k=-0.01), nominal())
    assert np.all(error(hysteresis, loaded)[1:3] < 0.5 * error(unaware, loaded)[1:3])


@pytest.mark.thorough
def test_a_heavy_load_at_a_joint_that_bore_none_does_no_harm(dwells) -> None:
    # Joint 6 bears 0.01 N·m by itself: noise alone says how its friction goes with that.
    noisy = dwells.with_columns(
        effort=dwells["effort"] + 0.02 * np.random.default_rng(2).normal(size=(len(dwells), 6))
    )
    model = StaticHysteresis().fit(noisy, nominal())
    heavy = replace(LOAD, mass=5.0, com=(0.08, -0.05, 0.06))
    assert error(model, held_out(load=heavy))[5] < 0.05


def motion_into(data, number):
    """A motion of 0.4 s at 125 Hz that ends in a dwell, with its arrival."""
    where = data["q"][data.offsets[number]]
    path = data.arrivals[number, :, ARRIVAL_Q]
    far = path[:1] + (path[1] - path[0]) * np.arange(-26, 0)[:, None]
    return where + np.concatenate([far, path, np.zeros((20, 6))])


@pytest.mark.thorough
def test_a_stream_gives_for_a_dwell_what_predict_gives() -> None:
    training = arriving(40)
    slow = StaticHysteresis().fit(
        replace(training, columns={n: training[n] for n in ("t", "q", "effort")}), nominal()
    )
    test = arriving(3, seed=6)
    for number in (0, 3):
        stream, q = slow.stream(), motion_into(test, number)
        qd = np.gradient(q, 0.008, axis=0)
        # What the stream sees of the speed: the arrival of the dataset has the same.
        steps = [stream.step(*sample, STILL) for sample in zip(q, qd, strict=True)]
        expected = slow.predict(test).effort[10 * number]
        assert steps[-1] == pytest.approx(expected, abs=0.01)
        still_moving = slow.predict(replace(test, arrivals=None)).effort[10 * number]
        assert steps[30] == pytest.approx(still_moving, abs=0.01)
        assert np.max(np.abs(expected - still_moving)) > 0.1


@pytest.mark.thorough
def test_a_stream_takes_poses_that_jump(hysteresis) -> None:
    stream = hysteresis.stream()
    told = [stream.step(np.full(6, 0.3 * k), STILL, STILL) for k in range(4) for _ in range(20)]
    assert np.isfinite(told).all()


@pytest.mark.thorough
def test_dwells_of_unknown_approach_are_predicted_without_friction_and_not_valid(coulomb) -> None:
    test = held_out()
    arrivals = np.array(test.arrivals)
    arrivals[0, :, :, 2] = np.nan
    found = coulomb.predict(replace(test, arrivals=arrivals))
    assert not found.valid[:10, 2].any()
    assert found.valid[:10, [0, 1, 3, 4, 5]].all()
    assert found.valid[10:].all()
    assert np.all(found.components["friction"][:10, 2] == 0.0)
    nobody = coulomb.predict(replace(test, arrivals=None))
    assert not nobody.valid.any()
    assert np.all(nobody.components["friction"] == 0.0)


@pytest.mark.thorough
def test_motions_are_not_valid(coulomb) -> None:
    test = held_out()
    moves = replace(test, conditions=tuple(replace(c, kind="move") for c in test.conditions))
    found = coulomb.predict(moves)
    assert not found.valid.any()
    assert np.all(np.isnan(found.std))
    assert np.all(np.isfinite(found.effort))


@pytest.mark.thorough
def test_dwells_of_unknown_approach_are_left_out_of_the_fit_and_told(dwells) -> None:
    arrivals = np.array(dwells.arrivals)
    arrivals[:7, :, :, 4] = np.nan
    model = StaticCoulomb().fit(replace(dwells, arrivals=arrivals), nominal())
    rest = StaticCoulomb().fit(dwells.take(np.arange(7, 200)), nominal())
    assert model.samples_ == 193
    assert "7 of 200 dwells are left out" in model.notes_[0]
    assert np.array_equal(model.coefficients_, rest.coefficients_)
    assert rest.notes_ == ()


def test_data_without_the_motion_before_the_dwells_are_refused() -> None:
    for data in (dwelling(80, both=True), replace(arriving(30), arrivals=None)):
        with pytest.raises(
            FitError, match="do not contain the motion before the dwells"
        ) as refused:
            StaticCoulomb().fit(data, nominal())
        assert "record the moves" in refused.value.hint


@pytest.mark.thorough
def test_a_joint_that_never_moved_is_named(dwells) -> None:
    arrivals = np.array(dwells.arrivals)
    arrivals[:, :, :, 3] = np.nan
    with pytest.raises(FitError, match="wrist_1_joint did not move before any of the dwells"):
        StaticHysteresis().fit(replace(dwells, arrivals=arrivals), nominal())


@pytest.mark.thorough
def test_poses_that_do_not_excite_gravity_are_refused(dwells) -> None:
    alike = dwells.with_columns(q=np.full_like(dwells["q"], 0.3))
    with pytest.raises(FitError, match="least determined"):
        StaticCoulomb().fit(alike, nominal())


def test_recordings_of_torque_are_fitted_in_newton_metres() -> None:
    data = without_slide(noise_a=0.0)
    torque = replace(
        data.with_columns(effort=data["effort"] * GAINS), effort_kind="torque", drive_gains=None
    )
    model = StaticCoulomb().fit(torque, nominal())
    assert own(model, "coulomb") == pytest.approx(COULOMB, abs=1e-6)
    assert model.predict(torque).effort == pytest.approx(torque["effort"], abs=1e-6)
    with pytest.raises(DataError, match="predicts a torque"):
        model.predict(data)


# Columns, against Dahl's model in closed form and integrated

LENGTH = 2e-4
SIDE = np.array([[1.0], [-1.0]])


def there_and_back(slid, points=ARRIVAL_POINTS):
    """(2, K, 1) from 1 mrad away past the place of rest by `slid`, and back to it."""
    half = points // 2
    coming = np.linspace(-1e-3, slid, half)
    back = np.linspace(slid, 0.0, points - half)
    return SIDE[:, :, None] * np.concatenate([coming, back])[None, :, None]


def rest(paths=None, *, load=None, warmer=None, dwells=2, joints=6):
    random = np.random.default_rng(5)
    side = np.resize(SIDE, (dwells, 1))
    paths = arrivals_of(side, random.uniform(0, 3e-4, (dwells, joints))) if paths is None else paths
    nothing = np.zeros((dwells, joints))
    return Rest(
        load=nothing if load is None else load,
        direction=side * np.ones(joints),
        paths=paths,
        warmer=nothing if warmer is None else warmer,
    )


@pytest.mark.parametrize("slid", [0.0, 1e-5, 1e-4, 3e-4])
def test_a_slide_back_unbends_as_the_closed_form_says(slid) -> None:
    (state,) = states_at_rest(there_and_back(slid), [LENGTH])
    assert state == pytest.approx(SIDE * (2.0 * np.exp(-slid / LENGTH) - 1.0), abs=1e-12)


def test_without_a_slide_back_friction_is_that_of_the_motion() -> None:
    coming = -SIDE[:, :, None] * np.linspace(1e-3, 0.0, ARRIVAL_POINTS)[None, :, None]
    for state in states_at_rest(coming, [0.5e-4, LENGTH, 5e-4]):
        assert state == pytest.approx(SIDE, abs=1e-12)


def test_states_are_the_integral_of_dahls_equation() -> None:
    # dy/ds = (q' − |q'|·y)/x with time s running through a path that swings to its rest.
    def position(s):
        return -1e-3 * np.exp(-3 * s) * np.cos(7 * s)

    def slope(s, y):
        speed = 1e-3 * np.exp(-3 * s) * (3 * np.cos(7 * s) + 7 * np.sin(7 * s))
        return (speed - abs(speed) * y) / LENGTH

    end, points = 4.0, 4000
    found = solve_ivp(slope, (0.0, end), [1.0], rtol=1e-9, atol=1e-12, max_step=1e-3)
    path = (position(np.linspace(0.0, end, points)) - position(end))[None, :, None]
    (state,) = states_at_rest(path, [LENGTH])
    assert state[0, 0] == pytest.approx(found.y[0, -1], abs=1e-4)
    assert abs(state[0, 0]) < 0.99


@given(st.lists(st.floats(-5e-4, 5e-4), min_size=2, max_size=8), st.floats(2e-5, 6e-4))
@settings(max_examples=50, deadline=None)
def test_states_do_not_depend_on_how_finely_a_path_is_sampled(turns, length) -> None:
    corners = np.array([-1e-3, *turns, 0.0])
    coarse = corners[None, :, None]
    at = np.linspace(0, len(corners) - 1, 40 * (len(corners) - 1) + 1)
    fine = np.interp(at, np.arange(len(corners)), corners)[None, :, None]
    assert states_at_rest(fine, [length])[0] == pytest.approx(states_at_rest(coarse, [length])[0])
    assert np.all(np.abs(states_at_rest(coarse, [length])[0]) <= 1.0 + 1e-12)


def test_the_last_step_leads_to_the_place_of_rest() -> None:
    cut_short = there_and_back(2e-4)[:, :13]
    assert cut_short[0, -1, 0] == pytest.approx(2e-4)
    expected = SIDE * (2.0 * np.exp(-1.0) - 1.0)
    assert states_at_rest(cut_short, [LENGTH])[0] == pytest.approx(expected)


def test_smoothing_keeps_parabolas_and_takes_noise() -> None:
    t = np.arange(ARRIVAL_POINTS, dtype=float)
    parabola = (1e-3 - 8e-5 * t + 2e-6 * t**2)[None, :, None]
    assert smooth(parabola) == pytest.approx(parabola, abs=1e-15)
    noise = np.random.default_rng(0).normal(size=(200, ARRIVAL_POINTS, 1))
    assert np.std(smooth(noise)[:, 5:-5]) < 0.65


def test_coulomb_is_the_direction_and_nothing_else() -> None:
    arms = rest()
    terms = StaticCoulomb()._terms(arms)
    assert set(terms) == {"coulomb"}
    assert np.array_equal(terms["coulomb"], arms.direction)


def test_memory_goes_with_load_and_temperature() -> None:
    load = np.array([[-3.0] * 6, [40.0] * 6])
    warmer = np.array([[2.0] * 6, [-1.0] * 6])
    terms = memory_terms(rest(load=load, warmer=warmer), [LENGTH])
    assert terms["memory1_load"] == pytest.approx(terms["memory1"] * np.abs(load))
    assert terms["coulomb_temperature"] == pytest.approx(SIDE * warmer)


def test_drives_err_with_load_and_its_square() -> None:
    load = np.array([[-3.0] * 6, [40.0] * 6])
    terms = drive_terms(np.zeros((2, 6)), load, None)
    assert set(terms) == {"gain", "square"}
    assert terms["gain"] == pytest.approx(load)
    assert terms["square"] == pytest.approx(np.array([[-9.0] * 6, [1600.0] * 6]))


def test_ripple_goes_with_the_angle_of_the_motor() -> None:
    q = np.random.default_rng(1).uniform(-2, 2, (5, 6))
    terms = drive_terms(q, np.zeros((5, 6)), 101.0)
    assert terms["ripple2_sin"] == pytest.approx(np.sin(202.0 * q))
    assert terms["ripple1_cos"] == pytest.approx(np.cos(101.0 * q))


def test_a_mirrored_arrival_has_mirrored_friction_and_correction() -> None:
    arms = rest(load=np.array([[3.0] * 6, [3.0] * 6]))
    flipped = Rest(-arms.load, -arms.direction, -arms.paths, arms.warmer)
    there, back = memory_terms(arms, [LENGTH]), memory_terms(flipped, [LENGTH])
    assert all(back[name] == pytest.approx(-there[name]) for name in there)
    assert correction_features(flipped) == pytest.approx(-correction_features(arms))


def test_corrections_see_the_own_path_and_the_loads_of_all() -> None:
    arms = rest(load=np.random.default_rng(1).uniform(-20, 20, (4, 6)), dwells=4)
    features = correction_features(arms)
    columns = [features[:, :, k] for k in range(features.shape[2])]
    assert len(features) == 6
    for k in (0, 10, ARRIVAL_POINTS - 1):
        assert columns[k] == pytest.approx(arms.paths[:, k, ARRIVAL_Q].T)
        assert columns[ARRIVAL_POINTS + k] == pytest.approx(arms.paths[:, k, ARRIVAL_QD].T)
    for j in range(6):
        own = np.delete(np.arange(6), j)
        assert not any(np.array_equal(features[j], features[other]) for other in own)
