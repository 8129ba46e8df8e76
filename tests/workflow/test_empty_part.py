"""Parts that a kill met before their first sample stop nobody: loading, resuming, reporting."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core.errors import DataError
from hil.importers.sources import load_source
from hil.recording import McapWriter, RunDirectory, read_topic
from hil.recording.recovery import recover
from hil.robot.state import state_topic
from tests.support.report_runs import dwell_plan, write_run
from tests.workflow.test_resume import all_steps, measured, stopped_run


def with_empty_parts(run: RunDirectory, *parts: tuple[int, int], rate_hz: float = 125.0) -> None:
    """What kills leave at a seam, and in the first 0.1 s of an attempt."""
    topic = state_topic(6, rate_hz, clock="virtual", effort_unit="A")
    for part in parts:
        McapWriter(run.part_path(*part), [topic]).abandon()


@pytest.mark.thorough
@pytest.mark.parametrize("recovered", [False, True])
def test_rows_beside_an_empty_part_are_loaded_and_reported(tmp_path: Path, recovered: bool) -> None:
    run = write_run(tmp_path, dwell_plan(poses=4), outcome=None, finish=False)
    before = load_source(run.path)
    with_empty_parts(run, (0, 1), (1, 0))
    if recovered:
        assert {file.did for file in recover(run.path).files} == {"rebuilt", "empty"}
        assert [len(read_topic(path)) == 0 for path in run.recordings] == [False, True, True]
    after = load_source(run.path)
    assert len(before.conditions) > 8
    assert after.conditions == before.conditions
    assert after["q"].tobytes() == before["q"].tobytes()
    told = CliRunner().invoke(app, ["report", str(run.path)])
    assert told.exit_code == 0, told.output
    assert (run.path / "report.html").stat().st_size > 10_000


@pytest.mark.parametrize("recovered", [False, True])
def test_run_of_nothing_but_an_empty_part_says_so_and_is_reported(
    tmp_path: Path, recovered: bool
) -> None:
    run = write_run(tmp_path, dwell_plan(poses=4), outcome=None, finish=False)
    for path in run.recordings:
        path.unlink()
    with_empty_parts(run, (0, 0))
    if recovered:
        assert recover(run.path).error is None
    with pytest.raises(DataError, match=str(run.path)):
        load_source(run.path)
    told = CliRunner().invoke(app, ["report", str(run.path)])
    assert told.exit_code == 0, told.output


@pytest.mark.thorough
@pytest.mark.parametrize("recovered", [False, True])
def test_run_with_empty_parts_is_resumed_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recovered: bool
) -> None:
    path = stopped_run(tmp_path, monkeypatch, step=12)
    run = RunDirectory.open(path)
    with_empty_parts(run, (0, 1), (1, 0))
    if recovered:
        assert recover(path).error is None
    before = measured(path)
    assert before
    assert hil.resume(path).outcome == "completed"
    assert measured(path) == all_steps(path)
    assert [path.name for path in run.recordings][-1] == "02.mcap"
