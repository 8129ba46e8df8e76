"""The event log and the provenance of a run."""

from __future__ import annotations

import json
import subprocess
import sys
import time
import uuid
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

import hil.recording.provenance as provenance
from hil.core.errors import RecordingError
from hil.recording import EventLog, collect_provenance, read_events
from tests.support.git_parts import repository_with
from tests.support.in_time import InTime, measured_again


def test_every_event_is_a_line_in_the_order_of_the_calls(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    with EventLog(path) as log:
        for number in range(100):
            log.append("checkpoint", step=number)
    assert [json.loads(line)["step"] for line in path.read_text().splitlines()] == list(range(100))
    assert [event["step"] for event in read_events(path)] == list(range(100))


def test_an_event_has_its_time_in_utc_and_its_kind(tmp_path: Path) -> None:
    with EventLog(tmp_path / "events.jsonl") as log:
        log.append("trip", reason="tracking error", joint=2)
    (event,) = read_events(tmp_path / "events.jsonl")
    assert (event["kind"], event["reason"], event["joint"]) == ("trip", "tracking error", 2)
    assert event["t"] == pytest.approx(time.time(), abs=5)
    assert datetime.fromisoformat(event["time"]).utcoffset() == timedelta(0)


def test_values_json_has_no_word_for_become_strict_json(tmp_path: Path) -> None:
    with EventLog(tmp_path / "events.jsonl") as log:
        log.append("x", nan=np.nan, array=np.arange(3), number=np.float32(0.5), path=Path("a"))
    line = (tmp_path / "events.jsonl").read_text()
    event = json.loads(line, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert (event["nan"], event["array"], event["number"], event["path"]) == (
        None,
        [0, 1, 2],
        0.5,
        "a",
    )


def test_a_log_is_continued_after_a_crash_within_a_line(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    path.write_text('{"kind": "state", "to": "running"}\n{"kind": "che')
    with EventLog(path) as log:
        log.append("resumed")
    assert [event["kind"] for event in read_events(path)] == ["state", "resumed"]


def test_an_event_survives_a_kill_right_after_a_pause_in_the_calls(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    child = (
        "import os, sys, time\nfrom pathlib import Path\nfrom hil.recording import EventLog\n"
        "EventLog(Path(sys.argv[1])).append('trip')\ntime.sleep(0.2)\nos.kill(os.getpid(), 9)\n"
    )
    subprocess.run([sys.executable, "-c", child, str(path)], check=False)
    assert [event["kind"] for event in read_events(path)] == ["trip"]


@measured_again
def test_append_does_not_wait_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = EventLog(tmp_path / "events.jsonl")
    monkeypatch.setattr("os.fsync", lambda descriptor: time.sleep(0.1))
    own = InTime()
    for _ in range(3):
        log.append("state")
    took = own.taken()
    log.close()
    assert len(read_events(log.path)) == 3
    took.require(0.05)


def test_a_disk_error_surfaces_in_the_next_append(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    log = EventLog(tmp_path / "events.jsonl")
    monkeypatch.setattr("os.fsync", full)
    log.append("state")
    with pytest.raises(RecordingError, match="No space left"):
        log.close()
    with pytest.raises(RecordingError, match="No space left"):
        log.append("state")


def test_events_of_a_run_without_any_are_none(tmp_path: Path) -> None:
    assert read_events(tmp_path / "events.jsonl") == []


def test_the_revision_of_hil_and_that_of_the_spec_are_recorded_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, specs = tmp_path / "hil", tmp_path / "specs"
    source.mkdir()
    specs.mkdir()
    commits = repository_with(source, "__init__.py"), repository_with(specs, "spec.yaml")
    monkeypatch.setattr(provenance, "_PACKAGE", source)
    document = collect_provenance(specs)
    assert (document["git"]["sha"], document["spec_git"]["sha"]) == commits


def test_the_repository_around_an_installed_hil_is_not_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    repository_with(tmp_path, "thesis.tex")
    installed = tmp_path / "venv" / "hil"
    installed.mkdir(parents=True)
    (installed / "__init__.py").touch()
    monkeypatch.setattr(provenance, "_PACKAGE", installed)
    monkeypatch.chdir(tmp_path)
    assert collect_provenance(tmp_path)["git"] is None
    assert collect_provenance(tmp_path)["spec_git"] is not None


def test_provenance_says_who_what_where_and_with_which_packages(tmp_path: Path) -> None:
    document = collect_provenance(tmp_path)
    assert document["spec_git"] is None
    assert uuid.UUID(document["uid"]).version == 4
    assert document["uid"] != collect_provenance(tmp_path)["uid"]
    age = datetime.now(UTC) - datetime.fromisoformat(document["started"])
    assert age < timedelta(seconds=30)
    assert document["packages"]["numpy"] == np.__version__
    assert document["packages"]["hil"]
    assert document["python"] == sys.version.split()[0]
    assert all(document[key] for key in ("operator", "host", "platform", "pid"))
