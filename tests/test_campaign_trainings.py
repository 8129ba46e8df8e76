"""Fits inside a run: what is told of them, and trainings that are gone on with."""

from __future__ import annotations

import io
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from test_campaign_verdict import COUNTS, run_with

from hil import plugins
from hil.campaign.afterwards import judge_and_study
from hil.campaign.judging import judge_run
from hil.campaign.trainings import FOLDER
from hil.cli.progress import ProgressLines
from hil.engine import Observers, Outcome
from hil.engine.signals import SignalWatch, StopSignal
from hil.errors import DataError, Stopped
from hil.identify.static import StaticWls
from hil.identify.training_loop.problem import Told
from hil.record.rundir import RunDirectory
from hil.spec.load import load_spec

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
            raise DataError("the checkpoint of another training")
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
    assert (run.path / FOLDER).is_dir()
    judged(run)
    assert Trained.begun_at == [0, 2]
    assert not (run.path / FOLDER).exists()


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
    (kept,) = (run.path / FOLDER).glob("*/checkpoint.json")
    kept.write_text("of another version", "utf-8")
    judged(run)
    assert Trained.begun_at == [0, 0]


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
    assert "during the fits; the recording is complete; the training is kept" in error.message
    assert error.hint == f"go on with: hil resume {run.path}"


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


def test_a_terminal_shows_the_epochs_until_the_fit_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("COLUMNS", "100")
    lines = ProgressLines()
    for event in (FITTING, FITTED):
        lines.notify(event)
    _, epoch, end = terminal.getvalue().split("\r\x1b[K")
    assert epoch.startswith("epoch 1/40  best 1")
    assert end == "fit 1 of 2: lagrangian (2 min 43 s)\n"
