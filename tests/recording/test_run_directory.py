"""The run directory and the folder of a group of runs: written, damaged, read again."""

from __future__ import annotations

import errno
import hashlib
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

import hil.recording.run_directory as run_directory
from hil import api
from hil.cli.app import app
from hil.core.errors import (
    DataError,
    FitError,
    HilError,
    InterlockTripped,
    RecordingError,
    Rejected,
    Stopped,
)
from hil.core.yaml import parse
from hil.engine.preflight import CheckResult
from hil.importers.sources import gravity_of, load_source, serial_of
from hil.recording import Attachment, McapWriter, RunDirectory, read_events
from hil.recording.run_group import FleetGroup, Member, SeriesGroup, worst_error
from hil.report import render_report, summary_lines
from hil.report.run_facts import read_facts
from hil.robot.state import state_topic
from hil.runs.listing import run_listings
from hil.spec import load_spec, spec_hash
from hil.workflow.judging import judge_run
from hil.workflow.resuming import open_unfinished
from tests.support.fuzzing import ANYTHING, damaged, examples, quick_folder
from tests.support.paths import ROOT
from tests.support.recorded_rows import record_state
from tests.support.report_runs import dwell_plan, rows_of_plan, write_run

# The run directory: numbers, documents, outcomes, damage, versions, checksums


def started(root: Path, name: str = "fourier") -> RunDirectory:
    run = RunDirectory.create(root, "ur5", name)
    run.write_start({"uid": "u-1", "host": "lab"})
    return run


def create_runs(arguments: tuple[Path, str, int]) -> list[int]:
    root, name, count = arguments
    return [RunDirectory.create(root, "ur5", name).number for _ in range(count)]


def test_runs_are_numbered_below_day_and_robot(tmp_path: Path) -> None:
    first = RunDirectory.create(tmp_path, "UR5", "Dwell 650, 3 kg")
    second = RunDirectory.create(tmp_path, "ur10e", "fourier")
    assert first.path.name == "0001-dwell-650-3-kg"
    assert first.path.parent.name == "ur5"
    assert first.path.parents[2] == tmp_path
    assert second.path.name == "0002-fourier"


def test_name_cannot_leave_the_runs_folder(tmp_path: Path) -> None:
    run = RunDirectory.create(tmp_path / "runs", "../..", "../../../etc/passwd")
    assert run.path.resolve().is_relative_to((tmp_path / "runs").resolve())


