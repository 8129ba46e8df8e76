"""The page of a run: complete, self-contained, harmless, and honest about how the run ended."""

from __future__ import annotations

import base64
import gzip
import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plotly.offline import get_plotlyjs
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core.errors import DataError, RecordingError
from hil.importers.sources import load_source
from hil.networks.training import Curves, Told
from hil.recording import McapWriter
from hil.report import colours, render_fit_report, render_report, run_report, summary_lines
from hil.report.curves import decimated, dressed, in_parts
from hil.report.fit_facts import FitFacts
from hil.report.model_figures import ModelView, error_per_joint, learning_curves, learning_panel
from hil.report.model_sections import _setting, criteria_under_loads, model_sections
from hil.report.next_step import next_commissioning
from hil.report.page import page_html
from hil.report.plotly_figure import figure_json, plotly_of
from hil.report.predictions import Predictions
from hil.report.run_facts import RunFacts, read_facts
from hil.report.run_recording import dataset_of, read_recording
from hil.report.run_report import run_page, timeline
from hil.report.run_summary import load_name, weighing_warnings, weighings
from hil.report.study_sections import HONEST_MEANS, columns_of, study_sections
from hil.robot.state import STATE_TOPIC, state_topic
from hil.runs.listing import next_command, run_listings
from hil.spec.load import load_spec
from hil.studies.figure import Curve, Figure, Panel
from hil.studies.result import Table
from hil.workflow.judging import judge_run
from tests.support.report_html import Page, array_of
from tests.support.report_runs import (
    JOINTS,
    RATE,
    dwell_plan,
    fourier_plan,
    rows_of_plan,
    write_run,
)
from tests.support.study_parts import result

HOSTILE = "\"><script>alert('x')</script><img src=http://evil.example/x onerror=alert(1)>"
COUNTS = {"samples": 1, "gaps": 0, "missing": 0, "duplicates": 0}


def page_of(run):
    return Page(render_report(run.path).read_text("utf-8"))


def badge_of(page):
    at = page.pieces.index("Verdict: ")
    return page.pieces[at + 1]


def table_of(page, words):
    return next(rows for caption, rows in page.tables.items() if words in caption)


@pytest.fixture(scope="module")
def dwells(tmp_path_factory):
    """A dwell run, fitted and judged against criteria it cannot meet."""
    accept = "{rmse: {max: 0.01, unit: A, per: joint}, gaps_percent: {max: 0.1}}"
    run = write_run(tmp_path_factory.mktemp("dwells"), dwell_plan(), accept=accept)
    judge_run(run, load_spec(run.path / "spec.yaml"), COUNTS)
    return run


@pytest.fixture(scope="module")
def fourier(tmp_path_factory):
    """A Fourier run, fitted; its spec has no criteria."""
    run = write_run(tmp_path_factory.mktemp("fourier"), fourier_plan())
    judge_run(run, load_spec(run.path / "spec.yaml"), COUNTS)
    return run


@pytest.fixture(scope="module")
def dwell_page(dwells):
    return page_of(dwells)


@pytest.fixture(scope="module")
def fourier_page(fourier):
    return page_of(fourier)


