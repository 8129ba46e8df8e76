"""Which rows are learned from: whole trajectories by default, row by row when a study says so."""

from __future__ import annotations

import numpy as np
import pytest

from hil.core.errors import DataError
from hil.data.splits import (
    TEST,
    TRAINING,
    VALIDATION,
    rows_to_fit,
    training_and_validation,
    with_part,
)
from hil.estimators.base import prepared
from hil.estimators.rigid_hysteresis import RigidHysteresis
from hil.estimators.rigid_linear import RigidWls
from tests.support.synthetic_memory import remembering
from tests.support.synthetic_motion import moving, nominal


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
    with pytest.raises(DataError, match="no rows are left to stop by"):
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
