"""Whatever the files of a run say, every page is there, and so is Stop."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')

from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.lock_file import hold_run
from hil.recording.run_directory import RunDirectory
from hil.runs.catalogue import find_runs
from tests.support.catalogue_runs import close_folders
from tests.support.recorded import run_in
from tests.support.web_parts import dashboard, failing, seen

DEEP = '{"a": ' * 900 + "1" + "}" * 900
WHOLE = ["{}", "[]", '"x"', "1e999", DEEP, ""]
VALUES = [[1e999], {"a": [1e999]}, "x", 1e999, 10**400, None, True, -1, [[]], [{}, 3, "x", None]]
DOCUMENTS = ["start.json", "stop.json", "verdict.json", "plan.json", "preflight.json",
             "spec.yaml", "station.yaml", "events.jsonl", "fit/*/*.json",
             "study/*/*.json"]  # fmt: skip


@pytest.fixture
def lab(dwell_lab: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(dwell_lab, tmp_path / "lab"))


def documents(run: Path) -> Iterator[Path]:
    for pattern in DOCUMENTS:
        yield from run.glob(pattern)


def require_all_is_there(lab: Path) -> None:
    """Pages of the overview, the catalogue, the run; and `hil runs` lists it."""
    run, client = run_in(lab), dashboard(lab)
    for address in ("/", "/runs", f"/runs/{run.relative_to(lab / 'runs')}", "/start"):
        seen(client, address)
    for query in ([], ["number>0"]):
        said = CliRunner().invoke(app, ["runs", *query, "--runs", str(lab / "runs"), "--json"])
        assert said.exit_code == 0, said.output
        (entry,) = json.loads(said.output, parse_constant=lambda name: pytest.fail(name))
        assert Path(entry["run"]) == run
    assert CliRunner().invoke(app, ["runs", "--runs", str(lab / "runs")]).exit_code == 0


@pytest.mark.thorough
@pytest.mark.parametrize("content", WHOLE, ids=lambda text: text[:6] or "empty")
def test_documents_of_another_kind_break_no_page(lab: Path, content: str) -> None:
    for file in documents(run_in(lab)):
        kept = file.read_bytes()
        file.write_text(content)
        require_all_is_there(lab)
        file.write_bytes(kept)


@pytest.mark.thorough
@pytest.mark.parametrize("value", VALUES, ids=lambda value: str(value)[:12])
def test_values_of_another_kind_break_no_page(lab: Path, value: object) -> None:
    for file in run_in(lab).rglob("*.json"):
        kept = file.read_bytes()
        told = json.loads(kept)
        odd = {key: told[key] if key[:4] == "hil_" else value for key in told}
        if file.name == "stop.json":
            odd["outcome"] = "completed"  # else nothing but that is looked at
        file.write_text(json.dumps(odd))
        require_all_is_there(lab)
        file.write_bytes(kept)


@pytest.mark.thorough
@pytest.mark.parametrize("key", ["device_s", "samples", "reason", "problems", "stopped"])
def test_a_number_that_is_none_says_nothing(lab: Path, key: str) -> None:
    stop = run_in(lab) / "stop.json"
    stop.write_text(json.dumps(json.loads(stop.read_text()) | {key: [1]}))
    require_all_is_there(lab)
    (entry,) = find_runs(runs=lab / "runs")
    assert entry["status"] == "completed"
    if key == "device_s":
        assert entry["duration_s"] is None


@pytest.mark.thorough
@pytest.mark.parametrize("value", VALUES, ids=lambda value: str(value)[:12])
def test_a_live_run_can_be_stopped_whatever_its_view_says(tmp_path: Path, value: object) -> None:
    run = RunDirectory.create(tmp_path / "runs", "ur5", "held")
    arm = {"q_rad": value, "effort": [value], "joints": [value, value], "moving": value}
    keys = ("step", "steps", "prompt", "state", "device_s", "duration_s", "t", "reason", "stage")
    margin = {"name": value, "share": value, "value": value, "limit": value, "unit": value}
    odd = dict.fromkeys(keys, value) | {"arm": arm, "interlocks": [margin, value]}
    with hold_run(run.path):
        run.write_start({"uid": "u"})
        where = f"/runs/{run.path.relative_to(tmp_path / 'runs')}"
        for view in (odd, odd | {"arm": value, "interlocks": value}, {"prompt": value}):
            (run.path / ".live.json").write_text(json.dumps(view))
            for address in ("/", "/runs", where, "/start"):
                answer = dashboard(tmp_path).get(address)
                assert answer.status_code == 200
                assert f'action="{where}/stop"' in answer.text
        assert f'action="{where}/stop"' in seen(dashboard(tmp_path), "/no", status=404)


def test_a_header_that_fails_is_a_name_and_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = failing(TypeError("odd"))
    monkeypatch.setattr("hil.dashboard.live_runs.header_of", broken)
    run = RunDirectory.create(tmp_path / "runs", "ur5", "held")
    with hold_run(run.path):
        html = seen(dashboard(tmp_path), "/")
    assert "cannot be read" in html
    assert html.count(f'action="/runs/{run.path.relative_to(tmp_path / "runs")}/stop"') == 1


def test_an_error_is_told_even_where_no_page_can_be_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = failing(PermissionError(13, "Permission denied", "/lab/<b>runs"))
    monkeypatch.setattr("hil.dashboard.rendering.live_headers", broken)
    answer = dashboard(tmp_path).get("/")
    assert answer.status_code == 500
    assert "/lab/&lt;b&gt;runs: Permission denied" in answer.text
    assert "<h1>" in answer.text
    assert dashboard(tmp_path).get("/no").status_code == 404


def test_a_run_that_cannot_be_understood_is_damaged_with_the_reason(
    lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = failing(TypeError("odd <b>"))
    monkeypatch.setattr("hil.runs.listing._from_documents", broken)
    monkeypatch.setattr("hil.dashboard.run_page._facts", broken)
    require_all_is_there(lab)
    (entry,) = find_runs(runs=lab / "runs")
    assert (entry["status"], entry["samples"]) == ("damaged", None)
    assert "TypeError: odd <b>" in entry["problem"]
    html = seen(dashboard(lab), f"/runs/{run_in(lab).relative_to(lab / 'runs')}")
    assert "TypeError: odd &lt;b&gt;" in html
    assert "00.mcap" in html


def test_a_run_of_another_user_that_may_not_be_entered_keeps_no_page_from_the_others(
    lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_in(lab)
    shutil.copytree(run, closed := run.with_name("0002-closed"))
    close_folders(monkeypatch, closed)
    for address in ("/", "/runs", f"/runs/{run.relative_to(lab / 'runs')}"):
        seen(dashboard(lab), address)
