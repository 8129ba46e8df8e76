"""Trainings of a Lagrangian network of which the one that validates best is kept."""

import pytest
from synthetic_motion import moving, nominal

from hil.identify import estimator
from hil.identify.lagrangian import choices

pytest.importorskip("torch", reason="torch is not installed")

FAST, SLOW = {"friction": 1.0}, {"friction": 0.2}


def rates(friction, protocol="ours", **changed):
    training = choices.training_settings(protocol, 3, 0, changed)
    return [one.group_rates for one in choices.trials(friction, protocol, training)]


def made(**training):
    quick = {"epochs": 3, "batch_size": 300, "device": "cpu", **training}
    return estimator(
        "lagrangian", friction="dissipative", network={"hidden": [12]}, training=quick
    )  # fmt: skip


def test_a_dissipative_network_is_tried_with_a_slow_rate_as_well() -> None:
    assert rates("dissipative") == [{}, SLOW]
    assert rates("dissipative", group_rates={"dynamics": 0.5}) == [
        {"dynamics": 0.5}, {"dynamics": 0.5, **SLOW},
    ]  # fmt: skip


def test_given_rates_and_those_of_the_paper_are_tried_alone() -> None:
    assert rates("dissipative", group_rates=FAST) == [FAST]
    assert rates("dissipative", "paper") == [{}]
    assert rates("stribeck") == [{}]


def test_the_trial_that_validates_best_is_kept(tmp_path) -> None:
    data, robot = moving(1, 2, 3), nominal()
    both = made()
    both.checkpoints_ = tmp_path
    both.fit(data, robot)
    alone = [made(group_rates=rate).fit(data, robot) for rate in (FAST, SLOW)]
    assert alone[0].curves_.best != alone[1].curves_.best
    assert both.curves_.best == min(one.curves_.best for one in alone)
    assert sorted(folder.name for folder in tmp_path.iterdir()) == ["trial-1", "trial-2"]
