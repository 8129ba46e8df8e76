"""Starting runs for somebody without a console: they live on by themselves, and are asked for."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest
from live_run import until
from started_parts import PROMPT, begun, written

from hil.campaign import starting
from hil.campaign.live_state import read_live
from hil.campaign.starting import Started, check_start, start_run, started_runs
from hil.campaign.steering import answer_run
from hil.errors import SpecError
from hil.record.events import read_events
from hil.record.rundir import RunDirectory

pytestmark = pytest.mark.wire


def test_a_started_run_waits_for_its_answer_and_is_known_by_its_process(tmp_path: Path) -> None:
    with begun(tmp_path, wall=False) as (started, run):
        assert started_runs(tmp_path / "runs") == [started]
        assert os.getsid(started.pid) == started.pid  # a session of its own
        until(lambda: read_live(run).get("prompt") == PROMPT)
        answer_run(run, True, who="bert")
        until(lambda: not started.alive, 30)
        asked = [e for e in read_events(run / "events.jsonl") if e["kind"] == "prompt"]
        assert [e["answered_by"] for e in asked] == ["bert"]
        assert RunDirectory.open(run).start["operator"] == "anna"
        assert RunDirectory.open(run).status == "completed"
        assert any("not judged" in line or "completed" in line for line in started.last_words)


def test_what_is_wrong_is_told_before_anything_is_started(tmp_path: Path) -> None:
    spec, station = written(tmp_path)
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(spec.read_text().replace("ur5", "ur6").replace("kind: dwell", "kind: dwel"))
    with pytest.raises(SpecError) as caught:
        start_run(wrong, tmp_path / "runs", station=station)
    assert "dwel" in caught.value.message
    assert not (tmp_path / "runs").exists()
    (experiment,) = check_start(spec, station)
    assert experiment.spec.name == "asks-first"


def test_a_schedule_is_not_started_so(tmp_path: Path) -> None:
    schedule = tmp_path / "weekly.yaml"
    schedule.write_text("hil_schedule: 1\nname: weekly\n")
    with pytest.raises(SpecError, match="runs by itself"):
        check_start(schedule, None)


def test_one_that_dies_before_it_has_a_run_directory_leaves_its_last_words(tmp_path: Path) -> None:
    spec, station = written(tmp_path)
    wall = "{name: near, point_m: [0, -0.25, 0], normal: [0, 1, 0]}"
    cramped = f"model: ur5, surroundings: {{walls: [{wall}]}}"
    station.write_text(station.read_text().replace("model: ur5", cramped))
    started = start_run(spec, tmp_path / "runs", station=station)
    try:
        until(lambda: not started.alive, 20)
    finally:
        started.cancel()
    assert started.made == []
    assert "upper arm and near" in "\n".join(started.last_words)
    assert len(started.last_words) <= starting.LAST_LINES


def test_another_process_with_its_number_is_not_it(tmp_path: Path) -> None:
    mine = Started("x", str(tmp_path), "s", "", "", os.getpid(), 0, 0.0, os.uname().nodename)
    assert not mine.alive
    assert not replace(mine, ticks=1).alive
    replace(mine, ticks=1).cancel()  # would end this test run


def test_only_so_many_are_remembered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(starting, "KEPT", 1)
    spec, _ = written(tmp_path)
    for _ in range(2):
        started = start_run(spec, tmp_path / "runs")
        started.cancel()
        until(lambda started=started: not started.alive, 20)
    third = start_run(spec, tmp_path / "runs")
    third.cancel()
    until(lambda: not third.alive, 20)
    assert [each.id for each in started_runs(tmp_path / "runs")] == [third.id]
    left = sorted(path.name for path in (tmp_path / "runs" / starting.FOLDER).iterdir())
    assert left == [f"{third.id}.json", f"{third.id}.log"]
