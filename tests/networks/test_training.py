"""Training of networks: losses, the loop, and checkpoints from which it goes on bit by bit."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.special import huber

from hil.core.errors import CheckpointRefused, DataError, FitError, HilError, SpecError
from hil.estimators.parameters import settings
from hil.networks.training import Curves, Told, TrainingSettings, sparkline

torch = pytest.importorskip("torch", reason="torch is not installed")

from safetensors.torch import load, save  # noqa: E402

from hil.core import json_document  # noqa: E402
from hil.networks import checkpoint  # noqa: E402
from hil.networks.checkpoint import FILE, Checkpoints  # noqa: E402
from hil.networks.training import Stage, hybrid_stages, joint_stages  # noqa: E402
from hil.networks.training_loop import Loss, Steps, torch_device, train  # noqa: E402
from tests.support.training_parts import LEARN, SmallProblem, Watched, equal, weights  # noqa: E402

# Losses against numpy, settings, curves

SCALE = np.array([10.0, 2.0])


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return rng.normal(size=(40, 2)) * SCALE, rng.normal(size=(40, 2)) * SCALE


def value(kind: str, predicted: np.ndarray, measured: np.ndarray) -> float:
    return float(Loss(kind, SCALE)(torch.tensor(predicted), torch.tensor(measured)))  # type: ignore[arg-type]


def test_smape_is_equation_20(pair: tuple[np.ndarray, np.ndarray]) -> None:
    p, m = pair
    total = sum(
        2 * abs(p[j, i] - m[j, i]) / (abs(p[j, i]) + abs(m[j, i]))
        for i in range(2)
        for j in range(len(p))
    )
    assert value("smape", p, m) == pytest.approx(total / (2 * len(p)), rel=1e-12)


def test_smape_of_nothing_from_nothing_is_0_with_a_finite_gradient() -> None:
    predicted = torch.zeros(3, 2, requires_grad=True)
    loss = Loss("smape", SCALE)(predicted, torch.zeros(3, 2))
    torch.autograd.backward(loss)
    assert float(loss.detach()) == 0.0
    assert torch.isfinite(predicted.grad).all()


def test_smape_has_no_gradient_where_the_signs_differ_and_the_floored_one_has() -> None:
    """The dead zone that makes training by eq. (20) slow."""
    slopes = {}
    for kind in ("smape", "smape-floored"):
        predicted = torch.tensor([[-5.0, 1.0]], requires_grad=True)
        torch.autograd.backward(Loss(kind, SCALE)(predicted, torch.tensor([[5.0, -1.0]])))
        slopes[kind] = predicted.grad.abs()
    assert float(slopes["smape"].max()) < 1e-7
    assert float(slopes["smape-floored"].min()) > 1e-3


def test_the_floor_is_a_tenth_of_the_standard_deviation() -> None:
    assert value("smape-floored", np.zeros((1, 2)), SCALE[None]) == pytest.approx(2 / 1.1)


def test_errors_count_in_standard_deviations(pair: tuple[np.ndarray, np.ndarray]) -> None:
    p, m = pair
    e = (p - m) / SCALE
    assert value("mse", p, m) == pytest.approx(np.mean(e**2), rel=1e-12)
    assert value("mae", p, m) == pytest.approx(np.mean(np.abs(e)), rel=1e-12)


def test_huber_turns_straight_at_a_twentieth(pair: tuple[np.ndarray, np.ndarray]) -> None:
    p, m = pair
    e = (p - m) / SCALE
    # scipy's turns at delta with slope delta; torch's smooth form has slope 1 beyond it.
    assert value("huber", p, m) == pytest.approx(np.mean(huber(0.05, e)) / 0.05, rel=1e-10)


def test_an_unknown_loss_is_refused() -> None:
    with pytest.raises(SpecError, match="loss is 'rmse'"):
        Loss("rmse", SCALE)  # type: ignore[arg-type]


def test_the_papers_settings_are_its_own() -> None:
    literal = TrainingSettings.literal(epochs=7)
    assert (literal.batch_size, literal.learning_rate) == (50, 5e-4)
    assert (literal.schedule, literal.loss, literal.clip_norm) == ("constant", "smape", None)
    assert literal.epochs == 7


@pytest.mark.parametrize(
    "given",
    [
        {"epochs": 0},
        {"epoch": 5},
        {"device": "gpu"},
        {"learning_rate": float("nan")},
        {"clip_norm": float("inf")},
        {"amp": True, "precision": "float64"},
        {"group_rates": {"friction": -1}},
    ],
)
def test_settings_that_cannot_be_are_refused_by_name(given: dict[str, object]) -> None:
    with pytest.raises(SpecError, match="training"):
        settings("training", given, TrainingSettings)


def test_curves_come_back_from_json_as_they_were() -> None:
    curves = Curves(2.0)
    for epoch, stage in enumerate(("a", "a", "b"), start=1):
        curves.add(Told(stage, epoch, 3, 1 / epoch, 0.1 * epoch, 0.1, 1e-3 / 3))
    facts = json.loads(json.dumps(curves.to_dict()))
    assert Curves.from_dict(facts) == curves
    assert curves.spans() == [("a", 2), ("b", 1)]
    assert (curves.best, curves.best_epoch) == (pytest.approx(0.1), 1)


@pytest.mark.parametrize("damage", [{"loss": [1.0]}, {"stages": [["a", "x"]]}, {"loss": None}])
def test_damaged_curves_are_refused(damage: dict[str, object]) -> None:
    curves = Curves(2.0)
    curves.add(Told("a", 1, 2, 1.0, 1.0, 1.0, 1e-3))
    curves.add(Told("a", 2, 2, 1.0, 1.0, 1.0, 1e-3))
    with pytest.raises((KeyError, TypeError, ValueError)):
        Curves.from_dict(curves.to_dict() | damage)


def test_a_sparkline_falls_with_the_curve() -> None:
    assert sparkline([100.0, 10.0, 1.0]) == "█▅▁" or sparkline([100.0, 10.0, 1.0]) == "█▄▁"
    assert len(sparkline([1.0 + k for k in range(500)], width=24)) == 24
    assert sparkline([float("nan")]) == ""


# The loop: what it keeps, when it stops, what it freezes

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
    assert torch_device("auto").type in ("cpu", "cuda")
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


# Checkpoints

STAGED = TrainingSettings(epochs=12, batch_size=32, loops=1, patience=4, warm_up_steps=3)
STAGES = hybrid_stages(STAGED)
"""6, 2 and 4 epochs."""


def trained(
    folder: Path | None = None, watch: Watched | None = None, **problem: float
) -> tuple[dict[str, torch.Tensor], Curves]:
    small = SmallProblem(dropout=0.2, **problem)
    curves = train(small, STAGES, STAGED, watch or Watched(), folder)
    return weights(small), curves


def interrupted(folder: Path, after: int) -> None:
    with pytest.raises(KeyboardInterrupt):
        trained(folder, Watched(raise_after=after))


@pytest.mark.thorough
@pytest.mark.parametrize("after", [2, 5, 7, 8, 9, 11])
def test_an_interrupted_training_ends_with_the_same_bits(tmp_path: Path, after: int) -> None:
    whole, curves = trained()
    interrupted(tmp_path, after)
    watch = Watched()
    resumed, found = trained(tmp_path, watch)
    assert equal(whole, resumed)
    assert found.to_dict() == curves.to_dict()
    # The epoch in which it was interrupted is trained again, those before it are not.
    assert watch.told[0].epoch == after


@pytest.mark.thorough
def test_a_training_interrupted_twice_ends_with_the_same_bits(tmp_path: Path) -> None:
    interrupted(tmp_path, 4)
    interrupted(tmp_path, 4)
    assert equal(trained(tmp_path)[0], trained()[0])


def test_checkpoints_change_nothing_of_a_network_that_draws(tmp_path: Path) -> None:
    """Such as crops of a motion: the loss that tells data apart draws as well."""
    found = []
    for folder in (None, tmp_path):
        small = SmallProblem()
        small.spoil = lambda loss: loss * (0.5 + torch.rand(()))
        train(small, STAGES, STAGED, checkpoints=folder)
        found.append(weights(small))
    assert equal(*found)


def test_a_finished_training_is_not_repeated(tmp_path: Path) -> None:
    first, curves = trained(tmp_path)
    watch = Watched()
    again, found = trained(tmp_path, watch)
    assert watch.told == []
    assert equal(first, again)
    assert found.to_dict() == curves.to_dict()


def test_other_data_are_refused(tmp_path: Path) -> None:
    interrupted(tmp_path, 3)
    small = SmallProblem(dropout=0.2)
    small.y = small.y.roll(1, dims=0)
    with pytest.raises(DataError, match="validation error before training was") as caught:
        train(small, STAGES, STAGED, checkpoints=tmp_path)
    assert "different folder" in caught.value.hint


def test_other_settings_are_refused_by_name(tmp_path: Path) -> None:
    interrupted(tmp_path, 3)
    with pytest.raises(DataError, match="settings was"):
        train(
            SmallProblem(dropout=0.2), STAGES, STAGED.model_copy(update={"seed": 1}),
            checkpoints=tmp_path,
        )  # fmt: skip


def test_other_stages_are_refused(tmp_path: Path) -> None:
    interrupted(tmp_path, 3)
    with pytest.raises(DataError, match="stages was"):
        train(SmallProblem(dropout=0.2), joint_stages(STAGED), STAGED, checkpoints=tmp_path)


def test_a_machine_with_another_device_may_go_on(tmp_path: Path) -> None:
    interrupted(tmp_path, 3)
    there = STAGED.model_copy(update={"device": "cpu"})
    small, watch = SmallProblem(dropout=0.2), Watched()
    train(small, STAGES, there, watch, tmp_path)
    assert watch.told[0].epoch == 3


@pytest.mark.parametrize("damage", ["tensors", "document", "gone", "field"])
def test_a_damaged_checkpoint_is_refused_with_its_remedy(tmp_path: Path, damage: str) -> None:
    interrupted(tmp_path, 3)
    path = tmp_path / FILE
    document = json.loads(path.read_bytes())
    tensors = tmp_path / document["tensors"]
    if damage == "tensors":
        tensors.write_bytes(tensors.read_bytes()[:-1] + b"x")
    elif damage == "gone":
        tensors.unlink()
    elif damage == "document":
        path.write_text(path.read_text()[:100])
    else:
        document.pop("facts")
        path.write_text(json.dumps(document))
    with pytest.raises(DataError) as caught:
        trained(tmp_path)
    assert caught.value.hint


@pytest.mark.thorough
@pytest.mark.parametrize("version", [1, 99, True, "2", None, {}])
def test_a_checkpoint_of_another_version_is_refused_as_such(tmp_path: Path, version) -> None:
    interrupted(tmp_path, 3)
    path = tmp_path / FILE
    document = json.loads(path.read_bytes()) | {"hil_checkpoint": version}
    if version == 1:
        del document["facts_sha256"]  # there was none
    path.write_text(json.dumps(document))
    with pytest.raises(CheckpointRefused, match="of a different version of hil") as caught:
        trained(tmp_path)
    assert "restart the training" in caught.value.hint


def test_one_state_is_left_in_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "EVERY", 0.0)
    trained(tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.thorough
def test_a_crash_while_writing_leaves_the_checkpoint_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = trained()[0]
    monkeypatch.setattr(checkpoint, "EVERY", 0.0)
    real, writes = checkpoint.write_whole, []

    def crash(path: Path, content: bytes) -> None:
        writes.append(path)
        if len(writes) == 6:  # The document of the third epoch; its tensors are there.
            raise RuntimeError("power cut")
        real(path, content)

    monkeypatch.setattr(checkpoint, "write_whole", crash)
    with pytest.raises(RuntimeError, match="power cut"):
        trained(tmp_path)
    watch = Watched()
    assert equal(trained(tmp_path, watch)[0], whole)
    assert watch.told[0].epoch == 3


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="no checkpoint can be written"):
        trained(tmp_path / "file")


class Unkept(Watched):
    """Would rather go on without checkpoints."""

    why: HilError | None = None

    def not_kept(self, error: HilError) -> None:
        assert self.why is None
        self.why = error


@pytest.mark.thorough
@pytest.mark.parametrize("every", [0.0, 10.0])
def test_a_full_disk_does_not_end_a_training_whose_watch_hears_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: float
) -> None:
    monkeypatch.setattr(checkpoint, "EVERY", every)
    (tmp_path / "file").write_text("")
    watch = Unkept()
    found, curves = trained(tmp_path / "file", watch)
    assert equal(found, trained()[0])
    assert len(watch.told) == len(curves)
    assert "no checkpoint can be written" in str(watch.why)


def test_writes_wait_for_their_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[int] = []
    monkeypatch.setattr(Checkpoints, "write", lambda self: written.append(1))
    trained(tmp_path)
    assert len(written) == 1  # At the end; twelve epochs take less than ten seconds.


def refused(folder: Path) -> None:
    with pytest.raises(CheckpointRefused) as caught:
        trained(folder)
    assert caught.value.hint
    assert caught.value.folder == folder


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"\xff", b"[" * 100_000, b"null", b"{}", b'{"hil_checkpoint": 2}']
)
def test_a_document_that_is_none_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / FILE).write_bytes(content)
    refused(tmp_path)


@pytest.mark.thorough
@pytest.mark.parametrize("value", [-1, 99, 10**400, 1e308, float("nan"), None, "x", [], {}, True])
@pytest.mark.parametrize("key", ["stage", "epoch", "curves"])
def test_facts_that_were_altered_are_refused(tmp_path: Path, key: str, value: object) -> None:
    interrupted(tmp_path, 3)
    resealed(tmp_path, {key: value})
    with pytest.raises(CheckpointRefused, match="does not fit the network") as caught:
        trained(tmp_path)
    assert caught.value.hint


def test_a_digit_of_the_facts_that_was_altered_is_found(tmp_path: Path) -> None:
    interrupted(tmp_path, 3)
    document = json.loads((tmp_path / FILE).read_bytes())
    document["facts"]["curves"]["loss"][0] *= 1.001
    (tmp_path / FILE).write_text(json.dumps(document))
    with pytest.raises(CheckpointRefused, match="stored state is damaged"):
        trained(tmp_path)


def resealed(folder: Path, facts: dict[str, object], **tensors: torch.Tensor | None) -> None:
    """Change a checkpoint and its digests."""
    document = json.loads((folder / FILE).read_bytes())
    path = folder / document["tensors"]
    found = {**load(path.read_bytes()), **tensors}
    content = save({name: value for name, value in found.items() if value is not None})
    path.write_bytes(content)
    document["tensors_sha256"] = hashlib.sha256(content).hexdigest()
    document["facts"].update(facts)
    document["facts_sha256"] = hashlib.sha256(json_document(document["facts"])).hexdigest()
    (folder / FILE).write_text(json.dumps(document))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("facts", "tensors"),
    [
        ({"stage": -1}, {}),
        ({"stage": 4}, {}),
        ({"epoch": -1}, {}),
        ({"epoch": 5}, {}),
        ({}, {"weights/friction": None}),
        ({}, {"best/friction": torch.zeros(3)}),
        ({}, {"stage_best/friction": torch.full((2,), torch.nan)}),
        ({}, {"weights/friction": torch.full((2,), torch.inf)}),
        ({}, {"adam/0/exp_avg": None}),
        ({}, {"adam/0/exp_avg": torch.zeros(3)}),
        ({}, {"adam/99/step": torch.zeros(())}),
        ({}, {"random/order": torch.zeros(3)}),
    ],
)
def test_a_state_that_is_not_of_this_network_is_refused(tmp_path: Path, facts, tensors) -> None:
    interrupted(tmp_path, 3)
    resealed(tmp_path, {})
    trained_on = json.loads((tmp_path / FILE).read_bytes())
    assert trained_on["facts"]["epoch"] == 2
    resealed(tmp_path, facts, **tensors)
    refused(tmp_path)


def test_rates_of_groups_that_there_are_not_are_refused() -> None:
    settings = STAGED.model_copy(update={"group_rates": {"fricton": 2.0}})
    with pytest.raises(SpecError, match="group_rates has 'fricton'") as caught:
        train(SmallProblem(), STAGES, settings)
    assert "friction" in caught.value.hint
