"""Friction columns of an arm at rest, against Dahl's model in closed form and integrated."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from hil.data.arrivals import ARRIVAL_POINTS, ARRIVAL_Q, ARRIVAL_QD
from hil.estimators.friction_memory import states_at_rest
from hil.estimators.static_friction import (
    Rest,
    StaticCoulomb,
    correction_features,
    drive_terms,
    memory_terms,
    smooth,
)
from tests.support.synthetic_motion import arrivals_of

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
