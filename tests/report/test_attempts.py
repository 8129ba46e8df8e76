"""The page of a run that was resumed: what was recorded, and the pause in which nothing was."""

from __future__ import annotations

import json

import numpy as np
import pytest

from hil.recording import McapWriter
from hil.report import render_report
from hil.report.curves import decimated, in_parts
from hil.report.run_facts import read_facts
from hil.report.run_recording import read_recording
from hil.robot.state import STATE_TOPIC, state_topic
from tests.support.report_html import Page, array_of
from tests.support.report_runs import RATE, dwell_plan, rows_of_plan, write_run

PAUSE_S = 100.0
FIRST = 700


def write_file(path, rows):
    writer = McapWriter(path, [state_topic(6, RATE, clock="virtual", effort_unit="A")])
    writer.write(STATE_TOPIC, rows)
    writer.flush(durable=False)
    writer.finish()


@pytest.fixture
def resumed(tmp_path):
    """Two attempts with a pause between them, the second in two files."""
    plan = dwell_plan()
    rows = rows_of_plan(plan)
    rows["device_time"][FIRST:] += PAUSE_S
    run = write_run(tmp_path, plan, rows=rows[:FIRST], outcome="failed", reason="a stop")
    write_file(run.path / "recording" / "01.mcap", rows[FIRST:1000])
    write_file(run.path / "recording" / "01.001.mcap", rows[1000:])
    (run.path / "resume-01.json").write_text('{"hil_run": 1, "attempt": 1}')
    run.write_stop("failed", "again", {"samples": len(rows), "hint": "unlock it"}, attempt=1)
    return run, rows


def test_the_pause_between_attempts_is_no_recorded_time(resumed):
    run, rows = resumed
    recording = read_recording(read_facts(run.path), [])
    assert [len(part) for part in recording.attempts] == [FIRST, len(rows) - FIRST]
    assert recording.attempt_starts == (FIRST,)
    assert recording.recorded_s == pytest.approx((len(rows) - 2) / RATE)
    assert recording.counts.gaps == 0


def test_no_line_is_drawn_across_the_pause_and_every_attempt_is_marked(resumed):
    run, _ = resumed
    page = Page(render_report(run.path).read_text("utf-8"))
    over_time = [
        figure
        for figure in page.figures
        if figure["layout"]["xaxis"]["title"]["text"] == "time [s]"
        and "change" not in figure["layout"]["yaxis"]["title"]["text"]
    ]
    assert len(over_time) >= 8  # joint angles, tracking error, temperature, interval
    for figure in over_time:
        for trace in figure["data"]:
            x = array_of(trace["x"])
            crossed = np.diff(x) > PAUSE_S / 2  # NaN between two points is no line
            assert trace["name"] == "limit" or not crossed.any()
        (mark,) = figure["layout"]["shapes"]
        assert mark["x0"] == pytest.approx(PAUSE_S + FIRST / RATE, abs=0.1)
        assert figure["layout"]["annotations"][0]["text"] == "attempt 2"


def test_parts_are_thinned_apart():
    x = np.arange(10_000.0)
    kept, y = in_parts(decimated, x, np.sin(x), (4_000,))
    assert np.isnan(kept).sum() == 1
    gap = int(np.isnan(kept).argmax())
    assert (kept[gap - 1], kept[gap + 1]) == (3_999.0, 4_000.0)
    assert np.isnan(y[gap])
    whole = in_parts(decimated, x, np.sin(x), ())
    assert np.array_equal(whole[0], decimated(x, np.sin(x))[0])


def test_the_page_says_what_to_do_and_names_the_run(resumed):
    run, _ = resumed
    text = Page(render_report(run.path).read_text("utf-8")).text
    assert f"To do: unlock it. Next: hil resume {run.path.name}" in text
    assert "resume RUN" not in text


def test_poses_that_nothing_was_fitted_to_are_measured_ones(resumed):
    run, _ = resumed
    text = Page(render_report(run.path).read_text("utf-8")).text
    assert "trained on" not in text


def test_the_timeline_is_no_python(resumed):
    run, _ = resumed
    watching = [
        {"name": "tracking_error", "action": "stop", "limit": "0.05 rad"},
        {"name": "torque", "action": "off", "limit": "", "why": "no model"},
    ]
    with (run.path / "events.jsonl").open("a") as log:
        event = {"t": 1.0, "kind": "interlocks", "watching": watching}
        log.write(json.dumps(event) + "\n")
        log.write(json.dumps({"t": 2.0, "kind": "dwelt", "settled": True, "com_m": [0.0, 1.5]}))
        log.write("\n")
    text = Page(render_report(run.path).read_text("utf-8")).text
    said = "tracking_error (action stop, limit 0.05 rad); torque (action off, why no model)"
    assert f"watching: {said}" in text
    assert "settled: yes, com_m: 0.0, 1.5" in text
    assert "{'" not in text
