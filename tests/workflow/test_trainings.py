"""Fits inside a run: what is told of them, and trainings that are gone on with."""

from __future__ import annotations

import time
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest

from hil.cli.progress import ProgressLines
from hil.core import plugins
from hil.core.errors import CheckpointRefused, DataError, Stopped
from hil.engine import Observers, Outcome
from hil.engine.signals import SignalWatch, StopSignal
from hil.estimators.static_model import StaticWls
from hil.networks.training import KeptIfPossible, Told
from hil.recording.run_directory import RunDirectory
from hil.spec.experiment import Fit
from hil.spec.load import load_spec
from hil.workflow.judging import TRAINING, FitNews, fit_or_continue, judge_and_study, judge_run
from tests.support.judging import COUNTS, run_with
from tests.support.terminal_parts import terminal_on

EPOCHS = 3


class Trained(StaticWls):
    """Trains for three epochs and keeps how far it is; another training is refused."""

    estimator = "trained"
    watch_: Any = None
    checkpoints_: Path | None = None
    interrupt_after = 0
    begun_at: ClassVar[list[int]] = []

    def fit(self, dataset: Any, robot: Any) -> Any:
        assert self.checkpoints_ is not None
        self.checkpoints_.mkdir(parents=True, exist_ok=True)
        file = self.checkpoints_ / "checkpoint.json"
        text = file.read_text("utf-8") if file.exists() else "0"
        if not text.isdigit():
            raise CheckpointRefused("of another training", folder=self.checkpoints_)
        self.begun_at.append(int(text))
        for epoch in range(int(text) + 1, EPOCHS + 1):
            self.watch_(Told("joint", epoch, EPOCHS, 1.0, 1.0, 1.0, 1e-3))
            file.write_text(str(epoch), "utf-8")
            if epoch == type(self).interrupt_after:
                raise StopSignal("stopped by SIGINT")
        return super().fit(dataset, robot)


@pytest.fixture(autouse=True)
def _estimator(monkeypatch: pytest.MonkeyPatch) -> None:
    real, mine = plugins.entry_points, EntryPoint("trained", f"{__name__}:Trained", "")
    monkeypatch.setattr(
        plugins,
        "entry_points",
        lambda *, group: [*real(group=group), *([mine] if group == "hil.estimators" else ())],
    )
    monkeypatch.setattr(Trained, "begun_at", [])


def judged(run: RunDirectory) -> list[dict[str, Any]]:
    """Judge the run; what was told."""
    told: list[Any] = []
    judge_run(run, load_spec(run.path / "spec.yaml"), COUNTS, told.append)
    return told


