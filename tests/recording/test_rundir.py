"""The run directory: numbers, documents, outcomes, damage, versions, checksums."""

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
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import hil.recording.run_directory as run_directory
from hil.core.errors import DataError, RecordingError
from hil.recording import RunDirectory
from hil.runs.listing import run_listings
from tests.support.recorded_rows import record_state


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
    assert error.value.hint == "choose another place with --runs DIR"


@pytest.mark.thorough
def test_processes_that_create_runs_at_once_get_different_numbers(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    with context.Pool(4) as pool:
        numbers = pool.map(create_runs, [(tmp_path, f"p{i}", 10) for i in range(4)], chunksize=1)
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
        with pytest.raises(RecordingError, match="no file of a run is rewritten"):
            write()
    assert (run.path / "spec.yaml").read_text() == "hil: 1\n"


def test_a_second_verdict_is_refused_and_leaves_the_report(tmp_path: Path) -> None:
    run = started(tmp_path)
    run.write_verdict({"passed": True})
    (run.path / "report.html").write_text("passed")
    with pytest.raises(RecordingError, match="no file of a run is rewritten"):
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
    with pytest.raises(DataError, match="hil_run is 2, known here up to 1") as caught:
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