def test_a_disk_without_room_for_the_reserve_is_told_and_no_run_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def takes_a_part(descriptor: int, data: bytes) -> int:  # as a nearly full disk does
        return real(descriptor, data[: len(data) // 2])

    real = os.write
    monkeypatch.setattr(os, "write", takes_a_part)
    with pytest.raises(RecordingError, match="No space left on device") as caught:
        RunDirectory.create(tmp_path, "ur5", "fourier")
    assert "free the disk" in str(caught.value.hint)
    assert [run.number for run in run_listings(tmp_path)] == []


def test_a_place_where_no_run_can_be_is_not_blamed_on_a_full_disk(tmp_path: Path) -> None:
    (tmp_path / "runs").write_text("")
    with pytest.raises(RecordingError, match="cannot create a run directory") as error:
        RunDirectory.create(tmp_path / "runs", "ur5", "demo")
    assert error.value.hint == "choose a different folder with --runs DIR"


@pytest.mark.thorough
def test_processes_that_create_runs_at_once_get_different_numbers(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    with context.Pool(2) as pool:
        numbers = pool.map(create_runs, [(tmp_path, f"p{i}", 20) for i in range(2)], chunksize=1)
    taken = [number for of_process in numbers for number in of_process]
    assert len(set(taken)) == 40
    assert sorted(run.number for run in run_listings(tmp_path)) == sorted(taken)


def test_a_number_that_another_process_has_just_taken_is_not_given_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert RunDirectory.create(tmp_path, "ur5", "theirs").number == 1
    look, looks = run_directory.run_folders, [0]

    def stale_at_first(root: Path) -> list[Path]:
        looks[0] += 1
        return [] if looks[0] == 1 else look(root)

    monkeypatch.setattr(run_directory, "run_folders", stale_at_first)
    assert RunDirectory.create(tmp_path, "ur5", "ours").number == 2


def hidden(root: Path) -> list[str]:
    """Return the names of the claims and drafts below a runs folder."""
    return sorted(path.name for path in [*root.glob(".*"), *root.glob("*/*/.*")])


def test_drafts_left_by_crashes_are_removed_by_the_next_run(tmp_path: Path) -> None:
    for number, robot in (("0001", "ur5"), ("0002", "ur10e")):
        draft = tmp_path / "2026-11-20" / robot / f".draft-{number}"
        (draft / "recording").mkdir(parents=True)
        (draft / "spec.yaml").write_text("hil: 1")
        (tmp_path / f".claim-{number}").write_text("{}")
    run = RunDirectory.create(tmp_path, "ur5", "fourier")
    assert run.number == 1
    assert hidden(tmp_path) == []
    assert not (run.path / "spec.yaml").exists()


def test_a_claim_of_a_live_process_keeps_its_number_and_its_files(tmp_path: Path) -> None:
    folder = tmp_path / "2026-11-20" / "ur5"
    folder.mkdir(parents=True)
    with run_directory.claimed(tmp_path, folder) as claim:
        (claim.draft / "spec.yaml").write_text("hil: 1")
        assert RunDirectory.create(tmp_path, "ur5", "other").number == 2
        assert (claim.draft / "spec.yaml").exists()
        assert [run.number for run in run_listings(tmp_path)] == [2]


def test_a_run_is_renamed_within_one_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder of the robot may be a link to another file system."""
    real = os.rename

    def on_one_file_system(source: Path, target: Path) -> None:
        if Path(source).parent != Path(target).parent:
            raise OSError(errno.EXDEV, os.strerror(errno.EXDEV))
        real(source, target)

    monkeypatch.setattr(os, "rename", on_one_file_system)
    assert started(tmp_path).start["uid"] == "u-1"


def test_a_run_has_its_name_only_when_it_has_its_documents(tmp_path: Path) -> None:
    def begin(draft: RunDirectory) -> None:
        draft.write_start({"uid": "u-1"})
        assert run_listings(tmp_path) == []

    run = RunDirectory.create(tmp_path, "ur5", "fourier", begin)
    assert run.start["uid"] == "u-1"
    assert [listing.status for listing in run_listings(tmp_path)] == ["interrupted"]
    assert sorted(path.name for path in run.path.iterdir()) == [
        ".reserve",
        "recording",
        "start.json",
    ]


KILLED = """
import os, signal, sys
from pathlib import Path
from hil.recording import RunDirectory
def begin(draft):
    draft.write_text("spec.yaml", "hil: 1")
    os.kill(os.getpid(), signal.SIGKILL)
RunDirectory.create(Path(sys.argv[1]), "ur5", "killed", begin)
"""


def test_a_process_killed_before_its_run_has_begun_leaves_nothing_that_is_listed(
    tmp_path: Path,
) -> None:
    killed = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert hidden(tmp_path) == [".claim-0001", ".draft-0001"]
    assert run_listings(tmp_path) == []
    assert started(tmp_path).number == 1
    assert hidden(tmp_path) == []


@pytest.mark.thorough
def test_a_run_that_begins_while_another_process_cleans_keeps_its_draft(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    prepared, cleaned = threading.Event(), threading.Event()
    remove = shutil.rmtree

    def begin(draft: RunDirectory) -> None:
        draft.write_text("spec.yaml", "hil: 1")
        prepared.set()
        assert cleaned.wait(60)
        draft.write_start({"uid": "u-2"})

    def interrupted(path: Path, **options: Any) -> None:
        monkeypatch.setattr(shutil, "rmtree", remove)
        remove(path, **options)
        threads.append(pool.submit(RunDirectory.create, tmp_path, "ur5", "meanwhile", begin))
        assert prepared.wait(60)

    threads: list[Future[RunDirectory]] = []
    with ThreadPoolExecutor(1) as pool:
        monkeypatch.setattr(shutil, "rmtree", interrupted)
        try:
            numbers = {started(tmp_path).number, started(tmp_path).number}
        finally:
            cleaned.set()
        meanwhile = threads[0].result()
    assert meanwhile.start["uid"] == "u-2"
    assert (meanwhile.path / "spec.yaml").read_text() == "hil: 1"
    assert len(numbers | {meanwhile.number}) == 3
    assert hidden(tmp_path) == []


def test_a_draft_of_a_process_that_died_meanwhile_is_not_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = run_directory.hold

    def after_a_crash(path: Path) -> Any:
        monkeypatch.setattr(run_directory, "hold", real)
        subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
        return real(path)

    monkeypatch.setattr(run_directory, "hold", after_a_crash)
    run = started(tmp_path)
    assert not (run.path / "spec.yaml").exists()
    assert hidden(tmp_path) == []


def test_documents_that_cannot_be_written_leave_no_run(tmp_path: Path) -> None:
    def begin(draft: RunDirectory) -> None:
        draft.write_text("spec.yaml", "hil: 1")
        raise RecordingError("no space left")

    with pytest.raises(RecordingError, match="no space left"):
        RunDirectory.create(tmp_path, "ur5", "fourier", begin)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
    assert hidden(tmp_path) == []


def test_documents_come_back_and_are_never_rewritten(tmp_path: Path) -> None:
    run = started(tmp_path)
    run.write_text("spec.yaml", "hil: 1\n")
    run.write_json("plan.json", {"waypoints": 650})
    assert json.loads((run.path / "plan.json").read_text()) == {"waypoints": 650}
    for write in (
        lambda: run.write_text("spec.yaml", "hil: 2\n"),
        lambda: run.write_json("plan.json", {}),
        lambda: run.write_start({}),
    ):
        with pytest.raises(RecordingError, match="files of a run are never overwritten"):
            write()
    assert (run.path / "spec.yaml").read_text() == "hil: 1\n"


def test_a_second_verdict_is_refused_and_leaves_the_report(tmp_path: Path) -> None:
    run = started(tmp_path)
    run.write_verdict({"passed": True})
    (run.path / "report.html").write_text("passed")
    with pytest.raises(RecordingError, match="files of a run are never overwritten"):
        run.write_verdict({"passed": False})
    assert (run.path / "report.html").read_text() == "passed"


def test_a_write_that_fails_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = started(tmp_path)
    before = set(run.path.iterdir())

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(RecordingError, match="No space left on device"):
        run.write_json("plan.json", {"waypoints": 650})
    assert set(run.path.iterdir()) == before


@pytest.mark.parametrize("outcome", ["completed", "stopped", "tripped", "failed"])
def test_outcome_is_the_status(tmp_path: Path, outcome: Any) -> None:
    run = started(tmp_path)
    assert RunDirectory.open(run.path).status == "interrupted"
    run.write_stop(outcome, "because", {"gaps": 3})
    stop = RunDirectory.open(run.path).stop
    assert stop is not None
    assert (RunDirectory.open(run.path).status, stop["reason"], stop["gaps"]) == (
        outcome,
        "because",
        3,
    )


def test_stop_document_has_the_checksum_of_every_file(tmp_path: Path) -> None:
    run = started(tmp_path)
    record_state(run.part_path(0), 10)
    run.write_stop("completed", "all steps done")
    checksums = (run.stop or {})["sha256"]
    assert set(checksums) == {"start.json", "recording/00.mcap"}
    content = (run.path / "recording/00.mcap").read_bytes()
    assert checksums["recording/00.mcap"] == hashlib.sha256(content).hexdigest()
    assert run.verify() == []
    (run.path / "recording/00.mcap").write_bytes(content[:-1])
    assert run.verify() == ["recording/00.mcap has changed since the run ended"]
    (run.path / "recording/00.mcap").unlink()
    assert run.verify() == ["recording/00.mcap is missing"]


def test_every_attempt_gets_a_recording_of_its_own(tmp_path: Path) -> None:
    run = started(tmp_path)
    record_state(run.part_path(0), 4)
    assert run.next_attempt() == 1
    (run.path / "recording" / "01.mcap.partial").write_bytes(b"")
    (run.path / "recording" / "notes.txt").write_text("not a recording")
    assert [path.name for path in run.recordings] == ["00.mcap", "01.mcap.partial"]
    assert run.next_attempt() == 2


def test_run_of_a_newer_hil_is_refused_with_the_remedy(tmp_path: Path) -> None:
    run = RunDirectory.create(tmp_path, "ur5", "fourier")
    run.write_json("start.json", {"hil_run": 2})
    with pytest.raises(DataError, match="hil_run is 2, the highest known version is 1") as caught:
        RunDirectory.open(run.path)
    assert "update hil" in caught.value.hint


def test_what_is_no_run_directory_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no start\.json"):
        RunDirectory.open(tmp_path)


NOT_STARTS = [b"", b"{", b"[]", b"null", b'{"uid": 1}', b'{"hil_run": "x"}', b"\xff\xfe"]


@pytest.mark.parametrize(
    "content", [*NOT_STARTS, b"[" * 100_000], ids=lambda content: repr(content[:12])
)
def test_damaged_start_document_is_refused_and_listed_as_damaged(
    tmp_path: Path, content: bytes
) -> None:
    run = RunDirectory.create(tmp_path, "ur5", "fourier")
    (run.path / "start.json").write_bytes(content)
    with pytest.raises(DataError, match=r"start\.json"):
        RunDirectory.open(run.path)
    (listing,) = run_listings(tmp_path)
    assert listing.status == "damaged"
    assert "start.json" in listing.problem


def test_list_shows_every_run_with_its_status_whatever_lies_beside_it(tmp_path: Path) -> None:
    done = started(tmp_path, "done")
    done.write_stop("tripped", "tracking error on joint 2")
    started(tmp_path, "cut")
    odd = started(tmp_path, "odd")
    (odd.path / "stop.json").write_text('{"outcome": "great"}')
    RunDirectory.create(tmp_path, "ur5", "empty")
    renamed = started(tmp_path, "renamed")
    renamed.path.rename(renamed.path.with_name("the good one"))
    (done.path.parent / "0099-file").write_text("not a directory")
    assert [(run.number, run.status) for run in run_listings(tmp_path)] == [
        (0, "interrupted"),
        (1, "tripped"),
        (2, "interrupted"),
        (3, "damaged"),
        (4, "damaged"),
    ]
    assert run_listings(tmp_path / "nowhere") == []


# Run directories with damaged files: every view of them is a view or a clear error


EVENTS = "events.jsonl"
RUN = "2026-11-21/ur5/0001-fuzz"


@cache
def whole_run() -> Mapping[str, bytes]:
    """The files of a small run that was resumed once, fitted and judged, by their names."""
    plan = dwell_plan(poses=14)
    with quick_folder() as root:
        run = write_run(root, plan, accept="{nrmse: {max: 0.5}}")
        run.write_text("station.yaml", (ROOT / "experiments/stations/mock.yaml").read_text("utf-8"))
        check = CheckResult("disk", True, "room for 100 hours", 1e12, 1e9).to_dict()
        run.write_json("preflight.json", {"passed": True, "checks": [check]})
        spec = load_spec(run.path / "spec.yaml")
        judge_run(run, spec, {"samples": 100, "missing": 0})
        start = run.start | {"spec_hash": spec_hash(spec)}
        (run.path / "start.json").write_bytes(as_json(start))
        run.write_resume(1, {"resumed": "2026-11-21T00:00:00+00:00", "steps": [1, 2]})
        with run.event_log() as log:
            log.append("resumed", attempt=1)
            log.append("dwell", step=3, settled=False)
            log.append("prompt", text="Mount it", answered_by="operator")
        run.write_stop("completed", "", {"samples": 10, "steps_done": len(plan)}, attempt=1)
        (run.path / "recording" / "01.mcap.partial").write_bytes(torn_recording(run))
        files = (path for path in run.path.rglob("*") if path.is_file())
        return {path.relative_to(run.path).as_posix(): path.read_bytes() for path in files}


def torn_recording(run: RunDirectory) -> bytes:
    content = (run.path / "recording" / "00.mcap").read_bytes()
    return content[: len(content) * 3 // 4]


DOCUMENTS = (
    "start.json",
    "stop.json",
    "stop-01.json",
    "resume-01.json",
    "plan.json",
    "preflight.json",
    "verdict.json",
    "evaluation.json",
    "model.json",
)


def quick_run(folder: Path, changed: Mapping[str, bytes | None]) -> Path:
    """The run with some files changed, or left out where None."""
    run = folder / RUN
    for name, content in {**whole_run(), **changed}.items():
        path = run / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if content is not None:
            path.write_bytes(content)
    return run


def names_of(document: str) -> str:
    return next(name for name in whole_run() if name.endswith(document))


def as_json(document: Any) -> bytes:
    return json.dumps(document).encode()


def views(root: Path, run: Path) -> Iterator[Callable[[], Any]]:
    """Everything that looks at a run without writing anything."""
    yield lambda: api.describe_run(run)
    yield lambda: summary_lines(run)
    yield lambda: read_facts(run)
    yield lambda: load_source(run)
    yield lambda: (serial_of(run), gravity_of(run))
    yield lambda: RunDirectory.open(run).verify()
    yield lambda: open_unfinished(run)


def assert_viewable(root: Path, run: Path) -> None:
    """The catalogue lists the run whatever it holds; all other views may refuse it."""
    assert [entry["run"] for entry in api.list_runs(root)] == [str(run)]
    for view in views(root, run):
        assert refusal_of(view) != ""


def refusal_of(call: Callable[[], Any]) -> str | None:
    """What a HilError says; None where there is none."""
    try:
        call()
    except HilError as refusal:
        return str(refusal).strip()
    return None


def test_the_run_that_is_damaged_here_was_whole() -> None:
    with quick_folder() as root:
        run = quick_run(root, {})
        for view in views(root, run):
            refusal = refusal_of(view)
            assert refusal is None or "is complete (28/28 dwells, 6/6 references)" in refusal
        assert api.list_runs(root)[0]["status"] == "completed"


@pytest.mark.thorough
@pytest.mark.parametrize("name", DOCUMENTS)
@examples(4)
@given(data=st.data())
def test_damaged_document(name: str, data: st.DataObject) -> None:
    file = names_of(name)
    document = data.draw(damaged([json.loads(whole_run()[file])]))
    with quick_folder() as root:
        assert_viewable(root, quick_run(root, {file: as_json(document)}))


@pytest.mark.parametrize("robot", [None, [], {"identity": None}])
def test_a_run_whose_robot_is_not_told_is_not_resumed(robot: Any) -> None:
    file = names_of("start.json")
    with quick_folder() as root:
        run = quick_run(root, {file: as_json(json.loads(whole_run()[file]) | {"robot": robot})})
        with pytest.raises(DataError, match="does not state the robot of the run"):
            open_unfinished(run)


@examples(12)
@given(data=st.data())
def test_several_documents_damaged_or_missing(data: st.DataObject) -> None:
    changed: dict[str, bytes | None] = {}
    for name in data.draw(st.sets(st.sampled_from(DOCUMENTS), min_size=1, max_size=4)):
        file = names_of(name)
        whole = json.loads(whole_run()[file])
        contents = st.none() | st.binary(max_size=40) | (ANYTHING | damaged([whole])).map(as_json)
        changed[file] = data.draw(contents)
    with quick_folder() as root:
        run = quick_run(root, changed)
        if changed.get("start.json", b"") is None:
            run.joinpath("start.json").unlink(missing_ok=True)
            assert api.list_runs(root)
            return
        assert_viewable(root, run)


@pytest.mark.thorough
@examples(5)
@given(data=st.data())
def test_damaged_event_log(data: st.DataObject) -> None:
    lines = whole_run()[EVENTS].splitlines()
    events = [json.loads(line) for line in lines]
    spoilt = st.binary(max_size=30) | (ANYTHING | damaged(events)).map(as_json)
    drawn = data.draw(st.lists(st.sampled_from(lines) | spoilt, max_size=8))
    with quick_folder() as root:
        run = quick_run(root, {EVENTS: b"\n".join(drawn)})
        assert all(isinstance(event, dict) for event in read_events(run / EVENTS))
        assert_viewable(root, run)


@pytest.mark.thorough
@examples(4)
@given(data=st.data())
def test_damaged_spec_or_station_of_a_run(data: st.DataObject) -> None:
    import yaml

    name = data.draw(st.sampled_from(["spec.yaml", "station.yaml"]))
    document = data.draw(damaged([parse(whole_run()[name], "f").data]))
    text = yaml.safe_dump(document, allow_unicode=True).encode("utf-8", "surrogatepass")
    with quick_folder() as root:
        assert_viewable(root, quick_run(root, {name: text}))


@pytest.mark.thorough
@examples(4)
@given(data=st.data())
def test_damaged_recording(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(["recording/00.mcap", "recording/01.mcap.partial"]))
    content = bytearray(whole_run()[name])
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    with quick_folder() as root:
        assert_viewable(root, quick_run(root, {name: bytes(content)}))


@cache
def explained() -> Mapping[str, dict[str, Any]]:
    """What a recording carries: the documents of a run, and what an import says."""
    names = ("start.json", "plan.json")
    documents = {name: json.loads(whole_run()[name]) for name in names}
    robot = {
        "model": "ur5",
        "joint_names": ["a", "b", "c", "d", "e", "f"],
        "effort_kind": "current",
        "drive_gains": [10.0] * 6,
        "gravity_m_s2": [0.0, 0.0, -9.81],
        "serial": "S-1",
    }
    payload = {"mass_kg": 1.0, "com_m": [0.0, 0.0, 0.1], "inertia_kgm2": [0.0] * 6}
    return documents | {"robot": robot, "payload": payload, "payload of window 1": payload}


def as_texts(record: Any) -> dict[str, str]:
    """A metadata record: text is itself, everything else its JSON."""
    items = record.items() if isinstance(record, dict) else [("model", record)]
    return {k: v if isinstance(v, str) else json.dumps(v) for k, v in items}


@examples(20)
@given(data=st.data())
def test_recording_with_damaged_explanations(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(explained())))
    told = dict(explained())
    told[name] = data.draw(damaged([told[name]]) | ANYTHING)
    of_run = name.endswith(".json")
    attachments = [
        Attachment(key, "application/json", as_json(value))
        for key, value in told.items()
        if key.endswith(".json") and of_run
    ]
    metadata = {k: as_texts(v) for k, v in told.items() if not k.endswith(".json")}
    rows = rows_of_plan(dwell_plan(poses=1))
    with quick_folder() as folder:
        path = folder / "a.mcap"
        topic = state_topic(6, 125.0, clock="virtual", effort_unit="A")
        with McapWriter(path, [topic], attachments=attachments, metadata=metadata) as writer:
            writer.write(topic.name, rows)
        for view in (load_source, gravity_of, serial_of):
            assert refusal_of(lambda view=view: view(path)) != ""  # type: ignore[misc]


@examples(3)
@given(data=st.data())
def test_report_of_a_damaged_run(data: st.DataObject) -> None:
    changed = {}
    for name in data.draw(st.sets(st.sampled_from(DOCUMENTS), min_size=1, max_size=3)):
        file = names_of(name)
        changed[file] = as_json(data.draw(damaged([json.loads(whole_run()[file])])))
    with quick_folder() as root:
        run = quick_run(root, changed)
        assert refusal_of(lambda: render_report(run)) != ""


@pytest.mark.thorough
@examples(3)
@given(data=st.data())
def test_command_line_on_a_damaged_run(data: st.DataObject) -> None:
    file = names_of(data.draw(st.sampled_from(DOCUMENTS)))
    document = data.draw(damaged([json.loads(whole_run()[file])]))
    with quick_folder() as root:
        run = quick_run(root, {file: as_json(document)})
        for command in (["runs", "--runs", str(root)], ["show", str(run)]):
            for flags in ([], ["--json"]):
                done = CliRunner().invoke(app, [*command, *flags])
                error = done.exception
                assert error is None or isinstance(error, HilError | SystemExit), error
                if flags and error is None:
                    json.loads(done.output)


def test_documents_of_absurd_depth_and_size_are_refused() -> None:
    for content in (b"[" * 10**6, b'{"a":' * 10**5, b"9" * 10**6, b'{"hil_run": 1e999}'):
        with quick_folder() as root:
            run = quick_run(root, {"start.json": content})
            assert api.list_runs(root)[0]["status"] == "damaged"
            with pytest.raises(DataError):
                api.describe_run(run)


def test_an_event_log_of_astronomic_length_is_no_crash() -> None:
    document = json.loads(whole_run()["stop-01.json"]) | {"events_bytes": 2**63}
    with quick_folder() as root:
        assert_viewable(root, quick_run(root, {"stop-01.json": as_json(document)}))


def test_a_part_with_another_record_is_refused_and_named() -> None:
    name = "recording/01.mcap.partial"
    other = whole_run()[name].replace(b"int32 segment\n", b"int32 segmunt\n")
    assert other != whole_run()[name]
    with quick_folder() as root:
        run = quick_run(root, {name: other})
        refusal = refusal_of(lambda: open_unfinished(run)) or ""
        assert "01.mcap.partial: its /robot/state is not the base robot record" in refusal
        assert_viewable(root, run)


def test_a_part_of_an_arm_with_fewer_joints_is_refused_and_named() -> None:
    with quick_folder() as root:
        run = quick_run(root, {})
        topic = state_topic(2, 125.0, clock="host", effort_unit="A")
        with McapWriter(run / "recording" / "00.001.mcap", [topic], joint_names=["a", "b"]) as part:
            part.write(topic.name, np.zeros(3, topic.dtype))
        refusal = refusal_of(lambda: open_unfinished(run)) or ""
        assert "00.001.mcap contains 2 joints, but the part before it contains 6" in refusal
        assert_viewable(root, run)


# The folder of a series or a fleet: what its document says, and which error is the worst


DONE = {"outcome": "completed", "verdict": "passed"}


def test_runs_and_reports_are_named_from_the_folder_of_the_group(tmp_path: Path) -> None:
    group = SeriesGroup.create(tmp_path / "runs", "both", tmp_path / "both.yaml")
    run = tmp_path / "runs" / "2026-11-21" / "ur5" / "0001-a"
    group.write([Member("a", "ur5", {"run": str(run), "report": str(run / "report.html")})])
    (entry,) = json.loads((group.path / "series.json").read_text("utf-8"))["runs"]
    assert entry["run"] == "../../../2026-11-21/ur5/0001-a"
    moved = tmp_path / "elsewhere"
    (tmp_path / "runs").rename(moved)
    there = SeriesGroup.open(moved / group.path.relative_to(tmp_path / "runs"))
    assert there.members()[0].run == moved / "2026-11-21" / "ur5" / "0001-a"


def test_the_robots_of_a_fleet_are_listed_from_the_start(tmp_path: Path) -> None:
    specs = {"a": "hil: 1\n", "b": "hil: 1\n"}
    fleet = FleetGroup.create(tmp_path, "small", specs, tmp_path / "small.yaml", "")
    members = FleetGroup.open(fleet.path).members()
    assert [(one.experiment, one.robot, one.run) for one in members] == [
        ("small", "a", None),
        ("small", "b", None),
    ]
    assert FleetGroup.folders(tmp_path) == [fleet.path]
    assert not SeriesGroup.is_at(fleet.path)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [("Stopped", Stopped), ("OfAPlugin", HilError), ("Path", HilError), (3, HilError)],
)
def test_an_error_has_its_class_again(kind: object, expected: type[HilError]) -> None:
    entry = {"experiment": "a", "robot": "ur5", "error": {"kind": kind, "message": "why"}}
    error = Member.from_dict(entry).error
    assert type(error) is expected
    assert (error.message, error.hint) == ("why", "")


def test_the_worst_error_is_a_stop_then_a_run_that_ended_early_then_a_missing_model() -> None:
    errors: list[tuple[HilError, dict[str, str]]] = [
        (Rejected("missed"), DONE),
        (FitError("few"), DONE),
        (InterlockTripped("hot"), {"outcome": "tripped"}),
        (Stopped("by hand"), DONE),
    ]
    members = [Member("a", "ur5", dict(report), error) for error, report in errors]
    for count, (error, _) in enumerate(errors, start=1):
        assert worst_error(members[:count]) is error
    assert worst_error([Member("a", "ur5", dict(DONE))]) is None


def test_a_document_of_a_newer_version_is_refused(tmp_path: Path) -> None:
    group = SeriesGroup.create(tmp_path, "both", tmp_path / "both.yaml")
    (group.path / "series.json").write_text('{"hil_series_run": 2, "runs": []}', "utf-8")
    with pytest.raises(DataError, match="newer hil"):
        SeriesGroup.open(group.path)