def evaluation_of(run):
    return json.loads(next(run.path.glob("fit/*/evaluation.json")).read_text())


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["dwell_page", "fourier_page"])
def test_the_page_loads_nothing_from_anywhere(name, request):
    page = request.getfixturevalue(name)
    assert [load for load in page.loads if not load.startswith("#")] == []
    assert not any(tag in ("link", "iframe", "object", "embed", "base") for tag, _ in page.tags)
    assert not any("url(" in style or "@import" in style for style in page.styles)
    policy = next(
        attrs["content"]
        for tag, attrs in page.tags
        if tag == "meta" and attrs.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy.startswith("default-src 'none'")
    assert "http" not in policy


def test_plotly_is_inside_once_packed_and_left_out_of_a_page_without_plots(dwell_page, tmp_path):
    ((attrs, packed),) = [each for each in dwell_page.scripts if len(each[1]) > 500_000]
    assert attrs["type"] == "application/gzip"
    assert len(packed) < 2_000_000
    assert gzip.decompress(base64.b64decode(packed)).decode() == get_plotlyjs()
    empty = write_run(tmp_path, dwell_plan(), rows=rows_of_plan(dwell_plan())[:0], outcome="failed")
    assert render_report(empty.path).stat().st_size < 100_000


def test_every_link_inside_the_page_leads_somewhere(dwell_page):
    assert len(set(dwell_page.ids)) == len(dwell_page.ids)
    targets = {load[1:] for load in dwell_page.loads if load.startswith("#")}
    assert targets <= set(dwell_page.ids)


def test_the_page_can_be_read_without_seeing_it(dwell_page):
    plots = [attrs for tag, attrs in dwell_page.tags if attrs.get("class") == "plot"]
    assert plots
    assert all(attrs["role"] == "img" and attrs["aria-label"] for attrs in plots)
    assert all(dwell_page.tables), "every table has a caption"
    assert [tag for tag, _ in dwell_page.tags].count("h1") == 1
    assert ("html", {"lang": "en"}) in dwell_page.tags
    assert any(attrs.get("class") == "skip" for _, attrs in dwell_page.tags)


@pytest.mark.parametrize(("run", "page"), [("dwells", "dwell_page"), ("fourier", "fourier_page")])
def test_the_numbers_of_the_evaluation_stand_in_the_table(run, page, request):
    document = evaluation_of(request.getfixturevalue(run))
    rows = table_of(request.getfixturevalue(page), "errors per joint")
    header = [(text, i) for i, text in enumerate(rows[1])]
    held_out, trained = ([i for text, i in header if text == "RMSE raw"][k] for k in (0, 1))
    for part, column in (("held_out", held_out), ("trained", trained)):
        for row, value in zip(rows[2:], document[part]["total"]["rmse_raw"], strict=False):
            assert float(row[column]) == pytest.approx(value, rel=5e-3)
    last = rows[-1]
    assert last[0] == "mean"
    assert float(last[held_out]) == pytest.approx(
        document["held_out"]["total"]["mean_raw"], rel=5e-3
    )


def test_held_out_and_trained_errors_are_labelled(dwell_page):
    groups = table_of(dwell_page, "errors per joint")[0]
    assert any("held out" in text for text in groups)
    assert any("trained on" in text for text in groups)


def test_a_missed_criterion_is_said_in_words_in_the_badge_and_in_the_table(dwell_page):
    assert badge_of(dwell_page) == "REJECTED"
    assert "RMSE raw ≤ 0.01 A by 6 of 6 joints, worst" in dwell_page.text
    rows = table_of(dwell_page, "errors per joint")
    assert [row[-1].startswith("✗failed: ") for row in rows[2:-1]] == [True] * 6


def test_without_criteria_the_model_is_not_called_good(fourier_page):
    assert badge_of(fourier_page) == "NOT JUDGED"
    assert "The spec sets no acceptance criteria." in fourier_page.text


def test_a_passed_verdict_names_what_was_passed(fourier, tmp_path):
    copy = shutil.copytree(fourier.path, tmp_path / "copy")
    row = {"estimator": "rigid-wls", "metric": "rmse_raw", "what": "mean", "value": 0.1}
    document = {"passed": True, "rows": [{**row, "max": 0.2, "unit": "A", "passed": True}]}
    (copy / "verdict.json").write_text(json.dumps(document))
    page = Page(render_report(copy).read_text())
    assert badge_of(page) == "PASSED"
    assert "The criterion is met: RMSE raw ≤ 0.2 A." in page.text


def test_the_part_above_the_cut_off_is_named_by_its_frequency_and_bounds_nothing(
    fourier_page, dwell_page
):
    assert "part above 12.5 Hz" in fourier_page.text
    assert "scatter within dwells" in dwell_page.text
    for page in (fourier_page, dwell_page):
        assert "noise floor" not in page.text
        assert "no model can" not in page.text


def test_gravity_and_stick_friction_are_told_apart(dwells, dwell_page):
    rows = table_of(dwell_page, "errors in gravity and static friction")
    measured = rows[-7:-1]
    assert len(measured) == 6
    for row in measured:
        # The made-up effort holds ±0.1 A by approach, and noise that averages to little.
        assert float(row[2]) == pytest.approx(0.1, abs=0.01)
    document = evaluation_of(dwells)["held_out"]["total"]
    for row, whole in zip(measured, document["rmse_filtered"], strict=True):
        apart = np.hypot(float(row[1]), float(row[3]))
        assert apart == pytest.approx(whole, rel=0.02)


def test_a_run_that_was_renamed_still_finds_what_was_held_out(dwells, tmp_path):
    copy = shutil.copytree(dwells.path, tmp_path / "renamed")
    page = Page(render_report(copy).read_text())
    assert "Plots of the models are omitted" not in page.text
    assert "The plots of static-wls are omitted" not in page.text
    assert table_of(page, "errors in gravity and static friction")


def test_a_dwell_that_was_repeated_is_shown_as_it_was_judged(tmp_path):
    plan = dwell_plan()
    rows = rows_of_plan(plan, dwell_rows=30)
    again = rows[rows["segment"] >= len(plan) - 2].copy()  # the last dwell and the move there
    again["effort"] += 5.0
    again["device_time"] += rows["device_time"][-1] - again["device_time"][0] + 0.008
    run = write_run(tmp_path, plan, rows=np.concatenate([rows, again]))
    problems = []
    facts = read_facts(run.path)
    here = dataset_of(facts, read_recording(facts, problems))
    there = load_source(run.path).of_kind("dwell")
    assert problems == []
    assert [c.id for c in here.conditions] == [c.id for c in there.conditions]
    np.testing.assert_array_equal(here["effort"], there["effort"])


def test_a_dwell_that_a_stop_cut_short_is_not_shown(tmp_path):
    plan = dwell_plan()
    rows = rows_of_plan(plan, dwell_rows=30)
    last = max(step.index for step in plan if step.kind in ("dwell", "reference"))
    torn = rows[: np.flatnonzero(rows["segment"] == last)[2]]  # two rows of it
    run = write_run(tmp_path, plan, rows=torn, outcome="failed", reason="a stop")
    facts = read_facts(run.path)
    here = dataset_of(facts, read_recording(facts, []))
    there = load_source(run.path).of_kind("dwell")
    assert [c.id for c in here.conditions] == [c.id for c in there.conditions]


def test_the_plots_show_the_series_the_evaluation_names_and_no_others(dwells, tmp_path):
    copy = shutil.copytree(dwells.path, tmp_path / "copy")
    file = next(copy.glob("fit/*/evaluation.json"))
    document = json.loads(file.read_text())
    document["held_out"]["series"] = document["held_out"]["series"][:2]
    file.write_text(json.dumps(document))
    page = Page(render_report(copy).read_text())
    assert any(
        "1 held-out poses approached from both directions" in caption for caption in page.tables
    )


def edited_fit(run, name, **held_out):
    """A copy of the run's model whose evaluation says something else of what was held out."""
    folder = shutil.copytree(next(run.glob("fit/rigid-wls-*")), run / "fit" / name)
    document = json.loads((folder / "evaluation.json").read_text())
    document["held_out"] |= held_out
    (folder / "evaluation.json").write_text(json.dumps(document))
    return folder


def test_a_model_without_held_out_series_costs_no_other_its_plots(fourier, tmp_path, monkeypatch):
    monkeypatch.setattr(run_report, "MOST_PLOTTED", 1)
    copy = shutil.copytree(fourier.path, tmp_path / "copy")
    edited_fit(copy, "another-0123456789ab", series=[])
    page = run_page(copy)
    (warning,) = [text for text in page.warnings if "are omitted" in text]
    assert warning.startswith("The plots of another are omitted:")
    plots = {s.title: any(isinstance(b, Figure) for b in s.blocks) for s in page.sections}
    assert plots["Model rigid-wls"]
    assert not plots["Model another"]


def test_a_model_judged_on_another_run_shows_no_series_of_this_one(fourier, tmp_path):
    copy = shutil.copytree(fourier.path, tmp_path / "copy")
    file = next(copy.glob("fit/*/evaluation.json"))
    document = json.loads(file.read_text())
    entry = {**document["held_out"], "source": "runs/0099-other"}
    file.write_text(json.dumps({"validation": [entry]}))
    warnings = " ".join(run_page(copy).warnings)
    assert "the model was evaluated on runs/0099-other, not on this recording" in warnings


def test_only_routine_events_that_there_were_are_counted(fourier, tmp_path):
    copy = shutil.copytree(fourier.path, tmp_path / "copy")
    assert "0 ×" not in Page(render_report(copy).read_text()).text


def test_dwells_are_plotted_as_they_were_measured_from_both_sides(dwell_page):
    below = [
        f["data"][0]
        for f in dwell_page.figures
        if f["data"][0].get("name") == "measured, from below"
    ]
    assert len(below) == 6
    expected = evaluation_of_rows()
    np.testing.assert_allclose(np.sort(array_of(below[0]["y"])), np.sort(expected), rtol=1e-5)


def evaluation_of_rows():
    """Mean effort of J1 over the last ten rows of every held-out dwell from below."""
    from hil.data.splits import split

    plan, out = dwell_plan(), []
    rows = rows_of_plan(plan)
    held = held_out_poses(load_source, split)
    for step in plan:
        if step.kind == "dwell" and step.approach == 1 and step.pose in held:
            out.append(rows["effort"][rows["segment"] == step.index][-10:, 0].mean())
    return np.array(out)


def held_out_poses(load_source, split):
    import tempfile
    from pathlib import Path

    with tempfile.TemporaryDirectory() as folder:
        run = write_run(Path(folder), dwell_plan())
        data = load_source(run.path).of_kind("dwell")
        return {c.pose for c in split(data, "pose", 0.25, seed=7).test.conditions}


def test_the_worst_held_out_trajectory_is_shown(fourier_page):
    names = [{trace.get("name") for trace in f["data"]} for f in fourier_page.figures]
    assert sum(name == {"measured", "predicted"} for name in names) == 6
    assert "Trajectory 2 (counted from 0) of" in fourier_page.text


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("outcome", "reason", "badge", "words"),
    [
        (None, "", "INTERRUPTED", "The run ended without a stop document"),
        ("stopped", "stopped by the keyboard", "STOPPED", "stopped by the keyboard"),
        ("tripped", "interlock temperature: 81 °C", "TRIPPED", "An interlock stopped the robot"),
        ("failed", "the cable came off", "FAILED", "The run failed: the cable came off."),
        ("completed", "", "NOT JUDGED", "the run has no fitted model"),
    ],
)
def test_a_run_without_a_model_says_what_happened(tmp_path, outcome, reason, badge, words):
    plan = fourier_plan()
    rows = rows_of_plan(plan)
    run = write_run(tmp_path, plan, rows=rows[: len(rows) // 2], outcome=outcome, reason=reason)
    page = page_of(run)
    assert badge_of(page) == badge
    assert words in page.text
    assert "Joint angles over time" in page.text


def test_a_killed_recording_is_read_as_far_as_it_goes(tmp_path):
    run = write_run(tmp_path, fourier_plan(), outcome=None, finish=False)
    page = page_of(run)
    assert "00.mcap.partial was not finished" in page.text
    assert "3 481" in page.text.replace("\u202f", " ")


def test_a_preflight_failure_before_any_motion_still_gets_a_page(tmp_path):
    run = write_run(tmp_path, dwell_plan(), rows=rows_of_plan(dwell_plan())[:0], outcome="failed")
    checks = [{"name": "disk", "passed": False, "waived": False, "message": "no space left"}]
    run.write_json("preflight.json", {"passed": False, "checks": checks})
    page = page_of(run)
    assert "No sample was recorded" in page.text
    assert "no space left" in page.text


def test_damaged_files_become_warnings_not_failures(tmp_path):
    run = write_run(tmp_path, dwell_plan())
    (run.path / "verdict.json").write_text("{")
    (run.path / "stop.json").write_text("[]")
    (run.path / "spec.yaml").write_text("a: [")
    (run.path / "recording" / "00.mcap").write_bytes(b"nothing")
    page = page_of(run)
    assert badge_of(page) == "DAMAGED"
    for name in ("verdict.json", "stop.json", "spec.yaml", "00.mcap"):
        assert name in page.text


def test_a_model_that_cannot_be_loaded_leaves_its_numbers_on_the_page(fourier, tmp_path):
    copy = shutil.copytree(fourier.path, tmp_path / "copy")
    next(copy.glob("fit/*/model.safetensors")).write_bytes(b"")
    page = Page(render_report(copy).read_text())
    assert "The plots of rigid-wls are omitted" in page.text
    assert table_of(page, "errors per joint")


@pytest.mark.thorough
def test_models_stand_in_the_order_of_the_spec_and_the_best_is_named_and_open(fourier, tmp_path):
    copy = shutil.copytree(fourier.path, tmp_path / "copy")
    folder = next(copy.glob("fit/*"))
    other = shutil.copytree(folder, folder.with_name("better-0123456789ab"))
    document = json.loads((other / "evaluation.json").read_text())
    document["held_out"]["total"]["mean_raw"] = 1e-3
    (other / "evaluation.json").write_text(json.dumps(document))
    page = Page(render_report(copy).read_text())
    rows = table_of(page, "Models, means over the joints")
    assert [row[0] for row in rows[2:]] == ["rigid-wls", "better"]
    assert any("smallest held-out error: better" in caption for caption in page.tables)
    models = [section for section in run_page(copy).sections if section.id.startswith("model-")]
    assert [(one.title, one.folded) for one in models] == [
        ("Model rigid-wls", True),
        ("Model better", False),
    ]


def test_hostile_names_stay_text(tmp_path):
    robot = {
        "model": HOSTILE, "identity": {"model": HOSTILE, "serial": HOSTILE}, "rate_hz": 125,
        "joint_names": [HOSTILE] * 6, "effort_kind": "current",
    }  # fmt: skip
    run = write_run(tmp_path, dwell_plan(), robot=robot, outcome="failed", reason=HOSTILE)
    plan = json.loads((run.path / "plan.json").read_text())
    plan |= {"name": HOSTILE, "joint_names": [HOSTILE] * 6}
    (run.path / "plan.json").write_text(json.dumps(plan))
    with run.event_log() as log:
        log.append("prompt", text=HOSTILE)
    html = render_report(run.path).read_text("utf-8")
    page = Page(html)
    assert "<script>alert" not in html
    assert [load for load in page.loads if not load.startswith("#")] == []
    assert not any(name.startswith("on") for _, attrs in page.tags for name in attrs)
    assert page.text.count("<script>alert('x')</script>") >= 4


def test_gaps_and_unsettled_dwells_are_warned_of(tmp_path):
    plan = dwell_plan()
    rows = rows_of_plan(plan)
    rows["device_time"][700:] += 5 / 125.0
    run = write_run(tmp_path, plan, rows=rows)
    step = next(s for s in plan if s.kind == "dwell" and s.pose == 3)
    stop = run.stop | {"unsettled": [step.index]}
    (run.path / "stop.json").write_text(json.dumps(stop))
    text = page_of(run).text
    share = 100 * 5 / (len(rows) + 5)
    assert f"1 gap(s) in the recording: 5 samples missing ({share:.2f} %)." in text
    assert "1 dwell(s) did not settle before the time-out: poses 3." in text


def test_drift_is_seen_apart_from_friction_that_has_the_sign_of_the_approach(tmp_path):
    plan = dwell_plan()
    rows = rows_of_plan(plan)
    for side, slope in ((1, 0.1), (-1, -0.2)):
        visits = [s.index for s in plan if s.kind == "reference" and s.approach == side]
        for number, index in enumerate(visits):
            rows["effort"][rows["segment"] == index, 2] = side + slope * number
    page = page_of(write_run(tmp_path, plan, rows=rows))
    drifts = [
        array_of(trace["y"])
        for figure in page.figures
        for trace in figure["data"]
        if trace.get("name") == f"J3 {JOINTS[2]}" and trace["mode"] == "lines+markers"
    ]
    expected = [0.1 * np.arange(len(visits)), -0.2 * np.arange(len(visits))]
    np.testing.assert_allclose(drifts, expected, atol=1e-6)


@pytest.mark.thorough
def test_the_page_is_a_function_of_the_directory_alone(dwells, monkeypatch):
    first = render_report(dwells.path).read_bytes()
    monkeypatch.chdir(dwells.path)
    assert render_report(dwells.path).read_bytes() == first


def test_a_report_that_cannot_be_made_leaves_the_older_one(dwells, monkeypatch):
    older = render_report(dwells.path).read_bytes()
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(RecordingError, match="disk full"):
        render_report(dwells.path)
    assert (dwells.path / "report.html").read_bytes() == older
    assert not list(dwells.path.glob(".*draft"))


@pytest.mark.thorough
def test_a_full_size_run_stays_below_six_megabytes(tmp_path):
    plan = dwell_plan(poses=60)
    rows = rows_of_plan(plan, dwell_rows=1600)
    assert len(rows) > 400_000
    run = write_run(tmp_path, plan, rows=rows)
    assert render_report(run.path).stat().st_size < 6_000_000


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(DataError, match="is not a run directory"):
        render_report(tmp_path)


def test_a_run_of_a_newer_hil_is_refused_and_gets_no_page(tmp_path):
    run = write_run(tmp_path, fourier_plan())
    start = run.start | {"hil_run": 99}
    (run.path / "start.json").write_text(json.dumps(start))
    with pytest.raises(DataError, match="newer hil"):
        render_report(run.path)
    assert not (run.path / "report.html").exists()


@pytest.mark.thorough
def test_a_model_judged_outside_a_run_gets_the_same_page(fourier, tmp_path):
    found = hil.fit([fourier.path], estimator="rigid-wls", validate=[], out=tmp_path / "models")
    folder = found.fitted.folder
    with pytest.raises(DataError, match="no evaluation"):
        render_fit_report(folder, {}, tmp_path / "page.html")
    held_out = evaluation_of(fourier)["held_out"]
    source = str(fourier.path)
    (folder / "evaluation.json").write_text(
        json.dumps({"validation": [{**held_out, "source": source}]})
    )
    out = render_fit_report(folder, {source: load_source(source)}, tmp_path / "page.html")
    page = Page(out.read_text("utf-8"))
    assert badge_of(page) == "NOT JUDGED"
    assert "Recording health" not in page.text
    assert len(page.figures) == 37


def test_samples_that_count_as_moving_and_as_standing_are_explained(fourier, fourier_page):
    """Joints are told apart, so the groups together have more samples than were judged."""
    (fit,) = read_facts(fourier.path).judged_fits
    groups = {g["name"]: g["samples"] for g in fit.held_out["tables"] if g["by"] == "motion"}
    assert sum(groups.values()) > fit.total()["samples"]
    assert "counts in both groups" in fourier_page.text


# The page of a run that was resumed: what was recorded, and the pause in which nothing was


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


# What follows a commissioning run


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
        ("completed", {"speed": 0.1, "first": 3}, f"{AT} --speed-scale 10%"),
        ("completed", {"speed": 0.1, "first_s": 30.0}, f"{AT} --speed-scale 10%"),
        ("completed", {"speed": 0.1}, AT),
        ("completed", {"first": 3}, AT),
        ("stopped", {"speed": 0.1, "first": 3}, f"{AT} --speed-scale 10% --limit 3"),
        ("failed", {"first_s": 30.0}, f"{AT} --limit 30s"),
        ("tripped", {"speed": 0.1}, f"{AT} --speed-scale 10%"),
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
    assert next_command(listing) == f"{AT} --limit 30s"
    table = CliRunner().invoke(app, ["runs", "--runs", str(tmp_path)]).output
    assert f"{AT} --limit 30s" in table


def test_a_completed_commissioning_run_leaves_nothing_to_complete(tmp_path):
    run = commissioned(tmp_path, first=3)
    (run.path / "report.html").write_text("completed")
    (listing,) = run_listings(tmp_path)
    assert next_command(listing) == ""


# What the page of a run says of its models under loads: one order, one look, names by mass


NAMES = ("rigid-wls", "rigid-irls", "rigid-linear")
RAW = {"rigid-wls": 0.3, "rigid-irls": 0.2, "rigid-linear": 0.1}
"""The spec's order, and errors that rank them the other way round."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three models of which the first was judged under its loads."""
    made = write_run(tmp_path_factory.mktemp("loads"), fourier_plan())
    judge_run(made, load_spec(made.path / "spec.yaml"), COUNTS)
    (folder,) = made.path.glob("fit/*")
    for name in NAMES[1:]:
        shutil.copytree(folder, folder.with_name(f"{name}-0123456789ab"))
    for file in made.path.glob("fit/*/evaluation.json"):
        told = json.loads(file.read_text("utf-8"))
        told["held_out"]["total"]["mean_raw"] = RAW[file.parent.name.rpartition("-")[0]]
        told["verdict"]["rows"] = []
        file.write_text(json.dumps(told), "utf-8")
    spec = (made.path / "spec.yaml").read_text("utf-8")
    fits = ", ".join(f"{{estimator: {name}}}" for name in NAMES)
    lines = [f"fit: [{fits}]" if x.startswith("fit:") else x for x in spec.splitlines()]
    (made.path / "spec.yaml").write_text("\n".join(lines), "utf-8")
    rows = [
        {"estimator": "rigid-wls", "metric": "load_error_ratio", "what": "5 kg load",
         "value": 1.42, "max": 1.5, "unit": "1", "passed": True},
        {"estimator": "rigid-wls", "metric": "contradicted_loads", "what": "run (3 kg)",
         "value": 1, "max": 0, "unit": "1", "passed": False},
    ]  # fmt: skip
    verdict = {"passed": False, "verdict": "rejected", "rows": rows}
    (made.path / "verdict.json").write_text(json.dumps(verdict), "utf-8")
    return made.path


def under_loads() -> Figure:
    """As a study of loads draws them, in the order of the spec."""
    told = [Curve(name, ("0 kg",), (1.0,), "bars") for name in ("unaware", "declared")]
    models = [Curve(name, ("0 kg",), (1.0,), "bars") for name in NAMES]
    panels = (Panel(NAMES[0], "", "", tuple(told)), Panel("J1", "", "", tuple(models)))
    return Figure("fig", "Errors under loads", "", panels)


def looks_of(panel: Panel) -> dict[str, tuple[str, str]]:
    drawn = [(one.name, one.look) for one in panel.curves if one.style == "bars"]
    return {name: (look.colour, look.pattern) for name, look in drawn if look}


@pytest.mark.thorough
def test_models_stand_in_the_order_of_the_spec_everywhere(run: Path) -> None:
    page = run_page(run)
    assert [s.title for s in page.sections if s.id.startswith("model-")] == [
        f"Model {name}" for name in NAMES
    ]
    table, _, plots = page.sections[0].blocks
    assert [row[0].text for row in table.rows] == list(NAMES)  # type: ignore[union-attr]
    assert list(looks_of(plots.panels[0])) == list(NAMES)  # type: ignore[union-attr]


def test_a_model_looks_the_same_in_every_figure_and_nothing_else_does(run: Path) -> None:
    facts = read_facts(run)
    models = looks_of(error_per_joint(facts.listed_fits).panels[0])
    (_, part) = study_sections([result(under_loads())], [fit.name for fit in facts.listed_fits])
    (plots,) = (block for block in part.blocks if block.kind == "figure")
    told, joint = map(looks_of, plots.panels)
    assert joint == models
    assert not {colour for colour, _ in told.values()} & {c for c, _ in models.values()}


def test_a_study_of_no_model_of_the_page_looks_as_ever() -> None:
    figure = Figure("f", "", "", (Panel("", "", "", (Curve("measured", (1.0,), (1.0,)),)),))
    (_, part) = study_sections([result(figure)], NAMES)
    (plots,) = (block for block in part.blocks if block.kind == "figure")
    assert plots == dressed(figure, 1200)


def test_criteria_under_loads_are_shown_and_count_in_the_verdict_of_their_model(run: Path) -> None:
    facts = read_facts(run)
    table = criteria_under_loads(facts.listed_fits)
    assert table is not None
    assert [[cell.text for cell in row] for row in table.rows] == [
        ["error under a load relative to the first load", "rigid-wls", "5 kg load (worst)",
         "1.42", "1.50", "passed"],
        ["declared loads contradicted", "rigid-wls", "all loads; wrong: 3 kg", "1", "0",
         "missed"],
    ]  # fmt: skip
    comparison = run_page(run).sections[0].blocks[0]
    assert [row[-1].text for row in comparison.rows] == [  # type: ignore[union-attr]
        "rejected, 1 of 2 criteria missed",
        "for comparison",
        "for comparison",
    ]


def facts_with(run: Path, *masses: float) -> RunFacts:
    facts = read_facts(run)
    return replace(facts, plan=facts.plan | {"loads": [{"mass_kg": mass} for mass in masses]})


def test_loads_are_named_by_their_mass(run: Path) -> None:
    assert load_name(facts_with(run, 0.0, 1.0, 3.0), 2) == "3 kg"
    assert load_name(facts_with(run, 0.0, 3.0, 3.0), 2) == "3 kg (load 2)"
    assert [load_name(facts_with(run, 0.0), load) for load in (1, "x", None)] == [
        "load 1",
        "load x",
        "load None",
    ]


def test_what_was_weighed_is_told_by_mass(run: Path) -> None:
    event = {"kind": "weighing", "load": 2, "result": "waived", "problem": "load 2: too light"}
    facts = replace(facts_with(run, 0.0, 1.0, 3.0), events=[event])
    assert weighings(facts) == {"3 kg": "too light"}
    assert weighing_warnings(facts) == [
        "The payload check failed, and the failure was waived: 3 kg: too light."
    ]
    (table,) = timeline(facts).blocks
    assert "load: 3 kg" in table.rows[0][2].text  # type: ignore[union-attr]


def test_the_contents_have_one_entry_for_a_study_and_none_is_cut(run: Path) -> None:
    study = replace(result(), title="Under loads: rigid-wls and others, models of this run")
    other = replace(study, parameters={"estimators": ["rigid-lmi"]})
    sections = study_sections([study, other])
    assert [s.entry for s in sections if s.entry] == [
        "Study: Under loads (1)",
        "Study: Under loads (rigid-lmi)",
    ]
    assert study_sections([study])[0].entry == "Study: Under loads"
    page = Page(page_html(replace(run_page(run), sections=tuple(study_sections([study])))))
    assert [load for load in page.loads if load.startswith("#study")] == ["#study-1"]


def test_studies_of_one_title_say_of_which_models_they_are() -> None:
    stored = {"models": ["fit/rigid-wls-0123", "fit/rigid-irls-4567"], "estimators": []}
    fresh = {"models": [], "estimators": ["rigid-lmi", {"estimator": "rigid-wls", "loss": "huber"}]}
    sections = study_sections([replace(result(), parameters=one) for one in (stored, fresh)])
    assert [s.title for s in sections if s.title.startswith("Study")] == [
        "Study: A study (of rigid-wls, rigid-irls)",
        "Study: A study (of rigid-lmi, rigid-wls)",
    ]


def test_an_honest_protocol_is_explained_in_a_line() -> None:
    assert study_sections([result()])[1].lead == HONEST_MEANS


def test_long_tables_come_after_the_figures() -> None:
    def table(rows: int) -> Table:
        return Table(f"t{rows}", "", ("a", "b"), tuple((str(i), 1.0) for i in range(rows)))

    (_, part) = study_sections([result(under_loads(), tables=(table(45), table(3)))])
    kinds = [(block.kind, len(getattr(block, "rows", ()))) for block in part.blocks]
    assert kinds == [("paragraphs", 0), ("table", 3), ("figure", 0), ("table", 45)]


def test_a_table_may_ask_for_its_decimals() -> None:
    rows = (("a", 5.037312, -0.0001), ("b", 3.0, float("nan")))
    table = Table("t", "", ("", "x", "y"), rows, decimals=3)
    assert columns_of(table)[1:] == [["5.037", "3.000"], ["0.000", "–"]]


def test_settings_are_said_in_words_and_those_not_set_are_left_out() -> None:
    assert [_setting(value) for value in (True, None, 0.01)] == ["yes", None, "0.01"]
    assert _setting({"order": 5, "rate_hz": None}) == "order 5"


# What `hil show` and the report say about the weighing of loads


FIRST_LOAD = {"load": 0, "result": "first"}
PASSED = {"load": 1, "result": "passed", "declared_kg": 3.0, "weighed_kg": 3.0654}
PASSED |= {"deviation_kg": 0.0979, "limit_kg": 0.45}
FAILED = PASSED | {
    "result": "failed",
    "weighed_kg": 1.0996,
    "problem": "load 1: 3.00 kg declared, 1.10 ± 0.10 kg weighed against the 0.00 kg of load 0 "
    "(limit ± 0.45 kg)\n  shoulder_lift_joint: 22.7 N·m declared, 8.1 N·m weighed",
}
SKIPPED = {"result": "skipped", "reason": "the robot's drive gains are not known"}


def told(tmp_path: Path, *events: dict[str, Any]) -> str:
    run = write_run(tmp_path, fourier_plan())
    with run.event_log() as log:
        for event in events:
            log.append("weighing", **event)
    return " ".join(" ".join(summary_lines(run.path)).split())


def test_the_page_shows_it_too(tmp_path: Path) -> None:
    told(tmp_path, FIRST_LOAD, PASSED)
    (run,) = tmp_path.rglob("start.json")
    page = render_report(run.parent).read_text("utf-8")
    assert "3.00 kg declared, 3.07 ± 0.10 kg measured" in page


def test_a_load_that_was_weighed_is_shown_with_both_masses(tmp_path: Path) -> None:
    text = told(tmp_path, FIRST_LOAD, PASSED)
    assert "weighed load 1: 3.00 kg declared, 3.07 ± 0.10 kg measured" in text
    assert "Warning" not in text


def test_a_load_that_was_weighed_again_is_shown_as_it_was_weighed_last(tmp_path: Path) -> None:
    text = told(tmp_path, FIRST_LOAD, FAILED, FIRST_LOAD, PASSED)
    assert "3.07 ± 0.10 kg" in text
    assert "1.10 ± 0.10 kg" not in text


def test_a_first_load_that_could_not_be_weighed_at_first_is_told_no_more(tmp_path: Path) -> None:
    failed = {"load": 0, "result": "failed", "problem": "load 0 could not be weighed: no effort"}
    text = told(tmp_path, failed, FIRST_LOAD, PASSED)
    assert "could not be weighed" not in text
    assert "3.07 ± 0.10 kg" in text


def test_a_waived_weighing_is_a_warning(tmp_path: Path) -> None:
    text = told(tmp_path, FIRST_LOAD, FAILED | {"result": "waived"})
    warning = text.split("Warning: ")[1]
    assert "was waived: load 1: 3.00 kg declared, 1.10 ± 0.10 kg weighed" in warning
    assert "shoulder_lift_joint" not in warning


def test_a_weighing_that_cannot_tell_is_a_warning(tmp_path: Path) -> None:
    problem = "load 1: 0.10 kg declared, 0.00 ± 0.01 kg weighed"
    doubtful = PASSED | {"result": "inconclusive", "problem": problem}
    text = told(tmp_path, FIRST_LOAD, doubtful)
    sentence = f"The weighing cannot determine which load is mounted: {problem}."
    assert sentence in text.split("Warning: ")[1]
    (run,) = tmp_path.rglob("start.json")
    assert sentence in render_report(run.parent).read_text("utf-8")


def test_loads_that_were_not_weighed_have_a_reason(tmp_path: Path) -> None:
    assert "weighed loads: not weighed: the robot's drive gains are not known" in told(
        tmp_path, SKIPPED
    )


def test_a_run_without_a_sweep_says_nothing_of_it(tmp_path: Path) -> None:
    assert "weighed" not in told(tmp_path)


@pytest.mark.parametrize("event", [{"result": "passed"}, {"result": "failed"}, {"load": "x"}, {}])
def test_a_damaged_event_breaks_nothing(tmp_path: Path, event: dict[str, Any]) -> None:
    told(tmp_path, event)


# Learning curves on a page: what is drawn, and what a damaged model file does to it


def trained(validation: tuple[float, ...] = (0.5, 0.2, 0.3)) -> Curves:
    curves = Curves(1.0)
    for epoch, error in enumerate(validation, start=1):
        stage = "joint" if epoch < 3 else "dynamics"
        curves.add(Told(stage, epoch, len(validation), 2 * error, error, 0.0, 1e-3))
    return curves


def fit_with(curves: Any) -> FitFacts:
    held_out = {"joint_names": ["J1"], "unit": "N·m", "total": {"rmse_raw": [1.0]}}
    model = {"fitted": {"curves": curves, "samples": 9}}
    return FitFacts(Path("fit/net-1"), "net", "net", {"held_out": held_out}, model)


def learning_plots(fit: FitFacts) -> Figure | None:
    return learning_curves(ModelView(fit, Predictions(None, None)))


def test_the_curve_begins_with_the_untrained_network_and_marks_what_was_kept() -> None:
    loss, validation, kept = learning_panel(trained()).curves
    assert np.array_equal(loss.y, [1.0, 0.4, 0.6])
    assert np.array_equal(validation.x, [0, 1, 2, 3])
    assert np.array_equal(validation.y, [1.0, 0.5, 0.2, 0.3])
    assert (kept.x[0], kept.y[0]) == (2.0, 0.2)


def test_a_dotted_line_stands_between_stages() -> None:
    (mark,) = learning_panel(trained()).marks
    assert mark.x == 2.5


def test_colours_are_of_the_palette_and_axes_have_titles() -> None:
    figure = plotly_of(learning_panel(trained()))
    assert set(re.findall(r"#[0-9A-Fa-f]{6}", figure_json(figure))) <= set(colours.DARK)
    assert figure["layout"]["yaxis"]["title"]["text"].endswith("[1]")


def test_words_say_which_epoch_was_kept_and_how_long_stages_were() -> None:
    plots = learning_plots(fit_with(trained().to_dict()))
    assert plots is not None
    assert "weights of epoch 2 of 3" in plots.caption
    assert "joint: 2; dynamics: 1" in plots.caption


def test_a_training_that_made_things_worse_says_so() -> None:
    plots = learning_plots(fit_with(trained((2.0, 3.0)).to_dict()))
    assert plots is not None
    assert "none of 2 epochs was better" in plots.caption


def test_the_section_of_a_model_shows_them_and_other_models_have_none() -> None:
    titles = [
        [getattr(block, "title", "") for block in model_sections([fit], {})[1].blocks]
        for fit in (fit_with(trained().to_dict()), fit_with(None))
    ]
    assert "Learning curves" in titles[0]
    assert "Learning curves" not in titles[1]


@pytest.mark.parametrize(
    "damage",
    [
        [],
        "curves",
        {"stages": [["joint", 10**15], ["dynamics", 1]]},
        {"stages": [["joint", -1], ["dynamics", 4]]},
        {"loss": [1.0, None, 2.0]},
        {"validation": [1.0]},
        {"untrained": float("inf")},
    ],
)
def test_damaged_curves_leave_the_page_without_them(damage: Any) -> None:
    whole = json.loads(json.dumps(trained().to_dict()))
    told = whole | damage if isinstance(damage, dict) else damage
    assert learning_plots(fit_with(told)) is None
