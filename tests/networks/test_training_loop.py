"""The loop that trains networks: what it keeps, when it stops, what it freezes."""

from __future__ import annotations

import pytest

from hil.core.errors import FitError, SpecError

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.networks.training import Stage, TrainingSettings, hybrid_stages, joint_stages  # noqa: E402
from hil.networks.training_loop import Steps, torch_device, train  # noqa: E402
from tests.support.training_parts import LEARN, SmallProblem, Watched, equal, weights  # noqa: E402

SETTINGS = TrainingSettings(epochs=10, batch_size=32, warm_up_steps=5, learning_rate=0.01)


def test_training_lowers_the_validation_error() -> None:
    small = SmallProblem()
    before = small.validate()
    curves = train(small, joint_stages(SETTINGS), SETTINGS)
    assert small.validate() < 0.3 * before
    assert curves.untrained == before


def test_equal_seeds_give_equal_bits() -> None:
    first, second = SmallProblem(dropout=0.3), SmallProblem(dropout=0.3)
    for small in (first, second):
        torch.rand(7)  # The caller's random numbers do not matter.
        train(small, joint_stages(SETTINGS), SETTINGS)
    assert equal(weights(first), weights(second))


def test_another_seed_gives_other_weights() -> None:
    first, second = SmallProblem(), SmallProblem()
    train(first, joint_stages(SETTINGS), SETTINGS)
    train(second, joint_stages(SETTINGS), SETTINGS.model_copy(update={"seed": 1}))
    assert not equal(weights(first), weights(second))


def test_the_callers_random_numbers_and_threads_are_left_alone() -> None:
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    threads = torch.get_num_threads()
    train(SmallProblem(dropout=0.3), joint_stages(SETTINGS), SETTINGS)
    assert torch.equal(torch.rand(4), expected)
    assert torch.get_num_threads() == threads


def test_every_sample_is_seen_once_an_epoch_in_another_order() -> None:
    small = SmallProblem()
    train(small, joint_stages(SETTINGS.model_copy(update={"epochs": 2})), SETTINGS)
    first, second = small.order[:LEARN], small.order[LEARN:]
    assert sorted(first) == sorted(second) == list(range(LEARN))
    assert first != second


def test_the_weights_that_validated_best_are_kept() -> None:
    small = SmallProblem()
    seen: list[tuple[float, dict[str, torch.Tensor]]] = []
    wild = TrainingSettings(epochs=8, learning_rate=1.0, schedule="constant", warm_up_steps=0)
    curves = train(
        small, joint_stages(wild), wild, lambda told: seen.append((told.validation, weights(small)))
    )
    best = min(seen, key=lambda one: one[0])
    assert best[0] < seen[-1][0], "the last epoch is the best: the test shows nothing"
    assert equal(weights(small), best[1])
    assert small.validate() == pytest.approx(curves.best, rel=1e-6)


def test_a_network_that_training_only_worsens_stays_as_it_was() -> None:
    small = SmallProblem()
    before = weights(small)
    error = iter([1.0, 2.0, 3.0, 4.0])
    small.validate = lambda: next(error)  # type: ignore[method-assign]
    curves = train(small, (Stage("joint", (), 3, 5),), SETTINGS)
    assert equal(weights(small), before)
    assert (curves.best, curves.best_epoch) == (1.0, 0)


def test_a_stage_ends_when_patience_does_and_the_next_goes_on_from_its_best() -> None:
    small, watch = SmallProblem(), Watched()
    errors = iter([9.0, 5.0, 4.0, 6.0, 6.0, 4.5, 3.0])
    small.validate = lambda: next(errors)  # type: ignore[method-assign]
    states: list[dict[str, torch.Tensor]] = []

    def keep(told: object) -> None:
        states.append(weights(small))
        watch(told)  # type: ignore[arg-type]

    train(small, (Stage("a", (), 10, 2), Stage("b", ("friction",), 2, 2)), SETTINGS, keep)
    assert [told.stage for told in watch.told] == ["a"] * 4 + ["b"] * 2
    # What stage b does not train is what it was after epoch 2, the best of stage a.
    assert torch.equal(states[4]["dynamics.0.weight"], states[1]["dynamics.0.weight"])
    assert not torch.equal(states[3]["dynamics.0.weight"], states[1]["dynamics.0.weight"])
    assert [told.epochs for told in watch.told] == [12, 12, 12, 12, 6, 6]


def test_a_frozen_group_does_not_move_and_is_free_again_afterwards() -> None:
    small = SmallProblem()
    train(small, (Stage("dynamics", ("dynamics",), 3, 3),), SETTINGS)
    assert torch.equal(small.module.friction, torch.zeros(2))
    assert small.module.friction.requires_grad


def test_nothing_is_differentiated_for_a_frozen_group() -> None:
    small, free = SmallProblem(), []
    small.spoil = lambda loss: (free.append(small.module.friction.requires_grad), loss)[1]
    train(small, (Stage("dynamics", ("dynamics",), 1, 1),), SETTINGS)
    assert not any(free)


