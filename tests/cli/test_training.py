"""`hil fit` of a network: its progress line, its checkpoints, its learning curves in the model."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.cli.progress import TrainingLine
from hil.core.errors import SpecError
from hil.networks.training import Told
from tests.support.imported_motions import recording

SMALL = {
    "network": {"hidden": [8, 8]},
    "training": {"epochs": 5, "patience": 5, "warm_up_steps": 4},
    "learning": "joint",
}


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def terminal_on(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    made = Terminal()
    monkeypatch.setattr(sys, "stderr", made)
    monkeypatch.setattr("hil.cli.progress.TrainingLine.EVERY_S", 0.0)
    monkeypatch.setenv("COLUMNS", "100")
    return made


def told(epoch: int, validation: float = 0.5) -> Told:
    return Told("loop 1: joint", epoch, 40, 2 * validation, validation, validation, 1e-3)


def shown(terminal: Terminal) -> list[str]:
    return [part for part in terminal.getvalue().split("\r\x1b[K") if part]


def test_the_line_shows_epoch_best_and_a_falling_curve(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = terminal_on(monkeypatch)
    with TrainingLine() as line:
        for epoch, validation in enumerate((4.0, 2.0, 1.0), start=1):
            line(told(epoch, validation))
    last = shown(terminal)[-1]
    assert last.startswith("epoch 3/40  best 1  █")
    assert "▁" in last
    assert "left" in last
    assert "loop 1: joint" in last
    assert terminal.getvalue().endswith("\r\x1b[K")


def test_the_line_never_wraps(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = terminal_on(monkeypatch)
    monkeypatch.setenv("COLUMNS", "30")
    with TrainingLine() as line:
        line(told(1))
    assert max(len(part) for part in shown(terminal)) < 30


def test_a_second_network_begins_a_new_curve(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = terminal_on(monkeypatch)
    with TrainingLine() as line:
        for epoch in (1, 2, 1):
            line(told(epoch, 3.0 / epoch))
    assert "  ▁  " in shown(terminal)[-1]


def test_a_pipe_gets_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with TrainingLine() as line:
        line(told(1))
    assert capsys.readouterr() == ("", "")
    assert TrainingLine.EVERY_S > 0


def test_an_estimator_that_trains_nothing_refuses_checkpoints(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="rigid-wls does not write checkpoints"):
        hil.fit(tmp_path, estimator="rigid-wls", checkpoints=tmp_path)


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    pytest.importorskip("torch", reason="torch is not installed")
    folder = tmp_path_factory.mktemp("sources")
    return [recording(folder, seed) for seed in (1, 2, 9)]


def fitted(sources: list[Path], out: Path, **more: object) -> dict[str, object]:
    report = hil.fit(sources, estimator="lagrangian", out=out, parameters=SMALL, **more)
    return {
        "folder": report.fitted.folder,
        "model": json.loads((report.fitted.folder / "model.json").read_text()),
    }


@pytest.fixture(scope="module")
def whole(sources: list[Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    return fitted(sources, tmp_path_factory.mktemp("models"))


@pytest.mark.thorough
def test_the_learning_curves_are_in_the_model_file(whole: dict[str, object]) -> None:
    curves = whole["model"]["fitted"]["curves"]  # type: ignore[index]
    assert len(curves["loss"]) == len(curves["validation"]) == 5
    assert curves["best"] == min([curves["untrained"], *curves["validation"]])


@pytest.mark.thorough
def test_ctrl_c_says_how_to_go_on_and_the_fit_ends_with_the_same_model(
    sources: list[Path],
    whole: dict[str, object],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupt(self: TrainingLine, told: Told) -> None:
        if told.epoch == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(TrainingLine, "__call__", interrupt)
    kept = tmp_path / "kept"
    settings = [f"--set={name}={json.dumps(value)}" for name, value in SMALL.items()]
    found = CliRunner().invoke(
        app,
        ["fit", *map(str, sources), "-e", "lagrangian", "--checkpoints", str(kept), *settings],
    )
    assert found.exit_code == 130
    assert f"the training is stored in {kept}; the same command resumes it" in found.stderr
    epochs: list[int] = []
    again = fitted(sources, tmp_path, checkpoints=kept, watch=lambda t: epochs.append(t.epoch))
    assert epochs == [3, 4, 5]
    assert again["folder"].name == whole["folder"].name  # type: ignore[attr-defined]


@pytest.mark.thorough
def test_in_a_pipe_the_beginning_is_told_on_stderr(
    sources: list[Path], whole: dict[str, object], tmp_path: Path
) -> None:
    settings = [f"--set={name}={json.dumps(value)}" for name, value in SMALL.items()]
    options = ["-e", "lagrangian", "-o", str(tmp_path), *settings]
    found = CliRunner().invoke(app, ["fit", *map(str, sources), *options])
    samples = whole["model"]["training"]["samples"]  # type: ignore[index]
    assert found.stderr == f"training lagrangian on {samples} samples in 3 series\n"
    assert "training" not in found.stdout
