"""Datasets cut into groups: splits, folds, rows to learn from, recordings that are known again."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.core.errors import DataError
from hil.data import Conditions, Dataset
from hil.data.fingerprints import SKETCH_ROWS, Sketch, revisited
from hil.data.splits import (
    TEST,
    TRAINING,
    VALIDATION,
    assert_disjoint,
    groups,
    kfold,
    paper_sample_split,
    rows_to_fit,
    split,
    training_and_validation,
    with_part,
)
from hil.estimators.base import prepared
from hil.estimators.rigid_hysteresis import RigidHysteresis
from hil.estimators.rigid_linear import RigidWls
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import dataset, dwelling, moving, nominal


def of_conditions(conditions):
    """Two rows per series, all rows different."""
    rows = 2 * len(conditions)
    values = np.arange(rows * 6, dtype=float).reshape(rows, 6)
    columns = {"t": np.arange(rows, dtype=float), "q": values, "effort": values + 0.5}
    return dataset(columns, [2] * len(conditions), list(conditions))


def ids(data):
    return [condition.id for condition in data.conditions]


series = st.lists(
    st.tuples(st.integers(-1, 6), st.integers(0, 2), st.sampled_from(["a", "b"])),
    min_size=1,
    max_size=40,
)


@given(series, st.floats(0.05, 0.9), st.integers(0, 5))
@settings(deadline=None)
def test_split_keeps_groups_whole_and_loses_none(raw, share, seed) -> None:
    conditions = [
        Conditions(f"s{i}", "dwell", source, pose=pose, load=load)
        for i, (pose, load, source) in enumerate(raw)
    ]
    data = of_conditions(conditions)
    count = len(groups(data, "pose"))
    if count < 2 or max(1, round(share * count)) >= count:
        with pytest.raises(DataError):
            split(data, "pose", share, seed)
        return
    parts = split(data, "pose", share, seed)
    assert_disjoint(parts.train, parts.test)
    assert sorted(ids(parts.train) + ids(parts.test)) == sorted(
        c.id for c in conditions if c.pose >= 0
    )
    assert len(groups(parts.test, "pose")) == max(1, round(share * count))


def test_split_by_pose_keeps_both_approaches_together() -> None:
    parts = split(dwelling(20, both=True), "pose", 5)
    held = {condition.pose for condition in parts.test.conditions}
    assert len(parts.test.conditions) == 10
    assert held.isdisjoint(condition.pose for condition in parts.train.conditions)


def test_split_by_load_holds_out_the_named_load_everywhere() -> None:
    conditions = [Conditions(f"s{i}", "dwell", "ab"[i % 2], pose=i, load=i % 3) for i in range(9)]
    parts = split(of_conditions(conditions), "load", [2])
    assert {c.load for c in parts.test.conditions} == {2}
    assert {c.source for c in parts.test.conditions} == {"a", "b"}


def test_split_depends_on_nothing_but_the_seed() -> None:
    data = moving(*range(8), samples=20)
    assert ids(split(data, "trajectory", 3, seed=4).test) == ids(
        split(data, "trajectory", 3, seed=4).test
    )
    drawn = {tuple(ids(split(data, "trajectory", 3, seed=s).test)) for s in range(6)}
    assert len(drawn) > 1


def test_unknown_group_is_refused_with_those_there_are() -> None:
    with pytest.raises(DataError, match="no trajectory 7") as caught:
        split(moving(1, 2, samples=20), "trajectory", [7])
    assert "[1, 2]" in caught.value.hint


def test_folds_hold_every_group_out_once() -> None:
    data = moving(*range(7), samples=20)
    folds = list(kfold(data, "trajectory", 3, seed=1))
    assert sorted(name for fold in folds for name in ids(fold.test)) == sorted(ids(data))
    for fold in folds:
        assert_disjoint(fold.train, fold.test)


def test_shared_pose_is_found() -> None:
    data = dwelling(4, both=True)
    first = data.select(lambda c: c.approach == 1)
    second = data.select(lambda c: c.approach == -1)
    with pytest.raises(DataError, match="pose 0 of run"):
        assert_disjoint(first, second)


def test_same_recording_under_another_name_is_found() -> None:
    data = moving(1, samples=50)
    renamed = Dataset(
        **{**vars(data), "conditions": (Conditions("other", "trajectory", "elsewhere", 9),)}
    )
    with pytest.raises(DataError, match=r"50 samples of the test data.* of elsewhere") as caught:
        assert_disjoint(data, renamed)
    assert caught.value.message.endswith(f" in {data.conditions[0].source}")
    assert "a different excitation.seed" in caught.value.hint


def test_different_recordings_of_equal_numbers_pass() -> None:
    assert_disjoint(moving(1, samples=50), moving(2, samples=50))


def test_papers_split_by_sample_shares_poses_which_the_guard_sees() -> None:
    train, test, third = paper_sample_split(dwelling(30), seed=1)
    assert len(train) + len(test) + len(third) == 300
    assert len(train) == pytest.approx(225, abs=30)
    with pytest.raises(DataError, match="both training and test"):
        assert_disjoint(train, test)


def test_same_recording_with_its_clock_shifted_is_found() -> None:
    data = moving(1, samples=50)
    shifted = Dataset(
        **{
            **vars(data),
            "columns": {**data.columns, "t": data["t"] + 1234.5},
            "conditions": (Conditions("other", "trajectory", "elsewhere", 9),),
        }
    )
    with pytest.raises(DataError, match="50 samples of the test data"):
        assert_disjoint(data, shifted)


def test_standing_still_at_the_same_place_is_no_shared_recording() -> None:
    """Brakes on, current zero, the same park position: one distinct sample, many rows."""

    def parked(seed, source):
        columns = {
            name: values.copy() for name, values in moving(seed, samples=200).columns.items()
        }
        columns["q"][:100], columns["effort"][:100] = 0.5, 0.0
        return dataset(columns, [200], [Conditions(source, "trajectory", source, 0)])

    assert_disjoint(parked(1, "a"), parked(2, "b"))


@pytest.mark.parametrize("nothing", [0, 0.0, []])
def test_holding_out_nothing_holds_out_nothing(nothing) -> None:
    parts = split(dwelling(6), "pose", nothing)
    assert parts.held_out == ()
    assert len(parts.test) == 0
    assert len(parts.train.conditions) == 6


def test_negative_share_is_refused() -> None:
    with pytest.raises(DataError, match=r"cannot hold out -0\.1 of 6"):
        split(dwelling(6), "pose", -0.1)


def test_sketch_of_a_long_recording_tells_what_share_it_knows() -> None:
    train, new = moving(*range(20)), moving(21, 22)
    assert len(train) > SKETCH_ROWS
    sketch = Sketch.of(train)
    assert len(sketch.smallest) == SKETCH_ROWS
    mixed = Dataset.concatenate([new, train.select(lambda c: c.trajectory < 2)])
    assert sketch.share_known(new) == 0.0
    assert sketch.share_known(train) == 1.0
    assert sketch.share_known(mixed) == pytest.approx(0.5, abs=0.05)


def test_same_motion_of_another_arm_is_seen_as_revisited() -> None:
    first = moving(1, 2)
    # Another arm: tracking errors, other currents, another clock, half the rate.
    random = np.random.default_rng(3)
    again = moving(2, 5)
    rows = np.concatenate([np.arange(0, 600, 2), np.arange(600, 1200, 2)])
    columns = {name: values[rows] for name, values in again.columns.items()}
    columns["q"] = columns["q"] + 0.003 * random.normal(size=columns["q"].shape)
    other = dataset(columns, [300, 300], list(again.conditions))
    shares = revisited(first, other)
    assert shares["trajectory2"] > 0.95
    assert shares["trajectory5"] < 0.05


def test_repeated_poses_are_seen_as_revisited() -> None:
    shares = revisited(dwelling(8, seed=1), dwelling(8, seed=1, noise_a=0.01))
    assert set(shares.values()) == {1.0}
    assert set(revisited(dwelling(8, seed=1), dwelling(8, seed=2)).values()) == {0.0}


# Which rows are learned from: whole trajectories, or row by row when a study says so


def test_whole_trajectories_are_held_out_to_stop_by() -> None:
    data = moving(*range(1, 10))
    learn, validate = training_and_validation(data)
    assert not np.any(learn & validate)
    assert np.all(learn | validate)
    held = [bool(np.all(validate[rows])) for _, rows in data.slices()]
    assert sum(held) == 2
    assert [bool(np.any(validate[rows])) for _, rows in data.slices()] == held


def test_another_seed_holds_out_others() -> None:
    data = moving(*range(1, 10))
    drawn = {training_and_validation(data, seed=seed)[1].tobytes() for seed in range(5)}
    assert len(drawn) > 1
    assert np.array_equal(
        training_and_validation(data, seed=3)[1], training_and_validation(data, seed=3)[1]
    )


def test_the_end_of_a_single_trajectory_is_held_out_behind_a_gap() -> None:
    learn, validate = training_and_validation(moving(1))
    assert np.max(np.flatnonzero(learn)) + 5 < np.min(np.flatnonzero(validate))
    assert validate[-1]


def test_a_study_says_it_row_by_row() -> None:
    data = moving(1, 2)
    part = np.random.default_rng(0).choice([TRAINING, VALIDATION, TEST], len(data))
    learn, validate = training_and_validation(with_part(data, part))
    assert np.array_equal(learn, part == TRAINING)
    assert np.array_equal(validate, part == VALIDATION)


def test_data_without_anything_to_stop_by_are_refused() -> None:
    data = moving(1, 2)
    with pytest.raises(DataError, match="no rows are left for early stopping"):
        training_and_validation(with_part(data, np.full(len(data), TRAINING)))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("model", "data"),
    [
        (RigidWls(), moving(1, 2)),
        (RigidHysteresis(consistent=False), remembering(1, 2)),
    ],
)
def test_rows_that_are_judged_are_not_learned_from(model, data) -> None:
    part = np.full(len(data), TRAINING)
    part[50:100] = TEST
    marked = with_part(data, part)
    filtered = model.fit(marked, nominal()).predict(marked).effort
    seen = prepared(marked, getattr(model, "filters_", None) or model.filters)
    spoilt = seen["effort_f"].copy()
    spoilt[50:100] += 1000.0
    again = type(model)(**model.get_params()).fit(seen.with_columns(effort_f=spoilt), nominal())
    assert again.predict(marked).effort == pytest.approx(filtered, abs=1e-9)
    assert rows_to_fit(marked).sum() == len(data) - 50
