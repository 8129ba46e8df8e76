"""Who errs less, on the same data; chance is no reason."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hil.core.errors import RegistryError
from hil.data import Dataset
from hil.estimators import estimator
from hil.estimators.base import RobotEstimator
from hil.estimators.model_file import Training
from hil.models.promotion import BLOCK_S, Comparison, compare, fresh_part
from tests.support.synthetic_motion import moving, nominal

NOISE_A = 0.05
JOINTS = tuple(f"j{k + 1}" for k in range(6))


def fitted(data: Dataset) -> RobotEstimator:
    return estimator("rigid-wls").fit(data, nominal())


def rougher(data: Dataset, joint: int, amount_a: float) -> Dataset:
    """As after wear: one joint with more dry friction."""
    more = np.zeros_like(data["effort"])
    more[:, joint] = amount_a * np.tanh(data["qd"][:, joint] / 0.01)
    changed = {name: data[name] + more for name in ("effort", "effort_f")}
    return replace(data, columns=dict(data.columns) | changed)


@pytest.fixture(scope="module")
def champion() -> RobotEstimator:
    return fitted(moving(1, 2, 3, noise_a=NOISE_A))


def judged(
    ratio: np.ndarray,
    sure: int | None = None,
    difference: float = -0.2,
    interval: tuple[float, float] = (-0.3, -0.1),
) -> Comparison:
    """A comparison in which the challenger errs `ratio` times as much, in one joint for sure."""
    old = np.full(6, 0.1)
    return Comparison(
        "A", JOINTS, (), 1000, 20, old, old * ratio, difference, interval, np.arange(6) == sure
    )


@pytest.mark.parametrize(
    ("times", "sure", "spoilt"),
    [
        (1.04, 4, False),
        (1.06, None, False),
        (1.06, 4, True),
        (1.24, None, False),
        (1.26, None, True),
    ],
)
def test_a_joint_is_spoilt_if_it_errs_noticeably_more_for_sure_or_much_more(
    times: float, sure: int | None, spoilt: bool
) -> None:
    told = judged(np.array([1, 0.4, 1, 1, times, 1]), sure)
    assert told.better is not spoilt
    assert told.worse is spoilt
    assert ("j5 errs" in told.words) is spoilt


FRESH = (11, 12, 13, 14, 15, 16)


def test_after_wear_who_learned_of_it_errs_less(champion) -> None:
    challenger = fitted(rougher(moving(4, 5, 6, noise_a=NOISE_A), 1, 0.1))
    told = compare(champion, challenger, [rougher(moving(*FRESH, noise_a=NOISE_A), 1, 0.1)])
    assert told.better
    assert not told.worse
    assert told.ratio[1] < 0.6
    assert told.blocks == len(FRESH)
    assert told.words.startswith("the challenger errs less: -")
    back = compare(challenger, champion, [moving(*FRESH, noise_a=NOISE_A)])
    assert back.better


def test_who_learned_too_little_errs_more(champion) -> None:
    few = fitted(moving(4, noise_a=8 * NOISE_A))
    told = compare(champion, few, [moving(*FRESH, noise_a=NOISE_A)])
    assert told.worse
    assert not told.better
    assert "errs more" in told.words


@pytest.mark.thorough
def test_equals_are_rarely_told_apart() -> None:
    """Nobody of six who learned as much is sure to err less than all the others."""
    of = [fitted(moving(*range(100 + 3 * k, 103 + 3 * k), noise_a=NOISE_A)) for k in range(6)]
    data = [moving(*range(900, 912), noise_a=NOISE_A)]
    wins = [compare(old, new, data).better for old, new in pairwise([*of, of[0]])]
    assert sum(wins) <= 2


@pytest.mark.thorough
def test_a_joint_that_gets_clearly_worse_is_not_outweighed(champion) -> None:
    data = rougher(moving(4, 5, 6, noise_a=NOISE_A), 1, 0.3)
    challenger = fitted(rougher(data, 4, 0.02))
    told = compare(champion, challenger, [rougher(moving(*FRESH, noise_a=NOISE_A), 1, 0.3)])
    assert told.difference < 0
    assert told.worse
    assert not told.better
    assert told.words.startswith("wrist_2_joint errs ")
    assert told.surely_more.tolist() == [False] * 4 + [True, False]


def test_who_errs_a_little_more_everywhere_is_worse() -> None:
    """No joint by itself errs so much more that it would be turned down."""
    told = judged(1.02 * np.ones(6), difference=0.04, interval=(-0.01, 0.09))
    assert told.worse
    assert not told.better
    assert "errs more" in told.words


def test_too_little_data_decide_nothing(champion) -> None:
    with pytest.raises(RegistryError, match=f"only 2 distinct blocks of {BLOCK_S:.0f} s"):
        compare(champion, champion, [moving(11, 12)])


@pytest.mark.thorough
def test_the_same_motion_driven_again_is_no_new_evidence(champion) -> None:
    """Only its noise is new: what a model gets wrong along it, it gets wrong again."""
    challenger = fitted(moving(4, 5, 6, noise_a=NOISE_A))
    again = [moving(*FRESH, noise_a=NOISE_A * k) for k in (1, 2)]
    once, twice = (compare(champion, challenger, again[:k]) for k in (1, 2))
    assert twice.blocks == once.blocks == len(FRESH)
    assert twice.samples == 2 * once.samples


def test_models_of_another_unit_are_not_compared(champion) -> None:
    other = fitted(moving(1, 2, 3, kind="torque"))
    with pytest.raises(RegistryError, match="effort kind are current"):
        compare(champion, other, [moving(*FRESH)])


def test_of_a_run_that_was_learned_from_only_held_out_series_count() -> None:
    data = moving(1, 2, 3, 4, 5, noise_a=NOISE_A)
    learned = [model_of(data.take([0, 1, 2])), model_of(data.take([2, 3]))]
    assert [one.id for one in fresh_part(learned[:1], data).conditions] == [
        one.id for one in data.conditions[3:]
    ]
    assert len(fresh_part(learned, data).conditions) == 1


def model_of(data: Dataset) -> RobotEstimator:
    model = fitted(data)
    model.training_ = Training.of(data)
    return model
