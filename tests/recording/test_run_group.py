"""The folder of a series or a fleet: what its document says, and which error is the worst."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hil.core.errors import (
    DataError,
    FitError,
    HilError,
    InterlockTripped,
    Rejected,
    Stopped,
)
from hil.recording.run_group import FleetGroup, Member, SeriesGroup, worst_error

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
