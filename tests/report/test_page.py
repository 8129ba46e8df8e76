"""The page of a run: complete, self-contained, harmless, and honest about how the run ended."""

import base64
import gzip
import json
import os
import shutil

import numpy as np
import pytest
from plotly.offline import get_plotlyjs

import hil
from hil.core.errors import DataError, RecordingError
from hil.importers.sources import load_source
from hil.report import render_fit_report, render_report, run_report
from hil.report.run_facts import read_facts
from hil.report.run_recording import dataset_of, read_recording
from hil.report.run_report import run_page
from hil.spec.load import load_spec
from hil.studies import Figure
from hil.workflow.judging import judge_run
from tests.support.report_html import Page, array_of
from tests.support.report_runs import JOINTS, dwell_plan, fourier_plan, rows_of_plan, write_run

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
    rows = table_of(dwell_page, "gravity and stick friction apart")
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
    assert "Plots of the models are left out" not in page.text
    assert "The plots of static-wls are left out" not in page.text
    assert table_of(page, "gravity and stick friction apart")


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
    assert any("1 held-out poses from both sides" in caption for caption in page.tables)


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
    (warning,) = [text for text in page.warnings if "left out" in text]
    assert warning.startswith("The plots of another are left out:")
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
    assert "it was judged on runs/0099-other, not on this recording" in warnings


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
        (None, "", "INTERRUPTED", "The run ended without saying why"),
        ("stopped", "stopped by the keyboard", "STOPPED", "stopped by the keyboard"),
        ("tripped", "interlock temperature: 81 °C", "TRIPPED", "An interlock stopped the robot"),
        ("failed", "the cable came off", "FAILED", "The run failed: the cable came off."),
        ("completed", "", "NOT JUDGED", "there is no fitted model in the run"),
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
    assert "00.mcap.partial was never finished" in page.text
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
    assert "The plots of rigid-wls are left out" in page.text
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
    assert any("least on held-out data: better" in caption for caption in page.tables)
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
