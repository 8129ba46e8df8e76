"""Dahl's state along a path, and variable projection, against loops and finite differences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from hil.data.filters import FilterSettings, prepare
from hil.estimators.friction_fit import _linearised, variable_projection
from hil.estimators.friction_memory import Pieces, advanced, dahl_states, path_steps
from hil.estimators.streaming import DahlMemory
from tests.support.synthetic_memory import dahl_loop
from tests.support.synthetic_motion import dwelling, moving, raw

LENGTH = np.array([1e-4, 3e-3, 0.1])
T = np.linspace(0.05, 3.0, 80)


@pytest.fixture(scope="module")
def path():
    random = np.random.default_rng(0)
    return np.cumsum(random.normal(size=(257, 3)) * 1e-3, axis=0)


@pytest.fixture(scope="module")
def steps(path):
    return np.diff(path, axis=0, prepend=path[:1])


def test_states_are_those_of_a_loop_over_samples(path, steps) -> None:
    states = dahl_states(steps, LENGTH)
    for j, length in enumerate(LENGTH):
        assert states[:, j] == pytest.approx(dahl_loop(path[:, [j]], length)[:, 0], abs=1e-13)


def test_states_depend_on_the_path_not_on_how_finely_it_is_sampled(steps) -> None:
    finer = np.repeat(steps / 7.0, 7, axis=0)
    assert dahl_states(finer, LENGTH)[6::7] == pytest.approx(dahl_states(steps, LENGTH), abs=1e-12)


def test_a_long_way_brings_the_state_to_the_sign_of_the_motion() -> None:
    states = dahl_states(np.array([[1.0], [-1.0], [1.0]]), np.array([0.01]))
    assert states[:, 0] == pytest.approx([1.0, -1.0, 1.0])


def test_a_joint_that_holds_keeps_its_state() -> None:
    states = dahl_states(np.array([[2e-3], [-1e-3], [0.0], [0.0]]), np.array([1e-3]))
    assert abs(states[1, 0]) < 0.9
    assert np.all(states[2:] == states[1])


def test_the_later_step_acts_on_what_the_earlier_left() -> None:
    there, back = 5e-3, -1e-3
    after = dahl_states(np.array([[there], [back]]), np.array([1e-3]))[-1, 0]
    swapped = dahl_states(np.array([[back], [there]]), np.array([1e-3]))[-1, 0]
    assert after == pytest.approx(2.0 * np.exp(-1.0) - 1.0, abs=0.01)
    assert swapped == pytest.approx(1.0, abs=0.02)


def test_one_more_step_is_the_next_state(steps) -> None:
    states = dahl_states(steps, LENGTH)
    assert advanced(states[99], steps[100], LENGTH) == pytest.approx(states[100], abs=1e-13)


@pytest.mark.parametrize("joint", range(3))
def test_slopes_are_finite_differences_by_the_logarithm_of_the_length(steps, joint) -> None:
    h, length = 1e-6, LENGTH[joint]
    pieces = Pieces.of(steps[:, joint], (slice(0, len(steps)),))
    up, down = (pieces.state(length * np.exp(s * h))[0] for s in (1, -1))
    assert pieces.state(length)[1] == pytest.approx((up - down) / (2 * h), abs=1e-8)


def test_path_is_the_way_between_samples() -> None:
    data = moving(1)
    steps = path_steps(replace(data, columns=data.columns | {"qd": data["qd"] + 1e-9}))
    assert np.cumsum(steps, axis=0) == pytest.approx(data["q"] - data["q"][0], abs=2e-4)


def test_path_begins_anew_in_every_series() -> None:
    steps = path_steps(moving(1, 2))
    assert np.all(steps[[0, 600]] == 0.0)
    assert np.all(steps[601] != 0.0)
    assert np.array_equal(steps[600:], path_steps(moving(2)))


def test_path_stands_still_where_the_recorded_velocity_is_exactly_zero() -> None:
    data = raw(moving(1))
    qd = data["qd"].copy()
    qd[200:300, 2] = 0.0
    held = prepare(data.with_columns(qd=qd), FilterSettings())
    assert np.any(held["qd_f"][210:290, 2] != 0.0)
    steps = path_steps(held)
    assert np.all(steps[201:300, 2] == 0.0)
    assert np.all(steps[210:290, 1] != 0.0)


def test_path_without_recorded_velocity_follows_the_filtered_one() -> None:
    data = moving(1)
    kept = {name: values for name, values in data.columns.items() if name != "qd"}
    assert path_steps(replace(data, columns=kept)) == pytest.approx(path_steps(data), abs=1e-12)


def test_path_of_a_dwell_is_none() -> None:
    assert np.all(path_steps(prepare(dwelling(3), FilterSettings())) == 0.0)


def test_memory_of_a_stream_survives_a_caller_that_reuses_its_array(path, steps) -> None:
    memory, sample = DahlMemory(LENGTH, [1.0, 10.0]), np.empty((1, 3))
    for q, step in zip(path, steps, strict=True):
        sample[:] = q
        states = memory.after(sample, np.sign(step)[None])
    for multiple, state in states.items():
        assert state[0] == pytest.approx(dahl_states(steps, multiple * LENGTH)[-1], abs=1e-12)


def decays(theta):
    """Two exponentials whose rates are searched for, and a constant column."""
    a, b = (np.exp(-rate * T) for rate in theta)
    slopes = np.zeros((2, len(T), 3))
    slopes[0][:, 0], slopes[1][:, 1] = -T * a, -T * b
    return np.stack([a, b, np.ones_like(T)], axis=1), slopes


def target(theta, noise: float = 0.0):
    clean = decays(np.asarray(theta))[0] @ np.array([2.0, -3.0, 0.5])
    return clean + noise * np.random.default_rng(3).normal(size=len(T))


@pytest.mark.parametrize("theta", [(0.5, 2.0), (1.0, 1.003)], ids=["apart", "nearly alike"])
def test_jacobian_of_the_projection_is_exact(theta) -> None:
    theta, wanted, h = np.array(theta), target((0.7, 1.8), noise=0.1), 1e-6
    J = _linearised(*decays(theta), wanted)[2]
    for i, step in enumerate(h * np.eye(2)):
        up, down = (_linearised(*decays(theta + s * step), wanted)[1] for s in (1, -1))
        assert J[:, i] == pytest.approx((up - down) / (2 * h), abs=1e-5 * np.abs(J[:, i]).max())


def test_columns_that_are_alike_or_empty_do_no_harm() -> None:
    F, slopes = decays(np.array([1.0, 1.0]))
    F = np.hstack([F, np.zeros((len(T), 1))])
    slopes = np.concatenate([slopes, np.zeros((2, len(T), 1))], axis=2)
    linear, residual, J = _linearised(F, slopes, target((1.0, 1.0)))
    assert np.all(np.isfinite(J))
    assert linear[3] == 0.0
    assert residual == pytest.approx(0.0, abs=1e-12)


def test_projection_finds_the_parameters_it_was_made_with() -> None:
    low, high = np.array([0.01, 1.0]), np.array([1.0, 9.0])
    found = variable_projection(
        decays, target((0.4, 2.5)), np.array([0.9, 1.1]), low, high, most_steps=40
    )
    assert found.theta == pytest.approx([0.4, 2.5], rel=1e-3)
    assert found.linear == pytest.approx([2.0, -3.0, 0.5], rel=1e-2)


def test_projection_ends_where_scipy_does_without_it() -> None:
    low, high, wanted = np.array([0.01, 1.0]), np.array([1.0, 9.0]), target((0.4, 2.5), noise=0.02)
    ours = variable_projection(decays, wanted, np.array([0.5, 2.0]), low, high, most_steps=60)

    def residual(p):
        return decays(p[:2])[0] @ p[2:] - wanted

    peer = least_squares(residual, [0.5, 2.0, 1.0, -1.0, 0.0], xtol=1e-12, ftol=1e-12)
    assert ours.squares == pytest.approx(2.0 * peer.cost, rel=1e-4)


def test_projection_ends_at_a_bound_where_the_best_lies_beyond() -> None:
    low, high, wanted = np.array([0.6, 1.0]), np.array([1.0, 2.0]), target((0.4, 2.5))
    ours = variable_projection(decays, wanted, np.array([0.9, 5.0]), low, high, most_steps=60)
    ends = ([*low, -np.inf, -np.inf, -np.inf], [*high, np.inf, np.inf, np.inf])
    peer = least_squares(
        lambda p: decays(p[:2])[0] @ p[2:] - wanted, [0.7, 1.5, 1.0, -1.0, 0.0], bounds=ends
    )
    assert np.all((ours.theta >= low) & (ours.theta <= high))
    assert ours.theta == pytest.approx(peer.x[:2], abs=1e-3)
    assert np.any((ours.theta == low) | (ours.theta == high))


def test_projection_never_ends_worse_than_it_began() -> None:
    random = np.random.default_rng(1)
    low, high = np.array([0.01, 0.01]), np.array([9.0, 9.0])
    for _ in range(20):
        wanted, start = random.normal(size=len(T)), random.uniform(0.1, 5.0, 2)
        first = _linearised(*decays(start), wanted)[1]
        assert variable_projection(decays, wanted, start, low, high).squares <= first @ first
