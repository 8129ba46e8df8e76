"""Run directories with damaged files: every view of them is a view or a clear error."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from hil import api
from hil.cli.app import app
from hil.core.errors import DataError, HilError
from hil.core.yaml import parse
from hil.engine.preflight import CheckResult
from hil.importers.sources import gravity_of, load_source, serial_of
from hil.recording import Attachment, McapWriter, RunDirectory, read_events
from hil.report import render_report, summary_lines
from hil.report.run_facts import read_facts
from hil.robot.state import state_topic
from hil.spec import load_spec, spec_hash
from hil.workflow.judging import judge_run
from hil.workflow.resuming import open_unfinished
from tests.support.fuzzing import ANYTHING, damaged, examples, quick_folder
from tests.support.paths import ROOT
from tests.support.report_runs import dwell_plan, rows_of_plan, write_run

EVENTS = "events.jsonl"
RUN = "2026-11-21/ur5/0001-fuzz"


@cache
def whole_run() -> Mapping[str, bytes]:
    """The files of a small run that was resumed once, fitted and judged, by their names."""
    plan = dwell_plan(poses=14)
    with quick_folder() as root:
        run = write_run(root, plan, accept="{nrmse: {max: 0.5}}")
        run.write_text("station.yaml", (ROOT / "experiments/stations/mock.yaml").read_text("utf-8"))
        check = CheckResult("disk", True, "room for 100 hours", 1e12, 1e9).to_dict()
        run.write_json("preflight.json", {"passed": True, "checks": [check]})
        spec = load_spec(run.path / "spec.yaml")
        judge_run(run, spec, {"samples": 100, "missing": 0})
        start = run.start | {"spec_hash": spec_hash(spec)}
        (run.path / "start.json").write_bytes(as_json(start))
        run.write_resume(1, {"resumed": "2026-11-21T00:00:00+00:00", "steps": [1, 2]})
        with run.event_log() as log:
            log.append("resumed", attempt=1)
            log.append("dwell", step=3, settled=False)
            log.append("prompt", text="Mount it", answered_by="operator")
        run.write_stop("completed", "", {"samples": 10, "steps_done": len(plan)}, attempt=1)
        (run.path / "recording" / "01.mcap.partial").write_bytes(torn_recording(run))
        files = (path for path in run.path.rglob("*") if path.is_file())
        return {path.relative_to(run.path).as_posix(): path.read_bytes() for path in files}


def torn_recording(run: RunDirectory) -> bytes:
    content = (run.path / "recording" / "00.mcap").read_bytes()
    return content[: len(content) * 3 // 4]


DOCUMENTS = (
    "start.json",
    "stop.json",
    "stop-01.json",
    "resume-01.json",
    "plan.json",
    "preflight.json",
    "verdict.json",
    "evaluation.json",
    "model.json",
)


def quick_run(folder: Path, changed: Mapping[str, bytes | None]) -> Path:
    """The run with some files changed, or left out where None."""
    run = folder / RUN
    for name, content in {**whole_run(), **changed}.items():
        path = run / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if content is not None:
            path.write_bytes(content)
    return run


def names_of(document: str) -> str:
    return next(name for name in whole_run() if name.endswith(document))


def as_json(document: Any) -> bytes:
    return json.dumps(document).encode()


def views(root: Path, run: Path) -> Iterator[Callable[[], Any]]:
    """Everything that looks at a run without writing anything."""
    yield lambda: api.describe_run(run)
    yield lambda: summary_lines(run)
    yield lambda: read_facts(run)
    yield lambda: load_source(run)
    yield lambda: (serial_of(run), gravity_of(run))
    yield lambda: RunDirectory.open(run).verify()
    yield lambda: open_unfinished(run)


def assert_viewable(root: Path, run: Path) -> None:
    """The catalogue lists the run whatever it holds; all other views may refuse it."""
    assert [entry["run"] for entry in api.list_runs(root)] == [str(run)]
    for view in views(root, run):
        assert refusal_of(view) != ""


def refusal_of(call: Callable[[], Any]) -> str | None:
    """What a HilError says; None where there is none."""
    try:
        call()
    except HilError as refusal:
        return str(refusal).strip()
    return None


def test_the_run_that_is_damaged_here_was_whole() -> None:
    with quick_folder() as root:
        run = quick_run(root, {})
        for view in views(root, run):
            refusal = refusal_of(view)
            assert refusal is None or "is complete (28/28 dwells, 6/6 references)" in refusal
        assert api.list_runs(root)[0]["status"] == "completed"


@pytest.mark.thorough
@pytest.mark.parametrize("name", DOCUMENTS)
@examples(8)
@given(data=st.data())
def test_damaged_document(name: str, data: st.DataObject) -> None:
    file = names_of(name)
    document = data.draw(damaged([json.loads(whole_run()[file])]))
    with quick_folder() as root:
        assert_viewable(root, quick_run(root, {file: as_json(document)}))


@examples(12)
@given(data=st.data())
def test_several_documents_damaged_or_missing(data: st.DataObject) -> None:
    changed: dict[str, bytes | None] = {}
    for name in data.draw(st.sets(st.sampled_from(DOCUMENTS), min_size=1, max_size=4)):
        file = names_of(name)
        whole = json.loads(whole_run()[file])
        contents = st.none() | st.binary(max_size=40) | (ANYTHING | damaged([whole])).map(as_json)
        changed[file] = data.draw(contents)
    with quick_folder() as root:
        run = quick_run(root, changed)
        if changed.get("start.json", b"") is None:
            run.joinpath("start.json").unlink(missing_ok=True)
            assert api.list_runs(root)
            return
        assert_viewable(root, run)


@pytest.mark.thorough
@examples(15)
@given(data=st.data())
def test_damaged_event_log(data: st.DataObject) -> None:
    lines = whole_run()[EVENTS].splitlines()
    events = [json.loads(line) for line in lines]
    spoilt = st.binary(max_size=30) | (ANYTHING | damaged(events)).map(as_json)
    drawn = data.draw(st.lists(st.sampled_from(lines) | spoilt, max_size=8))
    with quick_folder() as root:
        run = quick_run(root, {EVENTS: b"\n".join(drawn)})
        assert all(isinstance(event, dict) for event in read_events(run / EVENTS))
        assert_viewable(root, run)


@pytest.mark.thorough
@examples(12)
@given(data=st.data())
def test_damaged_spec_or_station_of_a_run(data: st.DataObject) -> None:
    import yaml

    name = data.draw(st.sampled_from(["spec.yaml", "station.yaml"]))
    document = data.draw(damaged([parse(whole_run()[name], "f").data]))
    text = yaml.safe_dump(document, allow_unicode=True).encode("utf-8", "surrogatepass")
    with quick_folder() as root:
        assert_viewable(root, quick_run(root, {name: text}))


@pytest.mark.thorough
@examples(12)
@given(data=st.data())
def test_damaged_recording(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(["recording/00.mcap", "recording/01.mcap.partial"]))
    content = bytearray(whole_run()[name])
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    with quick_folder() as root:
        assert_viewable(root, quick_run(root, {name: bytes(content)}))


@cache
def explained() -> Mapping[str, dict[str, Any]]:
    """What a recording carries: the documents of a run, and what an import says."""
    names = ("start.json", "plan.json")
    documents = {name: json.loads(whole_run()[name]) for name in names}
    robot = {
        "model": "ur5",
        "joint_names": ["a", "b", "c", "d", "e", "f"],
        "effort_kind": "current",
        "drive_gains": [10.0] * 6,
        "gravity_m_s2": [0.0, 0.0, -9.81],
        "serial": "S-1",
    }
    payload = {"mass_kg": 1.0, "com_m": [0.0, 0.0, 0.1], "inertia_kgm2": [0.0] * 6}
    return documents | {"robot": robot, "payload": payload, "payload of window 1": payload}


def as_texts(record: Any) -> dict[str, str]:
    """A metadata record: text is itself, everything else its JSON."""
    items = record.items() if isinstance(record, dict) else [("model", record)]
    return {k: v if isinstance(v, str) else json.dumps(v) for k, v in items}


@examples(20)
@given(data=st.data())
def test_recording_with_damaged_explanations(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(explained())))
    told = dict(explained())
    told[name] = data.draw(damaged([told[name]]) | ANYTHING)
    of_run = name.endswith(".json")
    attachments = [
        Attachment(key, "application/json", as_json(value))
        for key, value in told.items()
        if key.endswith(".json") and of_run
    ]
    metadata = {k: as_texts(v) for k, v in told.items() if not k.endswith(".json")}
    rows = rows_of_plan(dwell_plan(poses=1))
    with quick_folder() as folder:
        path = folder / "a.mcap"
        topic = state_topic(6, 125.0, clock="virtual", effort_unit="A")
        with McapWriter(path, [topic], attachments=attachments, metadata=metadata) as writer:
            writer.write(topic.name, rows)
        for view in (load_source, gravity_of, serial_of):
            assert refusal_of(lambda view=view: view(path)) != ""  # type: ignore[misc]


@examples(3)
@given(data=st.data())
def test_report_of_a_damaged_run(data: st.DataObject) -> None:
    changed = {}
    for name in data.draw(st.sets(st.sampled_from(DOCUMENTS), min_size=1, max_size=3)):
        file = names_of(name)
        changed[file] = as_json(data.draw(damaged([json.loads(whole_run()[file])])))
    with quick_folder() as root:
        run = quick_run(root, changed)
        assert refusal_of(lambda: render_report(run)) != ""


@pytest.mark.thorough
@examples(6)
@given(data=st.data())
def test_command_line_on_a_damaged_run(data: st.DataObject) -> None:
    file = names_of(data.draw(st.sampled_from(DOCUMENTS)))
    document = data.draw(damaged([json.loads(whole_run()[file])]))
    with quick_folder() as root:
        run = quick_run(root, {file: as_json(document)})
        for command in (["runs", "--runs", str(root)], ["show", str(run)]):
            for flags in ([], ["--json"]):
                done = CliRunner().invoke(app, [*command, *flags])
                error = done.exception
                assert error is None or isinstance(error, HilError | SystemExit), error
                if flags and error is None:
                    json.loads(done.output)


def test_documents_of_absurd_depth_and_size_are_refused() -> None:
    for content in (b"[" * 10**6, b'{"a":' * 10**5, b"9" * 10**6, b'{"hil_run": 1e999}'):
        with quick_folder() as root:
            run = quick_run(root, {"start.json": content})
            assert api.list_runs(root)[0]["status"] == "damaged"
            with pytest.raises(DataError):
                api.describe_run(run)


def test_an_event_log_of_astronomic_length_is_no_crash() -> None:
    document = json.loads(whole_run()["stop-01.json"]) | {"events_bytes": 2**63}
    with quick_folder() as root:
        assert_viewable(root, quick_run(root, {"stop-01.json": as_json(document)}))


def test_a_part_with_another_record_is_refused_and_named() -> None:
    name = "recording/01.mcap.partial"
    other = whole_run()[name].replace(b"int32 segment\n", b"int32 segmunt\n")
    assert other != whole_run()[name]
    with quick_folder() as root:
        run = quick_run(root, {name: other})
        refusal = refusal_of(lambda: open_unfinished(run)) or ""
        assert "01.mcap.partial: its /robot/state is not the base robot record" in refusal
        assert_viewable(root, run)


def test_a_part_of_an_arm_with_fewer_joints_is_refused_and_named() -> None:
    with quick_folder() as root:
        run = quick_run(root, {})
        topic = state_topic(2, 125.0, clock="host", effort_unit="A")
        with McapWriter(run / "recording" / "00.001.mcap", [topic], joint_names=["a", "b"]) as part:
            part.write(topic.name, np.zeros(3, topic.dtype))
        refusal = refusal_of(lambda: open_unfinished(run)) or ""
        assert "00.001.mcap is of an arm with 2 joints, the part before it of one with 6" in refusal
        assert_viewable(root, run)
