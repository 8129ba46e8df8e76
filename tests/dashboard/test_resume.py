"""Going on with a run from its page: where it is offered, what is started, what is refused."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.testclient import TestClient

from hil.core.errors import DataError
from hil.core.lock_file import hold_run
from hil.dashboard.server import create_app
from hil.dashboard.settings import Settings
from hil.recording.run_directory import RunDirectory
from hil.workflow.background_runs import Started, go_on_with, started_runs
from hil.workflow.live_state import read_live
from hil.workflow.remote_control import answer_run
from tests.support.started_parts import PROMPT, SPEC, WALL, begun
from tests.support.waiting import until
from tests.support.web_parts import dashboard, plain, seen

PAGE = {"accept": "text/html"}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """One that was stopped before it measured anything, as far as documents say."""
    directory = RunDirectory.create(tmp_path / "runs", "ur5", "stopped")
    directory.write_start({"uid": "u"})
    directory.write_text("spec.yaml", SPEC)
    directory.write_text("station.yaml", WALL)
    directory.write_text("plan.json", "{}")
    directory.write_stop("stopped", "lunch")
    return directory.path.resolve()


def address(run: Path) -> str:
    return "/runs/" + "/".join(run.parts[-3:])


def asked(run: Path, **fields: str) -> Any:
    settings = Settings(run.parents[2], run.parents[2] / "registry", port=8350)
    app = create_app(settings)
    browser = TestClient(app, base_url="http://127.0.0.1:8350", follow_redirects=False)
    given = {"csrf": settings.csrf, "operator": "anna"} | fields
    return browser.post(f"{address(run)}/go-on", data=given, headers=PAGE)


class Starts:
    """In place of `go_on_with`: notes what would be started."""

    def __init__(self) -> None:
        self.what: list[tuple[Path, str]] = []

    def __call__(self, run: Path, runs: Path, *, operator: str, confirmed: object) -> Any:
        assert confirmed is None
        self.what.append((run, operator))
        return SimpleNamespace(id=str(len(self.what)))


@pytest.fixture
def starts(monkeypatch: pytest.MonkeyPatch) -> Iterator[Starts]:
    made = Starts()
    monkeypatch.setattr("hil.dashboard.run_page.go_on_with", made)
    return made


def test_it_is_offered_where_hil_resume_would_go_on(run: Path) -> None:
    client = dashboard(run.parents[3])
    html = seen(client, address(run))
    assert f'action="{address(run)}/go-on"' in html
    assert "The arm moves" in html


@pytest.mark.parametrize("why", ["commissioning", "passive", "completed", "no plan", "read-only"])
def test_it_is_not_offered_where_it_would_be_refused(run: Path, why: str) -> None:
    if why in ("commissioning", "passive"):
        (run / "start.json").write_text(json.dumps({"hil_run": 1, "uid": "u", why: {"speed": 0.1}}))
    elif why == "completed":
        (run / "stop.json").write_text(json.dumps({"hil_run": 1, "outcome": "completed"}))
    elif why == "no plan":
        (run / "plan.json").unlink()
    html = seen(dashboard(run.parents[3], read_only=why == "read-only"), address(run))
    assert "/go-on" not in html
    if why != "read-only":
        with pytest.raises(DataError):
            go_on_with(run, run.parents[2])
        assert started_runs(run.parents[2]) == []


def test_a_double_click_starts_one_attempt(run: Path, starts: Starts) -> None:
    with ThreadPoolExecutor(2) as both:
        answers = list(both.map(lambda _: asked(run, once="x"), range(2)))
    assert [each.headers["location"] for each in answers] == ["/start/1"] * 2
    assert starts.what == [(run, "anna")]


def test_only_forms_of_our_own_and_names_that_are_text_start_anything(
    run: Path, starts: Starts
) -> None:
    assert asked(run, csrf="guessed").status_code == 403
    assert asked(run, operator="an\0na").status_code == 422
    settings = Settings(run.parents[2], run, port=8350, read_only=True)
    reader = TestClient(create_app(settings), base_url="http://127.0.0.1:8350")
    form = {"csrf": settings.csrf}
    assert reader.post(f"{address(run)}/go-on", data=form).status_code == 403
    assert starts.what == []


def test_a_live_run_is_not_begun_again(run: Path) -> None:
    with hold_run(run):
        answer = asked(run)
        assert answer.status_code == 404
        assert "goes on already" in plain(answer.text)
    assert started_runs(run.parents[2]) == []


def test_resume_of_a_live_page_that_is_too_late_moves_no_arm(run: Path, starts: Starts) -> None:
    client = dashboard(run.parents[3])
    (form,) = re.findall(r'name="csrf" content="([^"]+)"', seen(client, "/"))
    answer = client.post(f"{address(run)}/resume", data={"csrf": form})
    assert "not live" in answer.text
    assert starts.what == []


def test_a_record_that_names_a_folder_elsewhere_goes_on_with_nothing(tmp_path: Path) -> None:
    said = Started("x", str(tmp_path / "runs"), "/etc", "", "", 1, 1, 0.0, "h")
    assert said.again is None


@pytest.mark.wire
def test_a_stopped_run_goes_on_and_asks_again(tmp_path: Path) -> None:
    with begun(tmp_path, wall=False) as (first, run):
        until(lambda: read_live(run).get("prompt") == PROMPT)
        first.cancel()
        until(lambda: not first.alive, 20)
    where = asked(run.resolve()).headers["location"]
    (again, _) = started_runs(tmp_path / "runs")
    client = dashboard(tmp_path)
    try:
        assert again.again == run.resolve()
        if not again.made:
            assert f'href="{where}"' in seen(client, address(run))
        until(lambda: again.made, 30)
        until(lambda: read_live(run).get("prompt") == PROMPT)
        assert client.get(where, follow_redirects=False).headers["location"] == address(run)
        answer_run(run, True, who="bert")
        until(lambda: not again.alive, 40)
        directory = RunDirectory.open(run)
        assert (directory.status, directory.attempts) == ("completed", 2)
        assert json.loads((run / "resume-01.json").read_text())["operator"] == "anna"
    finally:
        again.cancel()
        until(lambda: not again.alive, 20)
