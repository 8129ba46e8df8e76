"""What follows a commissioning run."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.report import summary_lines
from hil.report.next_step import next_commissioning
from hil.report.run_facts import read_facts
from hil.runs.listing import next_command, run_listings
from tests.support.report_runs import dwell_plan, write_run


def commissioned(tmp_path, outcome="completed", station="/lab/my.yaml", **part):
    run = write_run(tmp_path, dwell_plan(), outcome=outcome)
    start = json.loads((run.path / "start.json").read_text())
    told = {"speed": 1.0, "text": "a part", **part}
    more = {"spec": "/lab/dwell.yaml", "station": station, "commissioning": told}
    (run.path / "start.json").write_text(json.dumps(start | more))
    return run


AT = "hil run /lab/dwell.yaml --station /lab/my.yaml"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("outcome", "part", "command"),
    [
        ("completed", {"speed": 0.1, "first": 3}, f"{AT} --speed 10%"),
        ("completed", {"speed": 0.1, "first_s": 30.0}, f"{AT} --speed 10%"),
        ("completed", {"speed": 0.1}, AT),
        ("completed", {"first": 3}, AT),
        ("stopped", {"speed": 0.1, "first": 3}, f"{AT} --speed 10% --first 3"),
        ("failed", {"first_s": 30.0}, f"{AT} --first 30s"),
        ("tripped", {"speed": 0.1}, f"{AT} --speed 10%"),
    ],
)
def test_first_all_poses_then_all_the_speed(tmp_path, outcome, part, command):
    run = commissioned(tmp_path, outcome, **part)
    assert next_commissioning(read_facts(run.path)) == command
    text = " ".join(" ".join(summary_lines(run.path)).split())
    assert command in text
    assert "hil resume" not in text
    assert "hil fit" not in text


def test_the_built_in_bench_needs_no_station(tmp_path):
    run = commissioned(tmp_path, station="built-in mock bench", speed=0.1)
    assert next_commissioning(read_facts(run.path)) == "hil run /lab/dwell.yaml"


def test_runs_lists_the_command_that_repeats_a_failed_commissioning_run(tmp_path):
    run = commissioned(tmp_path, "failed", first_s=30.0)
    (run.path / "report.html").write_text("failed")
    (listing,) = run_listings(tmp_path)
    assert next_command(listing) == f"{AT} --first 30s"
    table = CliRunner().invoke(app, ["runs", "--runs", str(tmp_path)]).output
    assert f"{AT} --first 30s" in table


def test_a_completed_commissioning_run_leaves_nothing_to_complete(tmp_path):
    run = commissioned(tmp_path, first=3)
    (run.path / "report.html").write_text("completed")
    (listing,) = run_listings(tmp_path)
    assert next_command(listing) == ""
