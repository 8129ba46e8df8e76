"""The view of run directories: true to them whatever happens to it."""

from __future__ import annotations

import json
import os
import random
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import DataError
from hil.core.lock_file import hold_run
from hil.recording.run_directory import run_folders
from hil.runs import catalogue
from hil.runs.catalogue import FILE, find_runs
from hil.runs.listing import describe_run, facts_of, list_runs
from tests.support.catalogue_runs import close_folders, settle, write_run


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    root = tmp_path / "runs"
    write_run(root, 1, fits={"rigid-wls": 0.2, "static-wls": 0.05})
    write_run(root, 2, robot="ur10", outcome="tripped")
    write_run(root, 3, day="2026-11-21", outcome=None)
    return root


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the runs whose documents were read."""
    names: list[str] = []

    def counting(path: Path) -> dict[str, Any]:
        names.append(path.name)
        return facts_of(path)

    monkeypatch.setattr(catalogue, "facts_of", counting)
    return names


def truth(root: Path) -> list[dict[str, Any]]:
    return sorted(map(facts_of, run_folders(root)), key=lambda one: one["number"])


def test_entries_are_what_the_directories_say(runs: Path) -> None:
    assert find_runs(runs=runs) == truth(runs)
    assert find_runs(runs=runs) == truth(runs)


def test_only_changed_directories_are_read_again(runs: Path, read: list[str]) -> None:
    find_runs(runs=runs)
    read.clear()
    find_runs(runs=runs)
    assert read == ["0003-fourier"]  # interrupted: it may be gone on with at any time
    read.clear()
    changed = runs / "2026-11-20" / "ur5" / "0001-fourier"
    (changed / "verdict.json").write_text(json.dumps({"passed": False}))
    settle(changed, 1_700_000_100.0)
    first, *_ = find_runs(runs=runs)
    assert first["verdict"] == "rejected"
    assert sorted(read) == ["0001-fourier", "0003-fourier"]


@pytest.mark.parametrize("part", ["evaluation.json", "model.json"])
def test_a_file_changed_in_place_is_seen(runs: Path, part: str, read: list[str]) -> None:
    find_runs(runs=runs)
    (fit,) = (runs / "2026-11-20" / "ur5" / "0001-fourier" / "fit").glob("rigid*")
    before = (fit.stat().st_mtime_ns,) * 2
    (fit / part).write_text("{}")
    os.utime(fit / part, (1_700_000_100.0,) * 2)
    os.utime(fit, ns=before)
    read.clear()
    assert find_runs(runs=runs) == truth(runs)
    assert "0001-fourier" in read


def test_what_was_changed_a_moment_ago_is_not_believed(runs: Path, read: list[str]) -> None:
    young = runs / "2026-11-20" / "ur5" / "0001-fourier"
    (young / "verdict.json").write_text(json.dumps({"passed": None}))
    find_runs(runs=runs)
    kept = (young.stat().st_mtime_ns, (young / "verdict.json").stat().st_mtime_ns)
    # Within the same tick of the file system's clock, and of the same size.
    (young / "verdict.json").write_text(json.dumps({"passed": True}))
    os.utime(young / "verdict.json", ns=(kept[1],) * 2)
    os.utime(young, ns=(kept[0],) * 2)
    assert find_runs("verdict=passed", runs=runs)[0]["number"] == 1


def test_runs_that_come_go_and_move_are_followed(runs: Path) -> None:
    find_runs(runs=runs)
    write_run(runs, 4)
    (runs / "2026-11-20" / "ur10" / "0002-fourier").rename(
        runs / "2026-11-20" / "ur10" / "0002-renamed"
    )
    assert [Path(one["run"]).name for one in find_runs(runs=runs)] == [
        "0001-fourier", "0002-renamed", "0003-fourier", "0004-fourier",
    ]  # fmt: skip
    moved = runs.rename(runs.with_name("elsewhere"))
    assert find_runs(runs=moved) == truth(moved)


def test_a_live_run_is_running_and_is_not_afterwards(runs: Path) -> None:
    run = runs / "2026-11-20" / "ur5" / "0001-fourier"
    find_runs(runs=runs)
    with hold_run(run):
        settle(run)
        assert find_runs("status=running", runs=runs)[0]["run"] == str(run)
    settle(run)
    assert find_runs("status=running", runs=runs) == []


@pytest.mark.parametrize("seed", range(12))
def test_a_damaged_file_is_made_anew(runs: Path, seed: int) -> None:
    find_runs(runs=runs)
    content = bytearray((runs / FILE).read_bytes())
    rng = random.Random(seed)
    if seed % 3 == 0:
        content = content[: rng.randrange(len(content))]
    elif seed % 3 == 1:
        first = rng.randrange(len(content) - 4096)
        content[first : first + 4096] = rng.randbytes(4096)
    else:
        content = bytearray(rng.randbytes(5000))
    (runs / FILE).write_bytes(content)
    assert find_runs(runs=runs) == truth(runs)


def test_a_file_of_another_version_is_made_anew(runs: Path) -> None:
    find_runs(runs=runs)
    other = sqlite3.connect(runs / FILE)
    other.execute("UPDATE runs SET name = 'old'")
    other.execute("PRAGMA user_version = 99")
    other.commit()
    other.close()
    assert len(find_runs("name=fourier", runs=runs)) == 3


def test_rebuilding_trusts_nothing(runs: Path, read: list[str]) -> None:
    find_runs(runs=runs)
    read.clear()
    find_runs(runs=runs, rebuild=True)
    assert len(read) == 3


@pytest.mark.parametrize("blocked", ["the file", "the draft"])
def test_where_nothing_can_be_written_it_is_made_in_memory(
    runs: Path, blocked: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if blocked == "the file":
        (runs / FILE / "x").mkdir(parents=True)
    else:
        monkeypatch.setattr("hil.core.files._write_draft", _refuse)
    assert find_runs(runs=runs) == truth(runs)
    assert not (runs / FILE).is_file()
    assert not list(runs.glob(".*.draft"))


def _refuse(*_: object, **options: object) -> int:
    raise PermissionError(13, "Permission denied")


def test_a_folder_without_runs_gets_no_file(tmp_path: Path) -> None:
    assert find_runs(runs=tmp_path) == []
    assert find_runs(runs=tmp_path / "missing") == []
    assert list(tmp_path.iterdir()) == []


def test_odd_documents_and_names_are_no_trouble(tmp_path: Path) -> None:
    odd: dict[str, Any] = {
        "experiment": "half \ud800", "operator": 7, "robot": [], "loads": {"mass_kg": 1},
        "started": "yesterday", "uid": None,
    }  # fmt: skip
    write_run(tmp_path, 1, start=odd, stop={"samples": 1e300, "gaps": "none", "device_s": 3.0})
    named = os.fsdecode(b"0002-\xff")
    write_run(tmp_path, 2).rename(tmp_path / "2026-11-20" / "ur5" / named)
    for _ in range(2):
        first, second = find_runs(runs=tmp_path)
        assert (first["samples"], first["gaps"], first["arm"]) == (None, None, "")
        assert Path(second["run"]).name == named


def test_folders_that_may_not_be_entered_keep_no_other_run_from_the_lists(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = runs / "2026-11-20" / "ur5"
    (robot / "private").mkdir()
    close_folders(monkeypatch, robot / "0001-fourier", robot / "private")
    for _ in range(2):
        entries = find_runs(runs=runs)
        assert [one["status"] for one in entries] == ["damaged", "tripped", "interrupted"]
        assert "Permission denied" in entries[0]["problem"]
        assert [one["status"] for one in list_runs(runs)] == [one["status"] for one in entries]


def test_a_run_that_may_not_be_read_is_an_error_of_the_data(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = runs / "2026-11-20" / "ur5" / "0001-fourier"
    close_folders(monkeypatch, run)
    with pytest.raises(DataError) as caught:
        describe_run(run)
    assert caught.value.message == f"cannot read {run}: Permission denied"
    assert caught.value.hint == "check the permissions of the file"


def test_a_day_that_may_not_be_entered_is_named_and_no_other_run_is_lost(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_run(runs, 4, day="2026-11-27")
    close_folders(monkeypatch, runs / "2026-11-27")
    shown = CliRunner().invoke(app, ["runs", "--runs", str(runs), "--json"])
    assert (
        f"warning: {runs / '2026-11-27'}: Permission denied; runs in it are not listed"
        in shown.stderr
    )
    assert len(json.loads(shown.stdout)) == 3


def test_a_document_that_may_not_be_read_says_nothing_and_all_others_do(
    runs: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    run = runs / "2026-11-20" / "ur5" / "0001-fourier"
    closed = tmp_path / "closed"
    closed.mkdir()
    (run / "start.json").rename(closed / "start.json")
    (run / "start.json").symlink_to(closed / "start.json")
    close_folders(monkeypatch, closed)
    facts = facts_of(run)
    assert (facts["name"], facts["status"]) == ("", "damaged")
    assert [fit["estimator"] for fit in facts["fits"]] == ["rigid-wls", "static-wls"]


@pytest.mark.thorough
def test_processes_may_ask_at_once(runs: Path) -> None:
    for number in range(10, 60):
        write_run(runs, number)
    ask = (
        "import sys; from hil.runs.catalogue import find_runs\n"
        "for _ in range(8): print(len(find_runs('robot=ur5', runs=sys.argv[1], rebuild=_ % 2)))"
    )
    asked = [
        subprocess.Popen([sys.executable, "-c", ask, str(runs)], stdout=subprocess.PIPE)
        for _ in range(3)
    ]
    told = [process.communicate()[0].split() for process in asked]
    assert told == [[b"52"] * 8] * 3
