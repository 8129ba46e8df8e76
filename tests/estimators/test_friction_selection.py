"""Shapes, groups and penalties of friction, on joints whose friction is made up."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hil.estimators.friction_fit import (
    AS_GOOD,
    FREE,
    PENALTIES,
    climb,
    first_shapes,
    fitted_shapes,
    folds_of,
    observe,
    penalised,
    solve,
)
from hil.estimators.friction_library import (
    CORE,
    LADDER,
    FrictionMotion,
    Shapes,
    groups,
    rungs,
    temperatures_vary,
)
from tests.support.synthetic_memory import dahl_loop
from tests.support.synthetic_motion import moving, nominal

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
