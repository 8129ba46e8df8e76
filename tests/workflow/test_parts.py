"""What is fitted on and what is judged on: loads, motions, and both at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import DataError
from hil.data import Conditions, Dataset
from hil.evaluation.holdout import NEW_LOAD, NEW_MOTION, assert_new_pairs, hold_out
from hil.spec.experiment import HoldOut
from tests.support.synthetic_motion import dataset


def series(*conditions: Conditions) -> Dataset:
    """Three rows per series, all different."""
    count = 3 * len(conditions)
    values = np.arange(count * 6, dtype=float).reshape(count, 6)
    columns = {"t": np.arange(count, dtype=float), "q": values, "effort": values + 0.5}
    return dataset(columns, [3] * len(conditions), list(conditions))


def program(kind: str = "trajectory", motions: int = 4, loads: int = 2) -> Dataset:
    """The same motions once with each load, between a warm-up, moves and reference visits."""
    key = {"trajectory": "trajectory", "dwell": "pose"}[kind]
    found = [Conditions("w", "warmup", "run")]
    for load in range(loads):
        for number in range(motions):
            found.append(Conditions(f"m{load}{number}", "move", "run", load=load))
            found.append(Conditions(f"r{load}{number}", "reference", "run", load=load))
            for side in (1, -1) if kind == "dwell" else (0,):
                one = Conditions(f"{kind}{load}{number}{side}", kind, "run", load=load)  # type: ignore[arg-type]
                found.append(replace(one, approach=side, **{key: number}))
    return series(*found)


def pairs(data: Dataset, key: str = "trajectory") -> set[tuple[int, int]]:
    return {(getattr(c, key), c.load) for c in data.conditions}


def test_a_new_load_is_judged_on_motions_seen_with_other_loads_and_said_so() -> None:
    parts = hold_out(program(), HoldOut(loads=(1,)))
    assert pairs(parts.train) == {(n, 0) for n in range(4)}
    assert pairs(parts.test) == {(n, 1) for n in range(4)}
    assert parts.held_out == "load 1, motions seen in training with other loads"
    assert parts.beside == ()


def test_new_loads_and_new_motions_are_judged_together_and_reported_apart() -> None:
    parts = hold_out(program(), HoldOut(loads=(1,), trajectories=1))
    assert pairs(parts.train) == {(0, 0), (1, 0), (2, 0)}
    assert pairs(parts.test) == {(3, 1)}
    assert parts.held_out == (
        "the last trajectory with load 1: motions and loads the fit has not seen"
    )
    beside = {what: pairs(data) for what, data in parts.beside}
    assert beside == {NEW_LOAD: {(0, 1), (1, 1), (2, 1)}, NEW_MOTION: {(3, 0)}}


def test_loads_are_called_by_their_mass() -> None:
    data = program(loads=3)
    masses = [0.0, 3.0, 5.0]
    named = [replace(c, payload=Payload(masses[c.load])) for c in data.conditions]
    parts = hold_out(replace(data, conditions=tuple(named)), HoldOut(loads=(2, 1)))
    assert parts.held_out == "3 kg and 5 kg, motions seen in training with other loads"


@pytest.mark.parametrize("kind", ["trajectory", "dwell"])
@pytest.mark.parametrize("loads", [(), (1,)])
def test_only_what_was_measured_is_fitted_or_judged(kind: str, loads: tuple[int, ...]) -> None:
    parts = hold_out(program(kind), HoldOut(loads=loads))
    kinds = {c.kind for part in (parts.train, parts.test) for c in part.conditions}
    assert kinds == {kind}


def test_a_share_of_the_trajectories_is_drawn_by_seed_with_every_load() -> None:
    data = program(motions=12)
    draws = [hold_out(data, HoldOut(trajectories_percent=25, seed=seed)) for seed in (7, 7, 8)]
    held = [{c.trajectory for c in parts.test.conditions} for parts in draws]
    assert held[0] == held[1] != held[2]
    assert all(len(numbers) == 3 for numbers in held)
    assert pairs(draws[0].test) == {(n, load) for n in held[0] for load in (0, 1)}
    assert pairs(draws[0].train).isdisjoint(pairs(draws[0].test))
    said = ", ".join(str(number) for number in sorted(held[0]))
    assert draws[0].held_out == f"trajectories {said} (drawn, counted from 0)"


@pytest.mark.parametrize(
    ("percent", "total", "held"), [(1, 12, 1), (90, 2, 1), (50, 3, 2), (90, 12, 11), (25, 12, 3)]
)
def test_a_share_holds_out_one_trajectory_at_least_and_leaves_one(
    percent: float, total: int, held: int
) -> None:
    parts = hold_out(program(motions=total, loads=1), HoldOut(trajectories_percent=percent))
    assert len(pairs(parts.test)) == held
    assert len(pairs(parts.train)) == total - held


def test_a_share_and_loads_are_judged_together() -> None:
    parts = hold_out(program(motions=4), HoldOut(loads=(1,), trajectories_percent=25))
    ((number, load),) = pairs(parts.test)
    assert load == 1
    assert pairs(parts.train) == {(n, 0) for n in range(4)} - {(number, 0)}


def test_no_share_with_loads_holds_out_loads_alone() -> None:
    parts = hold_out(program(), HoldOut(loads=(1,), trajectories_percent=0))
    assert pairs(parts.test) == {(n, 1) for n in range(4)}


def test_poses_are_held_out_with_both_approaches_and_all_loads() -> None:
    parts = hold_out(program("dwell", motions=5), HoldOut(poses_percent=40))
    held = {c.pose for c in parts.test.conditions}
    assert len(held) == 2
    assert len(parts.test.conditions) == 2 * 2 * 2
    assert held.isdisjoint(c.pose for c in parts.train.conditions)


def test_poses_under_a_new_load_are_new_themselves_when_asked_for() -> None:
    parts = hold_out(program("dwell", motions=5), HoldOut(loads=(1,), poses_percent=20))
    assert {c.load for c in parts.test.conditions} == {1}
    assert len(parts.test.conditions) == 2
    assert pairs(parts.train, "pose").isdisjoint(pairs(parts.test, "pose"))
    held = {c.pose for c in parts.test.conditions}
    assert held.isdisjoint(c.pose for c in parts.train.conditions)


def test_the_last_trajectories_are_held_out_under_every_load() -> None:
    parts = hold_out(program(motions=5, loads=2), HoldOut(trajectories=2))
    assert pairs(parts.test) == {(3, 0), (4, 0), (3, 1), (4, 1)}
    assert parts.held_out == "the last 2 trajectories"


def test_the_same_motion_under_the_same_load_is_refused() -> None:
    data = program()
    first = data.select(lambda c: c.trajectory in (0, 1) and c.load == 0)
    second = data.select(lambda c: c.trajectory in (1, 2) and c.load == 0)
    with pytest.raises(DataError, match="the first is trajectory 1 with load 0"):
        assert_new_pairs(first, second)


def test_the_same_samples_under_another_load_are_refused() -> None:
    data = program().select(lambda c: c.trajectory == 1 and c.load == 0)
    relabelled = replace(data, conditions=tuple(replace(c, load=1) for c in data.conditions))
    with pytest.raises(DataError, match="samples of the test data are also in the training data"):
        assert_new_pairs(data, relabelled)


@pytest.mark.parametrize("how", [HoldOut(trajectories=0), HoldOut(loads=(7,))])
def test_holding_out_nothing_is_refused(how: HoldOut) -> None:
    with pytest.raises(DataError, match="nothing is held out"):
        hold_out(program(), how)


def test_holding_out_everything_is_refused() -> None:
    with pytest.raises(DataError, match="the run has 4 trajectories"):
        hold_out(program(), HoldOut(trajectories=4))