def test_hybrid_stages_take_turns_and_share_the_epochs() -> None:
    settings = TrainingSettings(epochs=96, patience=7, loops=3)
    stages = hybrid_stages(settings)
    assert [stage.epochs for stage in stages] == [20, 8, 20, 8, 20, 8, 12]
    assert [stage.trains for stage in stages] == [(), ("dynamics",)] * 3 + [("dynamics",)]
    rates = [stage.learning_rate_factor for stage in stages]
    assert rates == pytest.approx([1, 1, 0.6, 0.6, 0.36, 0.36, 0.216])
    assert {stage.patience for stage in stages} == {7}


def test_a_group_that_is_not_there_is_refused_by_name() -> None:
    with pytest.raises(SpecError, match=r"trains 'frictoin'.*dynamics, friction") as caught:
        train(SmallProblem(), (Stage("a", ("frictoin",), 1, 1),), SETTINGS)
    assert "friction" in caught.value.hint


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_loss_that_is_no_number_says_what_to_lower(value: float) -> None:
    small = SmallProblem()
    small.spoil = lambda loss: loss * value
    with pytest.raises(FitError, match=r"diverged: the loss is .* in epoch 1") as caught:
        train(small, joint_stages(SETTINGS), SETTINGS)
    assert "lower learning_rate" in caught.value.hint


def test_a_validation_error_that_is_no_number_is_told() -> None:
    small = SmallProblem()
    small.x[LEARN] = float("nan")
    with pytest.raises(FitError, match="validation error is nan before the first step"):
        train(small, joint_stages(SETTINGS), SETTINGS)


def test_the_rate_warms_up_and_falls_to_its_last_share() -> None:
    settings = TrainingSettings(learning_rate=1.0, warm_up_steps=4, final_rate=0.02)
    steps = Steps(SmallProblem().groups(), Stage("a", (), 10, 1, 0.5), settings, per_epoch=10)
    assert steps.rate(0) == pytest.approx(0.125)
    assert steps.rate(50) == pytest.approx(0.5 * 0.51)
    assert steps.rate(100) == pytest.approx(0.01)
    assert max(steps.rate(k) for k in range(100)) <= 0.5


def test_groups_have_rates_of_their_own() -> None:
    """Adam's first step is as long as its rate."""
    settings = SETTINGS.model_copy(update={"group_rates": {"friction": 3.0}, "warm_up_steps": 0})
    small = SmallProblem()
    steps = Steps(small.groups(), Stage("a", (), 1, 1), settings, per_epoch=1)
    steps.take(small.loss(torch.arange(LEARN)), 0)
    assert small.module.friction.abs().tolist() == pytest.approx([0.03, 0.03], rel=1e-3)


def test_weight_decay_spares_coefficients() -> None:
    settings = SETTINGS.model_copy(update={"weight_decay": 0.5, "warm_up_steps": 0})
    small = SmallProblem()
    small.module.friction.data.fill_(1.0)
    first = small.module.dynamics[0].weight.detach().clone()
    steps = Steps(small.groups(), Stage("a", (), 1, 1), settings, per_epoch=1)
    nothing = sum(one.sum() for group in small.groups().values() for one in group) * 0.0
    steps.take(nothing, 0)
    assert torch.equal(small.module.friction, torch.ones(2))
    assert torch.allclose(small.module.dynamics[0].weight, first * (1 - 0.01 * 0.5))


def test_long_gradients_are_shortened() -> None:
    """Steps of Adam do not show the length of a gradient: what it averages does."""
    small = SmallProblem()
    settings = SETTINGS.model_copy(update={"clip_norm": 0.1})
    steps = Steps(small.groups(), Stage("a", (), 1, 1), settings, per_epoch=1)
    steps.take(1e6 * small.loss(torch.arange(LEARN)), 0)
    moments = [value for name, value in steps.state().items() if name.endswith("exp_avg")]
    length = torch.sqrt(sum(((one / 0.1) ** 2).sum() for one in moments))
    assert float(length) == pytest.approx(0.1, rel=1e-3)


def test_amp_trains_as_well() -> None:
    settings = SETTINGS.model_copy(update={"amp": True})
    small = SmallProblem()
    curves = train(small, joint_stages(settings), settings)
    assert curves.best < 0.3 * curves.untrained


def test_a_device_that_is_not_there_is_refused_with_a_way_out() -> None:
    with pytest.raises(SpecError, match="cuda:97") as caught:
        torch_device("cuda:97")
    assert "auto" in caught.value.hint


cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")


@cuda
def test_auto_is_the_gpu_where_there_is_one() -> None:
    assert torch_device("auto").type == "cuda"


@cuda
def test_a_gpu_trains_to_the_same_error_as_the_cpu() -> None:
    found = []
    for device in ("cpu", "cuda"):
        small = SmallProblem(device=device)
        found.append(train(small, joint_stages(SETTINGS), SETTINGS).best)
    assert found[1] == pytest.approx(found[0], rel=0.01)
