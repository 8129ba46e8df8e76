"""Links, copies, rehearsals, fleets, and disks that refuse: what a policy makes of them."""

from __future__ import annotations

import json
import os
import shutil
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from hil.core.errors import DataError, RecordingError
from hil.runs.retention import Decision, Policy, decide, leftovers, remove
from tests.support.catalogue_runs import close_folders, settle, write_run

NOW = datetime.fromisoformat("2026-12-01T00:00:00+00:00").timestamp()
ALL = Policy(older=timedelta(days=1))


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    root = tmp_path / "runs"
    for number in range(1, 4):
        write_run(root, number, day=f"2026-11-{10 + number}")
    return root


def pruned(runs: Path, policy: Policy = ALL) -> list[Decision]:
    return remove(decide(runs, policy, (), NOW), runs, policy, ())


def goes(runs: Path, policy: Policy = ALL) -> list[str]:
    decisions = decide(runs, policy, (), NOW)
    return [one.run.relative_to(runs).as_posix() for one in decisions if one.goes]


def test_a_link_to_a_run_stays_and_so_does_what_it_leads_to(runs: Path, tmp_path: Path) -> None:
    away = tmp_path / "archive" / "0001-fourier"
    away.parent.mkdir()
    run = runs / "2026-11-11" / "ur5" / "0001-fourier"
    shutil.move(run, away)
    run.symlink_to(away)
    assert [one.why for one in pruned(runs)] == ["it is a link", "", ""]
    assert run.is_symlink()
    assert (away / "recording" / "00.mcap").exists()
    assert leftovers(runs) == []


def test_a_link_to_a_day_makes_no_run_two(runs: Path) -> None:
    (runs / "latest").symlink_to("2026-11-13")
    assert goes(runs, Policy(keep=1)) == [
        "2026-11-11/ur5/0001-fourier", "2026-11-12/ur5/0002-fourier",
    ]  # fmt: skip
    assert goes(runs, Policy(keep=2)) == ["2026-11-11/ur5/0001-fourier"]
    assert [one.why for one in pruned(runs)] == ["", "", "", "it is a link"]
    assert (runs / "latest").is_symlink()


def test_a_copy_of_a_run_is_no_further_run(runs: Path) -> None:
    shutil.copytree(runs / "2026-11-13", runs / "copy")
    assert goes(runs, Policy(keep=2)) == ["2026-11-11/ur5/0001-fourier"]


def test_recordings_that_lie_elsewhere_stay(runs: Path, tmp_path: Path) -> None:
    folder = runs / "2026-11-11" / "ur5" / "0001-fourier" / "recording"
    shutil.move(folder, tmp_path / "big-disk")
    folder.symlink_to(tmp_path / "big-disk")
    policy = Policy(older=timedelta(days=1), recordings_only=True)
    assert [one.why for one in pruned(runs, policy)] == ["its recordings are a link", "", ""]
    assert not (folder.parent / "pruned.json").exists()
    assert [one.why for one in pruned(runs)] == [""] * 3
    assert (tmp_path / "big-disk" / "00.mcap").exists()


@pytest.mark.parametrize("lacks", ["speed", "recording", "approval", "end"])
def test_only_runs_in_full_take_an_older_ones_place(lacks: str, runs: Path) -> None:
    part = {"commissioning": {"text": "10 % speed"}} if lacks == "speed" else None
    outcome = "stopped" if lacks == "end" else "completed"
    run = write_run(runs, 4, day="2026-11-14", start=part, outcome=outcome)
    if lacks == "recording":
        shutil.rmtree(run / "recording")
    if lacks == "approval":
        (run / "verdict.json").write_text(json.dumps({"passed": False}))
    settle(run)
    assert goes(runs, Policy(keep=2)) == ["2026-11-11/ur5/0001-fourier"]


def test_runs_of_a_fleet_stay_together(runs: Path, tmp_path: Path) -> None:
    fleet = runs / "2026-11-20" / "fleet" / "fleet-weekly"
    fleet.mkdir(parents=True)
    for number, outcome in ((7, "completed"), (8, None)):
        robot = f"ur5-00{number}"
        spec = f"/where/runs/were/2026-11-20/fleet/fleet-weekly/specs/{robot}.yaml"
        write_run(runs, number, robot=robot, start={"spec": spec}, outcome=outcome)
    told = {one.run.name[:4]: one.why for one in decide(runs, ALL, (), NOW)}
    assert told["0007"].startswith(
        "it belongs to fleet-weekly, whose run 0008-fourier stays: it was interrupted"
    )
    assert told["0003"] == ""
    interrupted = Policy(older=timedelta(days=1), interrupted=True)
    assert len(goes(runs, interrupted)) == 5


@pytest.mark.parametrize(
    "closed",
    ["2026-11-12", "2026-11-12/ur5", "2026-11-20/fleet/fleet-weekly", "2026-11-20/series/series-x"],
)
def test_nothing_goes_while_a_folder_that_may_keep_runs_cannot_be_read(
    closed: str, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (runs / closed).mkdir(parents=True, exist_ok=True)
    close_folders(monkeypatch, runs / closed)
    with pytest.raises(DataError) as caught:
        decide(runs, ALL, (), NOW)
    assert caught.value.message == f"cannot read {runs / closed}: Permission denied"
    assert "nothing is deleted until" in caught.value.hint


@pytest.mark.parametrize(
    ("refuses", "named", "hint"),
    [("rename", "0001-fourier", "none of its files has been deleted"),
     ("rmtree", ".trash-", "the next hil prune --yes deletes the remaining files")],
)  # fmt: skip
def test_a_disk_that_refuses_is_told_with_what_is_left(
    refuses: str, named: str, hint: str, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise PermissionError(13, os.strerror(13))

    monkeypatch.setattr(*((Path, "rename") if refuses == "rename" else (shutil, "rmtree")), fail)
    with pytest.raises(RecordingError) as caught:
        pruned(runs)
    assert named in caught.value.message
    assert hint in caught.value.hint
    assert len(leftovers(runs)) == (refuses == "rmtree")
