"""Checkpoints: a training taken up again ends with the same bits, and takes up nothing else."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from hil.core.errors import CheckpointRefused, DataError, HilError, SpecError

torch = pytest.importorskip("torch", reason="torch is not installed")

from safetensors.torch import load, save  # noqa: E402

from hil.core import json_document  # noqa: E402
from hil.networks import checkpoint  # noqa: E402
from hil.networks.checkpoint import FILE, Checkpoints  # noqa: E402
from hil.networks.training import (  # noqa: E402
    Curves,
    TrainingSettings,
    hybrid_stages,
    joint_stages,
)
from hil.networks.training_loop import train  # noqa: E402
from tests.support.training_parts import SmallProblem, Watched, equal, weights  # noqa: E402

SETTINGS = TrainingSettings(epochs=12, batch_size=32, loops=1, patience=4, warm_up_steps=3)
STAGES = hybrid_stages(SETTINGS)
"""6, 2 and 4 epochs."""


def trained(
    folder: Path | None = None, watch: Watched | None = None, **problem: float
) -> tuple[dict[str, torch.Tensor], Curves]:
    small = SmallProblem(dropout=0.2, **problem)
    curves = train(small, STAGES, SETTINGS, watch or Watched(), folder)
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
        train(small, STAGES, SETTINGS, checkpoints=folder)
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
        train(small, STAGES, SETTINGS, checkpoints=tmp_path)
    assert "another folder" in caught.value.hint


def test_other_settings_are_refused_by_name(tmp_path: Path) -> None:
    interrupted(tmp_path, 3)
    with pytest.raises(DataError, match="settings was"):
        train(
            SmallProblem(dropout=0.2), STAGES, SETTINGS.model_copy(update={"seed": 1}),
            checkpoints=tmp_path,
        )  # fmt: skip


def test_other_stages_are_refused(tmp_path: Path) -> None:
    interrupted(tmp_path, 3)
    with pytest.raises(DataError, match="stages was"):
        train(SmallProblem(dropout=0.2), joint_stages(SETTINGS), SETTINGS, checkpoints=tmp_path)


def test_a_machine_with_another_device_may_go_on(tmp_path: Path) -> None:
    interrupted(tmp_path, 3)
    there = SETTINGS.model_copy(update={"device": "cpu"})
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
    with pytest.raises(CheckpointRefused, match="written by another version of hil") as caught:
        trained(tmp_path)
    assert "anew" in caught.value.hint


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
    with pytest.raises(CheckpointRefused, match="facts are damaged"):
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
    settings = SETTINGS.model_copy(update={"group_rates": {"fricton": 2.0}})
    with pytest.raises(SpecError, match="group_rates has 'fricton'") as caught:
        train(SmallProblem(), STAGES, settings)
    assert "friction" in caught.value.hint
