"""Trainings of a Lagrangian network of which the one that validates best is kept."""

import numpy as np
import pytest

from hil.core.errors import FitError
from hil.estimators import estimator, load_model_file, save_model
from hil.networks import lagrangian_settings
from tests.support.synthetic_motion import moving, nominal

pytest.importorskip("torch", reason="torch is not installed")
from hil.networks import lagrangian

FAST, SLOW = {"friction": 1.0}, {"friction": 0.2}


def rates(friction, protocol="ours", **changed):
    training = lagrangian_settings.training_settings(protocol, 3, 0, changed)
    return [one.group_rates for one in lagrangian_settings.trials(friction, protocol, training)]


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


@pytest.mark.thorough
@pytest.mark.parametrize("order", [(1.0, 0.2), (0.2, 1.0)])
def test_the_trial_that_validates_best_is_kept(order, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(lagrangian_settings.FRICTION_RATES, "dissipative", order)
    data, robot = moving(1, 2, 3), nominal()
    both, told = made(), []
    both.checkpoints_, both.watch_ = tmp_path, told.append
    both.fit(data, robot)
    alone = [made(group_rates=rate).fit(data, robot) for rate in (FAST, SLOW)]
    best = min(alone, key=lambda one: one.curves_.best)
    assert alone[0].curves_.best != alone[1].curves_.best
    assert both.curves_.best == best.curves_.best
    assert all(np.array_equal(both.weights_[name], best.weights_[name]) for name in best.weights_)
    assert sorted(folder.name for folder in tmp_path.iterdir()) == ["trial-1", "trial-2"]
    assert {one.stage.split(":")[0] for one in told} == {"trial 1 of 2", "trial 2 of 2"}


def test_a_model_file_tells_of_every_trial(tmp_path) -> None:
    model = made().fit(moving(1, 2, 3), nominal())
    first, second = load_model_file(save_model(model, tmp_path / "model")).notes_
    assert first.startswith("trial 1 of 2, friction at 1 of the learning rate: validation error ")
    assert second.startswith("trial 2 of 2, friction at 0.2 of the learning rate: validation")


@pytest.mark.parametrize("diverging", [1, 2])
def test_a_trial_that_diverges_loses(diverging, monkeypatch) -> None:
    trained, calls = lagrangian._trained, []

    def spoiled(*args):
        calls.append(args)
        if len(calls) == diverging:
            raise FitError("training diverged")
        return trained(*args)

    monkeypatch.setattr(lagrangian, "_trained", spoiled)
    model = made().fit(moving(1, 2, 3), nominal())
    assert len(calls) == 2
    assert "training diverged" in model.notes_[diverging - 1]


def test_a_fit_fails_when_every_trial_diverges(monkeypatch) -> None:
    def spoiled(*args):
        raise FitError("training diverged")

    monkeypatch.setattr(lagrangian, "_trained", spoiled)
    with pytest.raises(FitError, match="diverged"):
        made().fit(moving(1, 2, 3), nominal())
