"""What goes on, as pages and streams are told: each run once, and nothing is paid for the ended."""

from __future__ import annotations

import json
import os
import platform
import time
from dataclasses import asdict
from pathlib import Path

import pytest

from hil.core.lock_file import hold_run
from hil.dashboard.live_runs import _SharedBar, live_headers, pending_starts
from hil.dashboard.run_page import resume_offer
from hil.dashboard.settings import Settings
from hil.runs import live_runs as known_runs
from hil.workflow.background_runs import FOLDER, Started, ticks_of


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(tmp_path / "runs", tmp_path / "registry", port=8350)


def ended(settings: Settings, name: str) -> Path:
    """A run that nobody has touched for a minute."""
    run = settings.runs / "2026-11-23" / "ur5" / name
    run.mkdir(parents=True)
    (run / "start.json").write_text("{}")
    for folder in (run, run.parent, run.parent.parent, settings.runs):
        os.utime(folder, (time.time() - 60,) * 2)
    return run


def started_here(what: Path, settings: Settings) -> Started:
    """The record of this process, as if it were about to run a spec or to go on with a run."""
    said = Started(
        id="17", runs=str(settings.runs), spec=str(what), station="", operator="anna",
        pid=os.getpid(), ticks=ticks_of(os.getpid()), time=time.time(), host=platform.node(),
    )  # fmt: skip
    (settings.runs / FOLDER).mkdir(parents=True)
    (settings.runs / FOLDER / "17.json").write_text(json.dumps(asdict(said)))
    return said


def test_a_stream_looks_into_no_run_that_has_ended(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    live, *_ = (ended(settings, f"{n:04d}-a") for n in range(1, 9))
    looked_at: list[Path] = []
    real, changed = known_runs.is_live, known_runs._changed
    monkeypatch.setattr(known_runs, "is_live", lambda run: looked_at.append(run) or real(run))
    news = _SharedBar(settings)
    with hold_run(live):
        news.read()
        asked: list[Path] = []
        monkeypatch.setattr(known_runs, "_changed", lambda at: asked.append(at) or changed(at))
        looked_at.clear()
        news._fresh_until = 0.0
        (told,) = news.read().live or []
    assert told["address"] == "/runs/2026-11-23/ur5/0001-a"
    assert looked_at == [live]
    # Folders of runs, a day and a robot, and the one run that may be live.
    assert [path.name for path in asked] == ["runs", "2026-11-23", "ur5", "0001-a"]


def test_one_that_is_gone_on_with_is_shown_once_and_at_once(settings: Settings) -> None:
    run = ended(settings, "0001-a")
    news = _SharedBar(settings)
    again = started_here(run, settings)
    assert [one["id"] for one in news.read().planned or []] == ["17"]
    assert again.made == []
    with hold_run(run):  # it plans the way back; resume-01.json comes after that
        news._fresh_until = 0.0
        now = news.read()
        assert now.planned == pending_starts(settings) == []
        assert [one["address"] for one in now.live or []] == ["/runs/2026-11-23/ur5/0001-a"]
        assert live_headers(settings) == now.live
        assert again.made == [run.resolve()]  # its page leads to that of the run, which has Stop


def made_by_it(settings: Settings, name: str) -> Path:
    run = ended(settings, name)
    (run / "start.json").write_text('{"started_as": "17"}')
    return run


def test_a_process_that_only_closes_after_its_run_plans_nothing(settings: Settings) -> None:
    started_here(settings.runs.parent / "a.yaml", settings)
    assert [one["text"] for one in pending_starts(settings)] == ["is being planned"]
    made_by_it(settings, "0001-a")
    assert pending_starts(settings) == []


def test_nor_does_one_that_only_closes_after_it_went_on_with_a_run(settings: Settings) -> None:
    run = ended(settings, "0001-a")
    started_here(run, settings)
    assert [one["text"] for one in pending_starts(settings)] == ["is about to go on"]
    assert resume_offer(run, settings)["begun"] == "/start/17"
    (run / "resume-01.json").write_text('{"started_as": "17"}')
    assert pending_starts(settings) == []
    assert resume_offer(run, settings)["begun"] == ""


def test_a_series_between_two_runs_can_be_cancelled(settings: Settings, tmp_path: Path) -> None:
    spec, *experiments = (tmp_path / name for name in ("two.yaml", "a.yaml", "b.yaml"))
    for each in experiments:
        each.touch()
    spec.write_text("hil_series: 1\nname: two\nseries: [{spec: a.yaml}, {spec: b.yaml}]\n")
    started_here(spec, settings)
    first = made_by_it(settings, "0001-a")
    assert pending_starts(settings) == []  # stopped: it does not go on
    (first / "verdict.json").write_text("{}")
    assert [one["text"] for one in pending_starts(settings)] == ["is about to begin its next run"]
    last = made_by_it(settings, "0002-b")
    (last / "verdict.json").write_text("{}")
    assert pending_starts(settings) == []