def interrupted(run: RunDirectory, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(Trained, "interrupt_after", 2)
        with pytest.raises(StopSignal):
            judged(run)


def test_every_fit_tells_its_epochs_and_its_end(tmp_path: Path) -> None:
    told = judged(run_with(tmp_path, "static-wls trained"))
    ends = [(e["estimator"], e["number"], e["failed"]) for e in told if e["kind"] == "fitted"]
    assert ends == [("static-wls", 1, False), ("trained", 2, False)]
    first = next(event for event in told if event["kind"] == "training")
    assert (first["estimator"], first["epoch"]["epochs"]) == ("trained", EPOCHS)
    assert told[-1]["seconds"] > 0


def test_an_interrupted_training_is_gone_on_with_and_forgotten_once_there_is_a_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_with(tmp_path, "trained")
    interrupted(run, monkeypatch)
    assert (run.path / TRAINING).is_dir()
    judged(run)
    assert Trained.begun_at == [0, 2]
    assert not (run.path / TRAINING).exists()


def test_other_parameters_are_another_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_with(tmp_path, "trained")
    interrupted(run, monkeypatch)
    file = run.path / "spec.yaml"
    text = file.read_text("utf-8").replace(
        "{estimator: trained", "{estimator: trained, weighted: false"
    )
    file.write_text(text, "utf-8")
    judged(run)
    assert Trained.begun_at == [0, 0]


def test_a_training_that_cannot_be_gone_on_with_is_begun_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_with(tmp_path, "trained")
    interrupted(run, monkeypatch)
    (kept,) = (run.path / TRAINING).glob("*/checkpoint.json")
    kept.write_text("of another version", "utf-8")
    told = judged(run)
    assert Trained.begun_at == [0, 0]
    (note,) = (event for event in told if event["kind"] == "fit_note")
    assert note["estimator"] == "trained"
    assert note["text"] == "of another training; this training starts again from the beginning"


FIT = Fit(estimator="trained")


def kept_in(run: Path) -> Path:
    """A fit of two trainings; its folder."""
    made: list[Any] = []
    fit_or_continue(run, FIT, made.append, print)  # type: ignore[arg-type]
    for name in ("one", "two"):
        (made[0] / name).mkdir(parents=True)
    folder: Path = made[0]
    return folder


def test_only_the_training_that_is_refused_is_begun_anew(tmp_path: Path) -> None:
    folder, notes = kept_in(tmp_path), list[str]()

    def make(folder: Path) -> Any:
        if (folder / "one").exists():
            raise CheckpointRefused("it is damaged", folder=folder / "one")
        return "fitted"

    assert fit_or_continue(tmp_path, FIT, make, notes.append) == "fitted"
    assert [one.name for one in folder.iterdir()] == ["two"]
    assert notes == ["it is damaged; this training starts again from the beginning"]


@pytest.mark.parametrize("where", ["", ".."])
def test_any_other_error_leaves_the_trainings_as_they_are(tmp_path: Path, where: str) -> None:
    folder, notes = kept_in(tmp_path), list[str]()

    def make(folder: Path) -> Any:
        if where:
            raise CheckpointRefused("of somebody else", folder=tmp_path)
        raise DataError("there is no space left")

    with pytest.raises(DataError):
        fit_or_continue(tmp_path, FIT, make, notes.append)
    assert {one.name for one in folder.iterdir()} == {"one", "two"}
    assert notes == []


def test_a_training_that_is_refused_twice_is_an_error(tmp_path: Path) -> None:
    def make(folder: Path) -> Any:
        raise CheckpointRefused("it cannot be removed", folder=folder)

    with pytest.raises(CheckpointRefused):
        fit_or_continue(tmp_path, FIT, make, print)


def test_a_full_disk_is_told_once_and_the_fit_goes_on(tmp_path: Path) -> None:
    told: list[Any] = []
    news = FitNews("trained", 1, 2, told.append)
    for number in (1, 2):
        news.not_kept(DataError(f"no checkpoint can be written in network-{number}"))
    assert [event["text"] for event in told] == [
        "no checkpoint can be written in network-1; the fit continues without checkpoints"
    ]


def test_the_watch_of_a_fit_hears_of_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watches: list[Any] = []
    fit = Trained.fit

    def watched(self: Trained, *of: Any) -> Any:
        watches.append(self.watch_)
        return fit(self, *of)

    monkeypatch.setattr(Trained, "fit", watched)
    judged(run_with(tmp_path, "trained"))
    assert isinstance(watches[0], KeptIfPossible)


def test_ctrl_c_during_a_fit_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, signals = run_with(tmp_path, "trained"), SignalWatch()
    signals.reason = "stopped by SIGINT"

    def pressed(self: Any, *_: Any) -> None:
        self.checkpoints_.mkdir(parents=True)
        (self.checkpoints_ / "checkpoint.json").write_text("1", "utf-8")
        signals.seen = 1
        raise StopSignal(signals.reason)

    monkeypatch.setattr(Trained, "fit", pressed)
    result = SimpleNamespace(outcome=Outcome.COMPLETED)
    recorded: Any = SimpleNamespace(result=result, directory=run, counts=COUNTS)
    experiment: Any = SimpleNamespace(spec=load_spec(run.path / "spec.yaml"))
    error = judge_and_study(experiment, recorded, signals, Observers())
    assert isinstance(error, Stopped)
    assert "during the fits; the recording is complete; " in error.message
    assert "the state of the training is kept" in error.message
    assert error.hint == f"continue with: hil resume {run.path}"


EPOCH = {"stage": "joint", "epoch": 1, "epochs": 40, "loss": 2.0, "validation": 1.0, "best": 1.0,
         "learning_rate": 1e-3}  # fmt: skip
FITTING = {"kind": "training", "estimator": "lagrangian", "number": 1, "total": 2, "epoch": EPOCH}
FITTED = {"kind": "fitted", "estimator": "lagrangian", "number": 1, "total": 2, "seconds": 163.0,
          "failed": False}  # fmt: skip


def test_a_pipe_gets_one_line_per_fit(capsys: pytest.CaptureFixture[str]) -> None:
    lines = ProgressLines()
    for event in (FITTING, FITTED, FITTED | {"number": 2, "failed": True}):
        lines.notify(event)
    assert capsys.readouterr().err.splitlines() == [
        "fit 1 of 2: lagrangian (2 min 43 s)",
        "fit 2 of 2: lagrangian failed (2 min 43 s)",
    ]


def test_a_pipe_hears_of_a_long_training_every_two_minutes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now=1000.0)
    monkeypatch.setattr(time, "monotonic", lambda: clock.now)
    lines = ProgressLines()
    for epoch in range(1, 41):
        lines.notify(FITTING | {"epoch": EPOCH | {"epoch": epoch}})
        clock.now += 10.0
    told = capsys.readouterr().err.splitlines()
    assert [line.partition("  ")[0] for line in told] == [
        f"fit 1 of 2: lagrangian: epoch {epoch}/40" for epoch in (13, 25, 37)
    ]


def test_what_a_fit_has_to_say_stays_on_the_screen(capsys: pytest.CaptureFixture[str]) -> None:
    text = "it is damaged; this training starts again from the beginning"
    ProgressLines().notify(FITTED | {"kind": "fit_note", "text": text})
    said = f"fit 1 of 2: lagrangian: {text}\n"
    assert capsys.readouterr().err == said


def test_a_second_fit_inherits_neither_curve_nor_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = terminal_on(monkeypatch)
    lines = ProgressLines()
    for epoch in (1, 2, 3):
        lines.notify(FITTING | {"epoch": EPOCH | {"epoch": epoch, "validation": 9.0 / epoch}})
    lines.notify(FITTED)
    # It goes on from a checkpoint: its first epoch is not its number one.
    lines.notify(FITTING | {"number": 2, "epoch": EPOCH | {"epoch": 30}})
    assert "epoch 30/40  best 1  ▁▁" in terminal.getvalue()
    assert "left" not in terminal.getvalue().rpartition("epoch 30")[2]


def test_a_terminal_shows_the_epochs_until_the_fit_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = terminal_on(monkeypatch)
    lines = ProgressLines()
    for event in (FITTING, FITTED):
        lines.notify(event)
    epoch, end = terminal.getvalue().split("\r\x1b[K")
    assert epoch.startswith("epoch 1/40  best 1")
    assert end == "fit 1 of 2: lagrangian (2 min 43 s)\n"
