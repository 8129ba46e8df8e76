"""`hil reidentify`: what a schedule is about, once and now."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core.errors import DataError, SpecError
from hil.maintenance.ledger import Occasion, open_ledger
from hil.maintenance.stages import Stage, run_stages
from tests.support.pipeline_parts import CAMPAIGN, SCHEDULE, write_schedule


@pytest.mark.thorough
def test_it_is_done_once_and_gone_on_with_where_it_was_cut_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_schedule(tmp_path)
    monkeypatch.chdir(tmp_path)
    told = CliRunner().invoke(app, ["reidentify", "weekly.yaml", "--json"])
    assert told.exit_code == 0, told.output
    first = json.loads(told.stdout)
    assert (first["outcome"], first["champion"], first["name"]) == ("promoted", "v1", "ur5")
    folder = Path(first["folder"])
    assert folder.parent == Path("schedules/weekly/by-hand")

    for stage in ("register", "summary"):
        (folder / "stages" / f"{stage}.json").unlink()
    again = CliRunner().invoke(app, ["reidentify", "weekly.yaml"])
    assert f"continuing {folder}" in again.output
    assert "ur5: v1 is champion: first campaign: there are no criteria" in again.stdout
    assert f"campaign: {first['runs']['campaign']}" in again.stdout
    assert len(list(tmp_path.glob("runs/*/*/*/start.json"))) == 1
    assert len(list(folder.parent.glob("2*"))) == 1


def test_two_at_once_do_not_go_on_with_the_same(tmp_path: Path) -> None:
    file, state = write_schedule(tmp_path), tmp_path / "state"
    command = ["reidentify", str(file), "--state", str(state), "--runs", str(tmp_path / "runs")]
    with open_ledger(state / "by-hand", "weekly"):
        told = CliRunner().invoke(app, command)
    assert isinstance(told.exception, DataError)
    assert "is run by" in str(told.exception)
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(("hours", "begun"), [(23, True), (25, False)])
def test_what_was_cut_off_too_long_ago_is_begun_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hours: int, begun: bool
) -> None:
    cut = Occasion(datetime.now(UTC) - timedelta(hours=hours), "probe")
    (tmp_path / "state" / "by-hand" / cut.id).mkdir(parents=True)
    chosen = []

    def work(*given: object, **named: object) -> Any:
        return lambda occasion, folder: chosen.append(occasion.id) or {
            "name": "ur5", "text": "", "errors": None, "runs": {}
        }  # fmt: skip

    monkeypatch.setattr("hil.maintenance.reidentifying.reidentification", work)
    file = write_schedule(tmp_path)
    told = CliRunner().invoke(app, ["reidentify", str(file), "--state", str(tmp_path / "state")])
    assert told.exit_code == 0, told.output
    assert (chosen == [cut.id]) is begun


def test_what_is_asked_again_within_a_second_is_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, asked = datetime(2027, 1, 2, 3, tzinfo=UTC), []

    def work(*given: object, **named: object) -> Any:
        def do(occasion: Occasion, folder: Path) -> dict[str, Any]:
            asked.append(occasion.due)
            stage = Stage("summary", lambda done: {"name": "ur5", "number": len(asked)})
            return run_stages([stage], folder)["summary"]

        return do

    monkeypatch.setattr("hil.maintenance.reidentifying.reidentification", work)
    monkeypatch.setattr(
        "hil.maintenance.reidentifying.datetime", SimpleNamespace(now=lambda zone: now)
    )
    file = write_schedule(tmp_path)
    monkeypatch.chdir(tmp_path)
    told = [hil.reidentify(file) for _ in range(3)]
    assert [one["number"] for one in told] == [1, 2, 3]
    assert asked == [now + timedelta(seconds=k) for k in range(3)]


def test_a_schedule_that_is_held_is_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_schedule(tmp_path)
    monkeypatch.chdir(tmp_path)
    with open_ledger(Path("schedules/weekly"), "weekly") as ledger:
        ledger.start("weekly", datetime.now(UTC))
        ledger.add("held", datetime.now(UTC), why="tool change", by="root")
    told = CliRunner().invoke(app, ["reidentify", "weekly.yaml"])
    assert isinstance(told.exception, DataError)
    assert "the schedule weekly is held: tool change" in str(told.exception)
    assert "hil schedule release weekly.yaml" in told.exception.hint
    assert not (tmp_path / "runs").exists()


def test_hil_run_names_the_verbs_for_a_schedule(tmp_path: Path) -> None:
    told = CliRunner().invoke(app, ["run", str(write_schedule(tmp_path))])
    assert isinstance(told.exception, SpecError)
    assert "weekly.yaml is a schedule, not an experiment or a series" in str(told.exception)
    assert "hil reidentify" in told.exception.hint
    assert not (tmp_path / "runs").exists()


def test_a_schedule_that_cannot_be_is_refused_before_anything_moves(tmp_path: Path) -> None:
    file = write_schedule(tmp_path, schedule=SCHEDULE | {"probe": None}, campaign=CAMPAIGN)
    runs = tmp_path / "runs"
    told = CliRunner().invoke(app, ["reidentify", str(file), "--runs", str(runs)])
    assert "weekly.yaml" in str(told.exception)
    assert not runs.exists()
