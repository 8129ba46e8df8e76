"""Friction that remembers: states along a path, shapes and groups that data choose, break-away."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares

from hil.control.rest_pose import COUNTED, rest_poses
from hil.data.filters import FilterSettings, prepare
from hil.estimators.friction_fit import (
    AS_GOOD,
    FREE,
    PENALTIES,
    _linearised,
    climb,
    first_shapes,
    fitted_shapes,
    folds_of,
    observe,
    penalised,
    solve,
    variable_projection,
)
from hil.estimators.friction_library import (
    CORE,
    LADDER,
    FrictionLaw,
    FrictionMotion,
    Shapes,
    groups,
    rungs,
    temperatures_vary,
)
from hil.estimators.friction_memory import Pieces, advanced, dahl_states, path_steps
from hil.estimators.standstill import holding_friction
from hil.estimators.streaming import DahlMemory
from hil_mock_robot.plant.friction import COLD_C, STRIBECK_GONE_C
from hil_mock_robot.plant.truth import draw_truth
from tests.support.collision_parts import fitted
from tests.support.synthetic_memory import dahl_loop
from tests.support.synthetic_motion import dwelling, moving, nominal, raw

# States along a path, and variable projection

LENGTHS = np.array([1e-4, 3e-3, 0.1])
T = np.linspace(0.05, 3.0, 80)


@pytest.fixture(scope="module")
def path():
    random = np.random.default_rng(0)
    return np.cumsum(random.normal(size=(257, 3)) * 1e-3, axis=0)


@pytest.fixture(scope="module")
def steps(path):
    return np.diff(path, axis=0, prepend=path[:1])


def test_states_are_those_of_a_loop_over_samples(path, steps) -> None:
    states = dahl_states(steps, LENGTHS)
    for j, length in enumerate(LENGTHS):
        assert states[:, j] == pytest.approx(dahl_loop(path[:, [j]], length)[:, 0], abs=1e-13)


def test_states_depend_on_the_path_not_on_how_finely_it_is_sampled(steps) -> None:
    finer = np.repeat(steps / 7.0, 7, axis=0)
    assert dahl_states(finer, LENGTHS)[6::7] == pytest.approx(
        dahl_states(steps, LENGTHS), abs=1e-12
    )


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
    states = dahl_states(steps, LENGTHS)
    assert advanced(states[99], steps[100], LENGTHS) == pytest.approx(states[100], abs=1e-13)


@pytest.mark.parametrize("joint", range(3))
def test_slopes_are_finite_differences_by_the_logarithm_of_the_length(steps, joint) -> None:
    h, length = 1e-6, LENGTHS[joint]
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
    memory, sample = DahlMemory(LENGTHS, [1.0, 10.0]), np.empty((1, 3))
    for q, step in zip(path, steps, strict=True):
        sample[:] = q
        states = memory.after(sample, np.sign(step)[None])
    for multiple, state in states.items():
        assert state[0] == pytest.approx(dahl_states(steps, multiple * LENGTHS)[-1], abs=1e-12)


def decays(theta):
    """Two exponentials whose rates are searched for, and a constant column."""
    a, b = (np.exp(-rate * T) for rate in theta)
    slopes = np.zeros((2, len(T), 3))
    slopes[0][:, 0], slopes[1][:, 1] = -T * a, -T * b
    return np.stack([a, b, np.ones_like(T)], axis=1), slopes


def decaying(theta, noise: float = 0.0):
    clean = decays(np.asarray(theta))[0] @ np.array([2.0, -3.0, 0.5])
    return clean + noise * np.random.default_rng(3).normal(size=len(T))


@pytest.mark.parametrize("theta", [(0.5, 2.0), (1.0, 1.003)], ids=["apart", "nearly alike"])
def test_jacobian_of_the_projection_is_exact(theta) -> None:
    theta, wanted, h = np.array(theta), decaying((0.7, 1.8), noise=0.1), 1e-6
    J = _linearised(*decays(theta), wanted)[2]
    for i, step in enumerate(h * np.eye(2)):
        up, down = (_linearised(*decays(theta + s * step), wanted)[1] for s in (1, -1))
        assert J[:, i] == pytest.approx((up - down) / (2 * h), abs=1e-5 * np.abs(J[:, i]).max())


def test_columns_that_are_alike_or_empty_do_no_harm() -> None:
    F, slopes = decays(np.array([1.0, 1.0]))
    F = np.hstack([F, np.zeros((len(T), 1))])
    slopes = np.concatenate([slopes, np.zeros((2, len(T), 1))], axis=2)
    linear, residual, J = _linearised(F, slopes, decaying((1.0, 1.0)))
    assert np.all(np.isfinite(J))
    assert linear[3] == 0.0
    assert residual == pytest.approx(0.0, abs=1e-12)


def test_projection_finds_the_parameters_it_was_made_with() -> None:
    low, high = np.array([0.01, 1.0]), np.array([1.0, 9.0])
    found = variable_projection(
        decays, decaying((0.4, 2.5)), np.array([0.9, 1.1]), low, high, most_steps=40
    )
    assert found.theta == pytest.approx([0.4, 2.5], rel=1e-3)
    assert found.linear == pytest.approx([2.0, -3.0, 0.5], rel=1e-2)


def test_projection_ends_where_scipy_does_without_it() -> None:
    low, high, wanted = (
        np.array([0.01, 1.0]),
        np.array([1.0, 9.0]),
        decaying((0.4, 2.5), noise=0.02),
    )
    ours = variable_projection(decays, wanted, np.array([0.5, 2.0]), low, high, most_steps=60)

    def residual(p):
        return decays(p[:2])[0] @ p[2:] - wanted

    peer = least_squares(residual, [0.5, 2.0, 1.0, -1.0, 0.0], xtol=1e-12, ftol=1e-12)
    assert ours.squares == pytest.approx(2.0 * peer.cost, rel=1e-4)


def test_projection_ends_at_a_bound_where_the_best_lies_beyond() -> None:
    low, high, wanted = np.array([0.6, 1.0]), np.array([1.0, 2.0]), decaying((0.4, 2.5))
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


# Shapes, groups and penalties, on joints whose friction is made up

LENGTH, STRIBECK, POWER = 6e-4, 0.06, 0.55
ROWS, NOISE = 1500, 0.1
POOR, RICH = (CORE, "load", "speed p"), (CORE, "load", "speed p", "memory 30")


def through(values):
    """No filter at all."""
    return values


def swinging(seed: int) -> tuple[FrictionMotion, np.ndarray]:
    """Two joints that swing at three speeds each: motion, and the short state by a loop."""
    random = np.random.default_rng(seed)
    t, q, v = np.arange(ROWS) / 200.0, np.zeros((ROWS, 2)), np.zeros((ROWS, 2))
    for a, w in zip((0.3, 0.03, 0.01), (1.1, 4.0, 9.0), strict=True):
        phase = random.uniform(0.0, 6.0, 2)
        q += a * np.sin(w * t[:, None] + phase)
        v += a * w * np.cos(w * t[:, None] + phase)
    shapes = Shapes(*np.outer([LENGTH, STRIBECK, POWER], np.ones(2)), np.full(2, np.nan))
    load = 20.0 * np.sin(q + 0.3)
    steps = np.diff(q, axis=0, prepend=q[:1])
    return FrictionMotion(q, v, load, shapes, steps), dahl_loop(q, LENGTH)


def backbone(motion: FrictionMotion, z: np.ndarray) -> np.ndarray:
    speed = np.abs(motion.v)
    dry = z * (3.0 + 0.1 * np.abs(motion.transmitted) + 2.0 * np.exp(-speed / STRIBECK))
    return 0.2 + 1.5 * motion.v + dry + 4.0 * np.sign(motion.v) * speed**POWER


def seen(torque, seeds=(1, 2, 3), names=(*RICH, "stribeck"), folds=None):
    """Observations of a robot with two base parameters, sin and cos of each position."""
    library = groups(ripple=False, temperature=False)
    slices, blocks, start = {}, [], 0
    for name in names:
        slices[name] = slice(start, start + (3 if name == CORE else 1))
        start = slices[name].stop
    for number, seed in enumerate(seeds):
        motion, z = swinging(seed)
        noise = NOISE * np.random.default_rng(50 + seed).normal(size=motion.q.shape)
        F = np.stack([c for name in names for c in library[name](motion)], axis=2)
        Y = np.stack([np.sin(motion.q), np.cos(3.0 * motion.q)], axis=2)
        y = torque(motion, z) + Y @ np.array([5.0, -2.0]) + noise
        for part, rows in enumerate(np.array_split(np.arange(ROWS), folds or 1)):
            blocks.append((number + part, F[rows], Y[rows], y[rows]))
    return observe(iter(blocks), slices, 2)


def plain(motion, z):
    return 0.2 + 3.0 * z + 0.1 * z * np.abs(motion.transmitted)


def with_memory(motion, z):
    return plain(motion, z) + 2.0 * dahl_loop(motion.q, 30.0 * LENGTH)


def test_shapes_of_a_simulated_joint_are_found() -> None:
    motion, z = swinging(5)
    torque = backbone(motion, z) + 0.01 * np.random.default_rng(0).normal(size=z.shape)
    found = fitted_shapes([(motion, torque, through)], first_shapes(np.full(2, np.nan)))
    assert found.length == pytest.approx(LENGTH, rel=0.05)
    assert found.stribeck == pytest.approx(STRIBECK, rel=0.1)
    assert found.power == pytest.approx(POWER, abs=0.05)


@pytest.mark.parametrize("seed", [1, 6])
def test_a_local_best_of_the_shapes_leaves_little_of_the_friction(seed) -> None:
    """On every third of these joints the search ends at a bound of Stribeck speed or exponent."""
    motion, z = swinging(seed)
    torque = backbone(motion, z)
    found = fitted_shapes([(motion, torque, through)], first_shapes(np.full(2, np.nan)))
    m = replace(motion, shapes=found)
    for j in range(2):
        columns = [np.ones_like(m.v), m.v, m.z, m.z * m.load, m.z * m.peak(), m.law(found.power)]
        F = np.stack([column[:, j] for column in columns], axis=1)
        left = torque[:, j] - F @ np.linalg.lstsq(F, torque[:, j], rcond=None)[0]
        assert np.std(left) < 0.03 * np.std(torque[:, j])


def test_shapes_are_each_joints_own() -> None:
    motion, z = swinging(5)
    slower = np.column_stack([z[:, 0], dahl_loop(motion.q, 3.0 * LENGTH)[:, 1]])
    torque = backbone(motion, slower)
    found = fitted_shapes([(motion, torque, through)], first_shapes(np.full(2, np.nan)))
    assert found.length[1] / found.length[0] == pytest.approx(3.0, rel=0.15)


def test_compressed_observations_fit_like_all_rows() -> None:
    observed = seen(with_memory)
    solved = solve(observed, [RICH, RICH])
    assert solved.rigid == pytest.approx([5.0, -2.0], abs=0.02)
    assert solved.friction[0][[2, 5]] == pytest.approx([3.0, 2.0], abs=0.05)
    assert solved.sigma == pytest.approx(NOISE, rel=0.05)


def test_order_of_blocks_is_no_matter() -> None:
    once, again = seen(with_memory), seen(with_memory, seeds=(3, 1, 2))
    assert solve(again, [RICH] * 2).rigid == pytest.approx(solve(once, [RICH] * 2).rigid)


def test_memory_is_chosen_where_there_is_memory() -> None:
    found = climb(seen(with_memory), [[POOR, RICH]] * 2, as_good=0.0)
    assert found.chosen == (RICH, RICH)
    assert found.error == pytest.approx(NOISE, rel=0.1)


def test_parts_of_one_trajectory_choose_the_poorer_list_where_no_more_is() -> None:
    library = rungs(ripple=False, temperature=False)[-1]
    taken = []
    for seed in (2, 3, 4, 5):
        observed = seen(plain, seeds=(seed,), names=library, folds=5)
        taken += climb(observed, [[POOR, library]] * 2, as_good=0.0).chosen
    assert taken == [POOR] * 8


def test_trajectories_left_out_let_a_richer_list_be_as_good() -> None:
    found = climb(seen(plain), [[POOR, RICH]] * 2, as_good=AS_GOOD)
    assert found.chosen == (RICH, RICH)


def test_every_joint_chooses_for_itself() -> None:
    def second(motion, z):
        return np.column_stack([plain(motion, z)[:, 0], with_memory(motion, z)[:, 1]])

    found = climb(seen(second, seeds=(1,), folds=5), [[POOR, RICH]] * 2, as_good=0.0)
    assert found.chosen[1] == RICH
    assert found.error == pytest.approx(NOISE, rel=0.1)


def test_penalty_holds_columns_that_only_noise_supports_near_zero() -> None:
    """Along the column of memory, little is left that the dry friction does not say."""
    names = (CORE, "load", "memory 30")
    free, held = (solve(seen(plain), [names] * 2, p) for p in (None, np.full(2, PENALTIES[-1])))
    for j in range(2):
        assert abs(held.friction[j][4]) < 0.02
        assert held.friction[j][2] == pytest.approx(3.0, abs=0.1)
    assert np.hypot(*(c[4] for c in held.friction)) < np.hypot(*(c[4] for c in free.friction))


def test_penalty_spares_the_friction_every_joint_has() -> None:
    observed = seen(plain)
    rows = penalised(observed, 0, RICH, 1e-2)
    assert {CORE, "load"} <= set(FREE)
    assert np.all(rows[:4] == 0.0)
    column = observed.pooled(0, np.array([5]))[:, 0]
    assert rows[5, 5] == pytest.approx(0.1 * np.linalg.norm(column))


def test_trajectories_are_folds_and_a_single_one_is_cut() -> None:
    fold, whole = folds_of(moving(1, 2, 3, 4, samples=50))
    assert whole
    assert fold.tolist() == np.repeat(range(4), 50).tolist()
    fold, whole = folds_of(moving(1, samples=50))
    assert not whole
    assert np.bincount(fold).tolist() == [10] * 5
    assert np.all(np.diff(fold) >= 0)


def test_pieces_of_a_trajectory_share_a_fold() -> None:
    data = moving(1, 2, 3, samples=50)
    last = replace(data.conditions[2], source=data.conditions[0].source, trajectory=1)
    fold, _ = folds_of(replace(data, conditions=(*data.conditions[:2], last)))
    assert fold[0] == fold[-1] != fold[60]


def test_every_list_holds_the_one_before() -> None:
    lists = rungs(ripple=True, temperature=True)
    assert lists[0] == (CORE,)
    assert len(lists) == len(LADDER) + 3
    for fewer, more in pairwise(lists):
        assert more[: len(fewer)] == fewer
    assert set(lists[-1]) <= set(groups(ripple=True, temperature=True))


@pytest.mark.parametrize(
    ("low", "high", "varies"), [(30.0, 30.5, False), (30.0, 31.5, True), (30.0, np.nan, False)]
)
def test_temperature_counts_when_it_was_recorded_and_varied(low, high, varies) -> None:
    data = moving(1, samples=50)
    celsius = np.linspace(low, high, 50)[:, None] * np.ones(nominal().n)
    assert not temperatures_vary(data)
    assert temperatures_vary(data.with_columns(temperature=celsius)) is varies


# What a joint holds at rest

SHAPES = Shapes(np.array([1e-3]), np.array([0.05]), np.array([0.5]), np.array([np.nan]))


def law(**groups):
    names, values = tuple(groups), [np.atleast_1d(v) for v in groups.values()]
    return FrictionLaw((names,), (np.concatenate(values).astype(float),), SHAPES)


PLAIN = {"core": [0.7, 5.0, 3.0]}
"""Offset, viscous and Coulomb friction."""


def test_offset_and_viscous_friction_hold_nothing():
    assert law(**PLAIN).break_away() == pytest.approx([3.0])


def test_the_whole_stribeck_peak_and_every_memory_hold():
    more = {"stribeck": 0.8, "memory 3": 0.4, "memory 30": -0.1, "speed p": 2.0}
    assert law(**PLAIN, **more).break_away() == pytest.approx([3.0 + 0.8 + 0.4 - 0.1])


def test_friction_that_grows_with_the_load_is_not_counted():
    assert law(**PLAIN, load=0.1, braking=0.2).break_away() == pytest.approx([3.0])


def test_friction_that_changes_with_the_angle_counts_where_it_is_least():
    assert law(**PLAIN, **{"turn 1 dry": [0.3, 0.4]}).break_away() == pytest.approx([2.5], abs=1e-3)


def test_no_joint_holds_less_than_nothing():
    assert law(core=[0.0, 1.0, -0.2]).break_away() == pytest.approx([0.0])


def true_break_away(truth):
    """(n,) torque at which an unloaded joint of the mock begins to slide [N·m]."""
    celsius = truth.ambient_c
    cold = np.clip((STRIBECK_GONE_C - celsius) / (STRIBECK_GONE_C - COLD_C), 0.0, 1.0)
    return np.array(
        [
            joint.friction.coulomb_nm
            * (1.0 + joint.thermal.coulomb_per_k * (celsius - truth.reference_c))
            + cold * joint.friction.stribeck_nm
            for joint in truth.joints
        ]
    )


@pytest.mark.thorough
def test_the_break_away_of_a_fitted_model_is_that_of_the_mock():
    truth = draw_truth("ur5", 5)
    share = holding_friction(fitted(5)) / true_break_away(truth)
    assert np.all(share > 0.7)
    assert np.all(share < 1.3)
    # At rest the mock's contacts creep, down to a share of what they hold at first: what is
    # relied upon stays below that.
    lasting = [joint.friction.creep_floor for joint in truth.joints]
    assert np.all(COUNTED * share < lasting)


@pytest.mark.thorough
def test_rest_poses_of_a_model_with_memory_know_what_its_joints_hold(tmp_path, monkeypatch):
    monkeypatch.setattr("hil.control.rest_pose.STARTS", 4)
    monkeypatch.delenv("HIL_STATION", raising=False)
    model = fitted(5)
    report = rest_poses(model.save(tmp_path / "model"), count=1)
    assert report.friction == pytest.approx(model.break_away())
    assert not any("no dry friction" in note for note in report.notes)
    assert np.isfinite(report.poses[0].fail.spare).all()
