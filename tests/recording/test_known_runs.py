"""Runs that are remembered: what changes is seen, and what does not costs nothing."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

import pytest

from hil.core.lock_file import hold_run
from hil.recording.run_group import FleetGroup
from hil.runs import live_runs as module
from hil.runs.live_runs import KnownRuns


def made(root: Path, name: str = "0001-a", started_as: str = "") -> Path:
    run = root / "2026-11-23" / "ur5" / name
    run.mkdir(parents=True)
    (run / "start.json").write_text(json.dumps({"started_as": started_as}))
    return run


def settle(root: Path) -> None:
    """As if nobody had touched any folder for a minute."""
    for folder in (root, *(path for path in root.rglob("*") if path.is_dir())):
        os.utime(folder, (time.time() - 60,) * 2)


@pytest.fixture
def looked_at(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Runs whose locks were looked at."""
    seen: list[Path] = []

    def is_live(run: Path) -> bool:
        seen.append(run)
        return real(run)

    real = module.is_live
    monkeypatch.setattr(module, "is_live", is_live)
    return seen


def test_ended_runs_are_not_looked_into_again(tmp_path: Path, looked_at: list[Path]) -> None:
    live, ended = (made(tmp_path, name) for name in ("0001-a", "0002-b"))
    known = KnownRuns(tmp_path)
    settle(tmp_path)
    with hold_run(live):
        assert [known.live() for _ in range(3)] == [[live]] * 3
        assert set(looked_at) == {live}
        with hold_run(ended):  # gone on with: seen at once, or when that is asked for again
            assert known.live(60) == [live]
            assert known.live() == [live, ended]
        assert known.live(60) == [live]
    assert known.live(60) == []


def test_one_that_was_killed_is_seen_when_it_is_held_again(tmp_path: Path) -> None:
    run = made(tmp_path)
    (run / ".lock").write_text("{}")  # left behind
    settle(tmp_path)
    known = KnownRuns(tmp_path)
    assert known.live() == []
    with hold_run(run):
        os.utime(run, (time.time() - 60,) * 2)
        assert known.live(60) == [run]
    assert known.live(60) == []


def test_new_runs_are_never_missed(tmp_path: Path) -> None:
    known = KnownRuns(tmp_path)
    made(tmp_path)
    settle(tmp_path)
    assert known.live() == []
    for name in ("0002-b", "0003-c"):  # folders may be changed twice at the same time stamp
        with hold_run(made(tmp_path, name)) as _:
            assert [run.name for run in known.live(60)] == [name]


def test_who_has_started_a_run_is_forgotten_with_it(tmp_path: Path) -> None:
    run = made(tmp_path, started_as="17")
    settle(tmp_path)
    known = KnownRuns(tmp_path)
    assert known.started_as("17") == [run]
    shutil.rmtree(run)
    assert known.started_as("17") == []
    made(tmp_path, started_as="18")
    assert known.started_as("17") == []
    assert known.started_as("18") == [run]


def test_a_run_without_its_first_document_is_asked_again(tmp_path: Path) -> None:
    run = made(tmp_path)
    (run / "start.json").unlink()
    settle(tmp_path)
    known = KnownRuns(tmp_path)
    assert known.started_as("17") == []
    (run / "start.json").write_text('{"started_as": "17"}')
    assert known.started_as("17") == [run]
    assert KnownRuns(tmp_path / "nowhere").live() == []


def test_a_fleet_at_work_is_no_live_run(tmp_path: Path) -> None:
    fleet = FleetGroup.create(tmp_path, "small", {"a": "hil: 1\n"}, tmp_path / "small.yaml", "")
    run = made(tmp_path)
    with fleet.held(), hold_run(run):
        assert KnownRuns(tmp_path).live() == [run]
