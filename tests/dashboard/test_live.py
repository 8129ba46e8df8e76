"""Live runs in the dashboard: what is shown and asked, on a real run in another process."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from hil.dashboard.server import create_app
from hil.dashboard.settings import Settings
from hil.recording.events import read_events
from hil.recording.run_directory import RunDirectory
from hil.workflow.live_state import read_live
from tests.support.started_parts import PROMPT, begun
from tests.support.waiting import until

pytestmark = pytest.mark.wire

PAGE = {"accept": "text/html"}


def visitor(folder: Path, **more: Any) -> tuple[TestClient, str]:
    """A browser at the dashboard of a folder, and the value that its forms show."""
    settings = Settings(folder / "runs", folder / "registry", specs=folder, port=8350, **more)
    app = create_app(settings)
    client = TestClient(app, base_url="http://127.0.0.1:8350", follow_redirects=False)
    return client, settings.csrf


def state(run: Path) -> str:
    return str(read_live(run).get("state"))


def outcome(run: Path) -> str:
    return str((RunDirectory(run).stop or {}).get("outcome", ""))


def sent(text: str) -> list[tuple[str, dict[str, Any]]]:
    """Kinds and documents of a stream of events."""
    found = re.findall(r"event: (\w+)\r?\ndata: (.*?)\r?\n\r?\n", text)
    return [(kind, json.loads(data)) for kind, data in found]


def test_a_run_is_answered_paused_resumed_and_stopped_without_any_script(tmp_path: Path) -> None:
    with begun(tmp_path) as (started, run):
        until(lambda: read_live(run).get("prompt") == PROMPT)
        browser, csrf = visitor(tmp_path)
        where = f"/runs/{run.relative_to(tmp_path / 'runs')}"

        def post(what: str, **fields: str) -> Any:
            return browser.post(f"{where}/{what}", data={"csrf": csrf, **fields}, headers=PAGE)

        asking = browser.get(where, headers=PAGE).text
        assert re.search(rf'data-text="prompt">{PROMPT}<', asking)
        assert "waiting for an answer" in browser.get("/").text
        refused = post("answer", answer="yes", prompt="Mount the 3 kg cylinder")
        assert refused.status_code == 404
        assert "asks something else" in refused.text
        assert post("answer", answer="yes", prompt=PROMPT).headers["location"] == where
        until(lambda: read_live(run).get("doing") == "warmup")
        moving = browser.get(where, headers=PAGE).text
        assert re.search(r'data-text="q\.0">-?\d+\.\d\d<', moving)
        assert re.search(r'data-value="margin\.clearance"', moving)
        assert re.search(r'data-shown="question" hidden', moving)
        post("pause")
        until(lambda: state(run) == "paused", 30)
        post("resume")
        until(lambda: state(run) == "running")

        asked = time.monotonic()
        answer = post("stop")
        until(lambda: outcome(run), 10)
        assert time.monotonic() - asked < 2.0  # alone on a computer 0.4 s
        assert (answer.status_code, answer.headers["location"]) == (303, where)
        assert outcome(run) == "stopped"
        until(lambda: not started.alive, 20)
        controls = [e for e in read_events(run / "events.jsonl") if e["kind"] == "control"]
        assert [event["what"] for event in controls] == ["answer", "pause", "resume", "stop"]
        assert {event["who"].rpartition(" ")[2] for event in controls} == {"(dashboard)"}
        assert "stopped early" in browser.get(where, headers=PAGE).text
        over = browser.post(f"{where}/stop", data={"csrf": csrf})  # as the page's script asks
        assert over.status_code == 404
        assert "not live" in over.text
        again = post("stop")  # without scripts, or once more by them: shown is how it ended
        assert (again.status_code, again.headers["location"]) == (303, where)


def test_changes_are_sent_as_they_come_and_the_end_is_the_last(tmp_path: Path) -> None:
    with begun(tmp_path) as (_, run):
        until(lambda: read_live(run).get("prompt"))
        browser, csrf = visitor(tmp_path)
        where = f"/runs/{run.relative_to(tmp_path / 'runs')}"
        said = browser.post(
            f"{where}/answer", data={"csrf": csrf, "answer": "no", "prompt": PROMPT}
        )
        assert said.json()["asked"] == "answer"
        told = sent(browser.get(f"{where}/events?after=0").text)  # ends with the run
        assert next(kind for kind, _ in told) == "live"  # what every page shows comes along
        stream = [(kind, now) for kind, now in told if kind in ("run", "over")]
        kinds = [kind for kind, _ in stream]
        assert kinds[-1] == "over"
        assert set(kinds[:-1]) <= {"run"}
        assert stream[-1][1]["texts"]["headline"].startswith("stopped: ")
        assert "answered no" in stream[-1][1]["texts"]["headline"]
        lines = [line["n"] for _, now in stream for line in now["log"]]
        assert lines == list(range(1, len(lines) + 1))  # every one once, in order
        again = sent(browser.get(f"{where}/events?after={lines[-1]}").text)
        assert [(kind, now["log"]) for kind, now in again if kind in ("run", "over")] == [
            ("over", [])
        ]
