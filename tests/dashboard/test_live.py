"""Live runs in the dashboard: what is shown of them, streamed and asked."""

from __future__ import annotations

import asyncio
import html
import json
import os
import platform
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlencode

import numpy as np
import pytest
from starlette.requests import Request
from starlette.testclient import TestClient

from hil.core.errors import DataError
from hil.core.lock_file import hold_run
from hil.dashboard import live_runs, plan_preview, run_page, start_page
from hil.dashboard.limits import THREADS, StreamLimit
from hil.dashboard.live_runs import LiveRun, _SharedBar, header_of, live_headers, pending_starts
from hil.dashboard.run_page import resume_offer
from hil.dashboard.server import create_app
from hil.dashboard.settings import Settings
from hil.recording.events import read_events
from hil.recording.run_directory import RunDirectory
from hil.robot import Capabilities
from hil.runs import live_runs as known_runs
from hil.workflow.background_runs import FOLDER, Started, ticks_of
from hil.workflow.live_state import LIVE_FILE, ArmView, LiveState, read_live
from hil.workflow.remote_control import answer_run, question_of, waiting
from tests.support.interlock_parts import NAMES, made, rows
from tests.support.started_parts import PROMPT, begun
from tests.support.waiting import until

# Live runs in the dashboard: what is shown and asked, on a real run in another process


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


@pytest.mark.wire
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
        assert "now asks another question" in refused.text
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

        answer = post("stop")
        until(lambda: outcome(run))
        assert (answer.status_code, answer.headers["location"]) == (303, where)
        assert outcome(run) == "stopped"
        until(lambda: not started.alive, 20)
        controls = [e for e in read_events(run / "events.jsonl") if e["kind"] == "control"]
        assert [event["what"] for event in controls] == ["answer", "pause", "resume", "stop"]
        assert {event["who"].rpartition(" ")[2] for event in controls} == {"(dashboard)"}
        assert "stopped early" in browser.get(where, headers=PAGE).text
        over = browser.post(f"{where}/stop", data={"csrf": csrf})  # as the page's script asks
        assert over.status_code == 404
        assert "not active" in over.text
        again = post("stop")  # without scripts, or once more by them: shown is how it ended
        assert (again.status_code, again.headers["location"]) == (303, where)


@pytest.mark.wire
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


# Pages of what goes on: what they show of runs that this process holds


ROBOT = Capabilities(joint_names=NAMES, rate_hz=125.0, effort_kind="current")
PROGRESS: dict[str, Any] = {
    "kind": "progress", "step": 11, "steps": 50, "doing": "dwell", "pose": 5, "trajectory": -1,
    "device_s": 25.0, "wall_s": 25.0, "duration_s": 100.0, "samples": 3125, "state": "running",
    "gaps": 1, "missing": 2, "duplicates": 0, "overruns": 0, "behind_s": 0.1,
}  # fmt: skip


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(tmp_path / "runs", tmp_path / "registry", port=8350)


@pytest.fixture
def run(settings: Settings) -> Iterator[tuple[RunDirectory, LiveState]]:
    """A live run and its view."""
    directory = RunDirectory.create(settings.runs, "ur5", "held")
    with hold_run(directory.path):
        directory.write_start({"uid": "u"})
        yield (
            directory,
            LiveState(directory.path, ArmView(ROBOT, [made(kind="speed", limit_deg_s=90)])),
        )


def browser(settings: Settings) -> TestClient:
    return TestClient(create_app(settings), base_url="http://127.0.0.1:8350")


def moving(view: LiveState) -> None:
    view.notify({"kind": "state", "state": "running", "reason": ""})
    view.notify(PROGRESS)
    block = rows(1, moving=True, q=0.5, effort=1.5, temperature=np.nan, q_target=0.501)
    block["qd"][-1, 2] = np.pi / 4
    view.notify({"kind": "rows", "rows": block})


Run = tuple[RunDirectory, LiveState]


def test_the_page_says_what_the_events_will_say(settings: Settings, run: Run) -> None:
    directory, view = run
    asks = browser(settings)
    asks.get("/")  # loads what takes long: a view that is seconds old is silent
    moving(view)
    now = LiveRun(directory.path, settings).look()
    html = asks.get(now["address"], headers=PAGE).text
    shown = dict(re.findall(r'data-text="([^"]+)">([^<]*)<', html))
    assert shown == {key: now["texts"][key] for key in shown}
    assert set(now["texts"]) == set(shown)
    assert (shown["headline"], shown["percent"], shown["left"]) == (
        "running",
        "25 %",
        "1 min 15 s left",
    )
    assert shown["doing"] == "step 12/50 dwell, pose 5"
    assert shown["troubles"] == "1 gap (2 samples missing)"
    assert (shown["q.0"], shown["lag.0"], shown["qd.2"]) == ("28.65", "-0.057", "45.0")
    assert (shown["effort.5"], shown["temperature.5"]) == ("1.50", "–")
    assert shown["margin.speed"] == "j3: 45.0 °/s, limit 90 °/s"
    assert now["values"]["margin.speed"] == pytest.approx(0.5)
    assert "“stale” has no bar" in html  # it is not forgotten: bars are made of samples
    assert now["series"] == {f"effort.{i}": 1.5 for i in range(6)}  # nothing to draw of the others


def test_what_was_measured_stays_when_a_run_has_ended(settings: Settings) -> None:
    directory = RunDirectory.create(settings.runs, "ur5", "held")
    looking = LiveRun(directory.path, settings)
    view = LiveState(directory.path, ArmView(ROBOT, []))
    with hold_run(directory.path):
        directory.write_start({"uid": "u"})
        moving(view)
        view.notify({"kind": "prompt", "text": "Mount it"})
        looking.look()
        view.close()
    now = looking.look()
    assert now["over"]
    assert now["texts"]["samples"] == "3 125".replace(" ", now["texts"]["samples"][1])
    assert now["texts"]["percent"] == "25 %"
    assert now["texts"]["left"] == "–"
    assert now["shown"]["arm"]
    assert not now["shown"]["question"]


@pytest.mark.parametrize("read_only", [False, True])
def test_stop_is_on_every_page_for_every_live_run(
    settings: Settings, run: Run, read_only: bool
) -> None:
    other = RunDirectory.create(settings.runs, "ur5", "other")
    made = Settings(settings.runs, settings.registry, port=8350, read_only=read_only)
    with hold_run(other.path):
        for path in ("/", "/runs", "/models", "/start", "/nothing"):
            html = browser(made).get(path, headers=PAGE).text
            header = html[: html.index("<main")]
            for name in (run[0].path.name, other.path.name):
                assert name in header
                form = rf'<form [^>]*method="post" action="/runs/[^"]*{name}/stop"'
                assert bool(re.search(form, header)) is not read_only


def test_a_run_whose_motion_is_over_says_how_it_ended_while_models_are_made(
    settings: Settings, run: Run
) -> None:
    directory, view = run
    moving(view)
    directory.write_stop("stopped", "stop asked by anna")
    view.notify({"kind": "state", "state": "done", "reason": "stop asked by anna"})
    view.notify({"kind": "stage", "stage": "writing the report"})
    header = header_of(directory.path, settings)
    assert header["text"] == "stopped: stop asked by anna; writing the report"
    assert header["over"]
    assert not LiveRun(directory.path, settings).look()["shown"]["arm"]


def test_pages_bring_no_script_and_no_style_inside(settings: Settings, run: Run) -> None:
    """The policy of our pages would leave them out."""
    moving(run[1])
    for path in ("/", "/start", LiveRun(run[0].path, settings).look()["address"]):
        html = browser(settings).get(path, headers=PAGE).text
        assert not re.search(r"<style|<script(?![^>]*\bsrc=)|\sstyle=|\son\w+=", html)


def test_texts_are_escaped_and_plain(settings: Settings, run: Run) -> None:
    directory, view = run
    view.notify({"kind": "prompt", "text": "<b>Mount</b>\x1b[31m it", "answered_by": ""})
    html = browser(settings).get(LiveRun(directory.path, settings).look()["address"]).text
    assert "<b>Mount" not in html
    assert "\x1b" not in html


def test_a_damaged_view_shows_no_numbers_and_no_errors(settings: Settings, run: Run) -> None:
    directory, _ = run
    for view in ("{", '{"arm": [1], "interlocks": "x"}', '{"arm": {"q_rad": "x"}, "t": "y"}'):
        (directory.path / ".live.json").write_text(view)
        now = LiveRun(directory.path, settings).look()
        assert browser(settings).get(now["address"], headers=PAGE).status_code == 200


def test_live_runs_are_told_of_at_once_and_when_they_change(settings: Settings, run: Run) -> None:
    moving(run[1])
    first, planned = asyncio.run(_first_events(settings, 2))
    assert planned == []
    assert [(one["name"].rpartition("/")[2], one["percent"]) for one in first] == [
        (run[0].path.name, 25)
    ]


async def _first_events(settings: Settings, count: int) -> list[Any]:
    """The first documents of `/events`, which never ends by itself."""
    found: list[Any] = []
    gone = asyncio.Event()

    async def receive() -> dict[str, Any]:
        await gone.wait()
        return {"type": "http.disconnect"}

    async def send(message: Any) -> None:
        for line in message.get("body", b"").decode().splitlines():
            if line.startswith("data: "):
                found.append(json.loads(line.removeprefix("data: ")))
        if len(found) >= count:
            gone.set()

    scope = {
        "type": "http", "method": "GET", "path": "/events", "query_string": b"", "scheme": "http",
        "headers": [(b"host", b"127.0.0.1:8350")], "http_version": "1.1", "root_path": "",
        "server": ("127.0.0.1", 8350), "client": ("127.0.0.1", 1),
    }  # fmt: skip
    async with asyncio.timeout(10):
        await create_app(settings)(scope, receive, send)
    return found


HOT = "interlock temperature: j1 at 61 °C, limit 60 °C, device time 3.000 s"


@pytest.mark.parametrize(
    ("events", "can"),
    [
        ([], {"pause", "resume", "stop"}),  # it has said nothing: it may take either
        ([{"kind": "state", "state": "running"}], {"pause", "stop"}),
        ([PROGRESS | {"pausing": "asked by anna"}], {"resume", "stop"}),
        ([PROGRESS | {"pausing": HOT}], {"pause", "stop"}),
        ([{"kind": "state", "state": "paused", "reason": "asked by anna"}], {"resume", "stop"}),
        # What an interlock holds goes on by itself; somebody may want it to stay.
        ([{"kind": "state", "state": "paused", "reason": HOT}], {"pause", "stop"}),
        ([{"kind": "state", "state": "stopping", "reason": "completed"}], {"stop"}),
        ([{"kind": "state", "state": "done", "reason": "completed"}], set()),
    ],
)
def test_only_what_a_run_would_do_can_be_pressed(
    settings: Settings, run: Run, events: list[dict[str, Any]], can: set[str]
) -> None:
    directory, view = run
    for event in events:
        view.notify(event)
    now = LiveRun(directory.path, settings).look()
    assert {what for what, yes in now["can"].items() if yes} == can
    html = browser(settings).get(now["address"], headers=PAGE).text
    buttons = dict(re.findall(r'data-can="(\w+)"([^>]*)>', html))
    # Without scripts a page grows old: whatever is pressed is sent, and the keyboard stays there.
    assert {what for what, rest in buttons.items() if 'aria-disabled="true"' not in rest} == can
    assert not re.search(r"<button[^>]* disabled", html)


def test_nothing_can_be_asked_of_a_run_that_has_ended(settings: Settings, run: Run) -> None:
    directory = RunDirectory.create(settings.runs, "ur5", "ended")
    assert not any(LiveRun(directory.path, settings).look()["can"].values())


@pytest.mark.parametrize(
    ("clock", "wall_s", "left"),
    [
        ("wall", 25.0, "1 min 15 s left"),
        ("wall", 6.25, "18.8 s left, clock × 4.0"),
        ("virtual", 25.0, "1 min 15 s left, virtual clock"),
        ("virtual", 0.625, "1.9 s left, virtual clock × 40"),
    ],
)
def test_where_time_left_is_told_so_is_a_clock_that_is_not_that_on_the_wall(
    settings: Settings, clock: Any, wall_s: float, left: str
) -> None:
    directory = RunDirectory.create(settings.runs, "ur5", "held")
    view = LiveState(directory.path, ArmView(replace(ROBOT, clock=clock), []))
    with hold_run(directory.path):
        view.notify({"kind": "state", "state": "running", "reason": ""})
        view.notify(PROGRESS | {"wall_s": wall_s})
        view.notify({"kind": "rows", "rows": rows(1)})
        assert LiveRun(directory.path, settings).look()["texts"]["left"] == left
        assert header_of(directory.path, settings)["left"] == left


# What goes on, as pages and streams are told: each run once, and nothing is paid for the ended


def ended(settings: Settings, name: str) -> Path:
    """A run that nobody has touched for a minute."""
    run = settings.runs / "2026-11-23" / "ur5" / name
    run.mkdir(parents=True)
    (run / "start.json").write_text("{}")
    for folder in (run, run.parent, run.parent.parent, settings.runs):
        os.utime(folder, (time.time() - 60,) * 2)
    return run


def started_here(what: Path, settings: Settings) -> Started:
    """The record of this process, as if it were about to run a spec or to go on with a run."""
    said = Started(
        id="17", runs=str(settings.runs), spec=str(what), station="", operator="anna",
        pid=os.getpid(), ticks=ticks_of(os.getpid()), time=time.time(), host=platform.node(),
    )  # fmt: skip
    (settings.runs / FOLDER).mkdir(parents=True)
    (settings.runs / FOLDER / "17.json").write_text(json.dumps(asdict(said)))
    return said


def test_a_stream_looks_into_no_run_that_has_ended(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    live, *_ = (ended(settings, f"{n:04d}-a") for n in range(1, 9))
    looked_at: list[Path] = []
    real, changed = known_runs.is_live, known_runs._changed
    monkeypatch.setattr(known_runs, "is_live", lambda run: looked_at.append(run) or real(run))
    news = _SharedBar(settings)
    with hold_run(live):
        news.read()
        asked: list[Path] = []
        monkeypatch.setattr(known_runs, "_changed", lambda at: asked.append(at) or changed(at))
        looked_at.clear()
        news._fresh_until = 0.0
        (told,) = news.read().live or []
    assert told["address"] == "/runs/2026-11-23/ur5/0001-a"
    assert looked_at == [live]
    # Folders of runs, a day and a robot, and the one run that may be live.
    assert [path.name for path in asked] == ["runs", "2026-11-23", "ur5", "0001-a"]


def test_one_that_is_gone_on_with_is_shown_once_and_at_once(settings: Settings) -> None:
    run = ended(settings, "0001-a")
    news = _SharedBar(settings)
    again = started_here(run, settings)
    assert [one["id"] for one in news.read().planned or []] == ["17"]
    assert again.made == []
    with hold_run(run):  # it plans the way back; resume-01.json comes after that
        news._fresh_until = 0.0
        now = news.read()
        assert now.planned == pending_starts(settings) == []
        assert [one["address"] for one in now.live or []] == ["/runs/2026-11-23/ur5/0001-a"]
        assert live_headers(settings) == now.live
        assert again.made == [run.resolve()]  # its page leads to that of the run, which has Stop


def made_by_it(settings: Settings, name: str) -> Path:
    run = ended(settings, name)
    (run / "start.json").write_text('{"started_as": "17"}')
    return run


def test_a_process_that_only_closes_after_its_run_plans_nothing(settings: Settings) -> None:
    started_here(settings.runs.parent / "a.yaml", settings)
    assert [one["text"] for one in pending_starts(settings)] == ["is being planned"]
    made_by_it(settings, "0001-a")
    assert pending_starts(settings) == []


def test_nor_does_one_that_only_closes_after_it_went_on_with_a_run(settings: Settings) -> None:
    run = ended(settings, "0001-a")
    started_here(run, settings)
    assert [one["text"] for one in pending_starts(settings)] == ["is about to resume"]
    assert resume_offer(run, settings)["begun"] == "/start/17"
    (run / "resume-01.json").write_text('{"started_as": "17"}')
    assert pending_starts(settings) == []
    assert resume_offer(run, settings)["begun"] == ""


def test_a_series_between_two_runs_can_be_cancelled(settings: Settings, tmp_path: Path) -> None:
    spec, *experiments = (tmp_path / name for name in ("two.yaml", "a.yaml", "b.yaml"))
    for each in experiments:
        each.touch()
    spec.write_text("hil_series: 1\nname: two\nseries: [{spec: a.yaml}, {spec: b.yaml}]\n")
    started_here(spec, settings)
    first = made_by_it(settings, "0001-a")
    assert pending_starts(settings) == []  # stopped: it does not go on
    (first / "verdict.json").write_text("{}")
    assert [one["text"] for one in pending_starts(settings)] == ["is about to start its next run"]
    last = made_by_it(settings, "0002-b")
    (last / "verdict.json").write_text("{}")
    assert pending_starts(settings) == []


# What is asked of a run in the dashboard: the question that was read, and Stop at any time


HOST = "127.0.0.1:8350"
LINES = "Mount:\n\t- the 3\u00a0kg disc\r\n\t- four <M6> screws \x1b[2J"


class Held:
    """A run that this process holds and that listens, with a browser at it."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.directory = RunDirectory.create(settings.runs, "ur5", "held")
        self.path = self.directory.path
        self.view = LiveState(self.path)
        self.app = create_app(settings)
        self.browser = TestClient(self.app, base_url=f"http://{HOST}", follow_redirects=False)
        self.address = f"/runs/{self.path.relative_to(settings.runs)}"

    def asks(self, text: str, asked: int = 1) -> None:
        self.view.notify({"kind": "prompt", "text": text, "asked": asked, "answered_by": ""})

    def form(self) -> dict[str, str]:
        """The hidden fields of the question as a browser sends them."""
        page = self.browser.get(self.address, headers={"accept": "text/html"}).text
        form = page[page.index(f'action="{self.address}/answer"') :].partition("</form>")[0]
        found = re.findall(r'<input type="hidden" name="(\w+)" value="([^"]*)"', form)
        return {name: html.unescape(value).replace("\n", "\r\n") for name, value in found}

    def answer(self, form: dict[str, str], word: str = "yes") -> Any:
        return self.browser.post(f"{self.address}/answer", data={**form, "answer": word})

    def dropped(self) -> list[dict[str, Any]]:
        return [json.loads(path.read_text()) for path in waiting(self.path)]


@pytest.fixture
def held(tmp_path: Path) -> Iterator[Held]:
    held = Held(Settings(tmp_path / "runs", tmp_path / "registry", specs=tmp_path, port=8350))
    with hold_run(held.path):
        held.directory.write_start({"uid": "u"})
        (held.path / ".control").mkdir()
        held.view = LiveState(held.path)
        yield held


def test_a_yes_read_in_an_attempt_that_died_answers_no_question_of_the_next(
    tmp_path: Path,
) -> None:
    held = Held(Settings(tmp_path / "runs", tmp_path / "registry", specs=tmp_path, port=8350))
    held.directory.write_start({"uid": "u"})
    with hold_run(held.path):
        (held.path / ".control").mkdir()
        held.view = LiveState(held.path)
        held.asks("Mount the 3 kg disc")
        old = held.form()
    with hold_run(held.path):  # killed and gone on with: its questions count from one again
        with pytest.raises(DataError, match="has no open prompt"):
            question_of(held.path)
        held.view = LiveState(held.path)
        held.asks("Mount the 3 kg disc")
        refused = held.answer(old)
        assert "now asks another question" in refused.text
        assert not refused.is_success
        assert held.dropped() == []
        assert held.answer(held.form()).status_code == 200
        assert [(each["asked"], each["yes"]) for each in held.dropped()] == [(1, True)]


@pytest.mark.parametrize("text", [LINES, "Mount it. " * 500, "Mount it"])
def test_a_question_of_any_form_is_answered_as_it_was_shown(held: Held, text: str) -> None:
    held.asks(text)
    said = held.answer(held.form())
    assert said.status_code == 200, said.text
    (request,) = held.dropped()
    assert (request["prompt"], request["asked"], request["yes"]) == (text, 1, True)


def test_lines_of_a_question_are_shown_and_nothing_that_writes_elsewhere(held: Held) -> None:
    held.asks(LINES)
    page = held.browser.get(held.address).text
    assert "Mount:\n - the 3 kg disc\n - four &lt;M6&gt; screws [2J<" in page
    style = held.browser.get("/static/live.css").text
    assert re.search(r"\.question \.asked \{ white-space: pre-line; \}", style)


def test_a_second_yes_answers_no_later_question_of_the_same_text(held: Held) -> None:
    held.asks("Mount it", 1)
    form = held.form()
    held.asks("Mount it", 2)
    late = held.answer(form)
    assert late.status_code == 404
    assert "now asks another question" in late.json()["error"]
    assert held.dropped() == []
    assert held.answer(held.form()).status_code == 200
    assert held.dropped()[0]["asked"] == 2


def test_what_was_read_goes_to_the_run_though_it_asks_the_next_by_then(
    held: Held, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Checked once and handed over: the run itself sees that it is late."""
    held.asks("Mount it", 1)
    form = held.form()

    def meanwhile(*args: Any, **more: Any) -> Any:
        held.asks("Remove it", 2)
        return answer_run(*args, **more)

    monkeypatch.setattr(run_page, "answer_run", meanwhile)
    held.answer(form)
    assert [(one["prompt"], one["asked"]) for one in held.dropped()] == [("Mount it", 1)]


def test_a_run_that_does_not_count_is_answered_by_text(held: Held) -> None:
    held.asks("Mount it")
    view = read_live(held.path)
    del view["asked"]
    (held.path / LIVE_FILE).write_text(json.dumps(view))
    form = held.form()
    assert held.answer(form | {"prompt": "Remove it"}).status_code == 404
    assert held.answer(form).status_code == 200
    assert [one["asked"] for one in held.dropped()] == [0]


def request_of(held: Held, **params: str) -> Request:
    return Request({"type": "http", "app": held.app, "path_params": params, "query_string": b""})


async def asked(app: Any, path: str, **fields: str) -> int:
    """The status of a form that is posted, as a server would hand it over."""
    body = urlencode(fields).encode()
    status = 0

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: Any) -> None:
        nonlocal status
        status = message.get("status", status)

    scope = {
        "type": "http", "method": "POST", "path": path, "query_string": b"", "scheme": "http",
        "headers": [(b"host", HOST.encode())], "http_version": "1.1", "root_path": "",
        "server": ("127.0.0.1", 8350), "client": ("127.0.0.1", 1),
    }  # fmt: skip
    await app(scope, receive, send)
    return status


HANGS_S = 60.0
"""How long a plan or a start takes in these tests; who waits for one does not end in half of it."""


@pytest.mark.parametrize(("do", "refused"), [("check", 58), ("start", 0)])
def test_stop_finds_a_thread_while_everybody_plans_or_starts(
    do: str, refused: int, held: Held, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.yaml").write_text("hil: 1\n")
    over, busy = threading.Event(), []

    def slow(*_: Any) -> tuple[()]:
        busy.append(1)
        over.wait(HANGS_S)
        return ()

    def slow_start(*_: Any, **__: Any) -> Any:
        slow()
        return SimpleNamespace(id="1")

    async def planned(*_: Any) -> Any:
        return {"plans": [], "digest": ""}

    monkeypatch.setattr(start_page, "check_start", slow if do == "check" else lambda *_: ())
    monkeypatch.setattr(plan_preview, "plan_in_process", planned)
    monkeypatch.setattr(start_page, "start_run", slow_start)
    csrf = held.settings.csrf

    async def hurry() -> tuple[int, list[int]]:
        checks = [
            asyncio.create_task(asked(held.app, "/start", csrf=csrf, spec="a.yaml", do=do))
            for _ in range(60)
        ]
        while not busy:
            await asyncio.sleep(0.01)
        stopped = await asked(held.app, f"{held.address}/stop", csrf=csrf)
        # The others are told at once, while two are still made.
        while sum(one.done() for one in checks) < refused:
            await asyncio.sleep(0.01)
        answers = [one.result() for one in checks if one.done()]
        over.set()
        await asyncio.gather(*checks)
        return stopped, answers

    stopped, answers = asyncio.run(asyncio.wait_for(hurry(), HANGS_S / 2))
    assert stopped == 200
    assert [one["what"] for one in held.dropped()] == ["stop"]
    assert answers == [503] * refused
    assert len(busy) == 60 - refused


def test_stop_finds_a_thread_while_everybody_goes_on(
    held: Held, monkeypatch: pytest.MonkeyPatch
) -> None:
    over, busy = threading.Event(), []

    def slow(*_: Any, **__: Any) -> Any:
        busy.append(1)
        over.wait(HANGS_S)
        return SimpleNamespace(id="1")

    monkeypatch.setattr(run_page, "resumption_of", lambda *_: ("", False))
    monkeypatch.setattr(run_page, "go_on_with", slow)
    csrf = held.settings.csrf

    async def hurry() -> int:
        path = f"{held.address}/go-on"
        sent = [
            asyncio.create_task(asked(held.app, path, csrf=csrf, once=str(i))) for i in range(60)
        ]
        while len(busy) < THREADS["start"]:  # nobody waits for another's start
            await asyncio.sleep(0.01)
        stopped = await asked(held.app, f"{held.address}/stop", csrf=csrf)
        over.set()
        await asyncio.gather(*sent)
        return stopped

    stopped = asyncio.run(asyncio.wait_for(hurry(), HANGS_S / 2))
    assert stopped == 200
    assert len(busy) == 60


def test_the_disk_is_never_waited_for_where_requests_come_in(
    held: Held, monkeypatch: pytest.MonkeyPatch
) -> None:
    where: list[str] = []

    def noted(module: Any, name: str) -> None:
        original = getattr(module, name)

        def call(*args: Any) -> Any:
            where.append(threading.current_thread().name)
            return original(*args)

        monkeypatch.setattr(module, name, call)

    noted(run_page, "folder_at")
    noted(live_runs, "require_run")
    noted(start_page, "started_runs")
    csrf = held.settings.csrf
    asyncio.run(asked(held.app, f"{held.address}/stop", csrf=csrf))
    asyncio.run(asked(held.app, "/start/none/cancel", csrf=csrf))
    with pytest.raises(DataError):
        asyncio.run(live_runs.run_events(request_of(held, name="none")))
    assert len(where) >= 3
    assert threading.current_thread().name not in where


def test_a_page_that_was_refused_a_stream_can_ask_why() -> None:
    async def endless(scope: Any, receive: Any, send: Any) -> None:
        await asyncio.sleep(10)

    async def ask(app: StreamLimit, method: str) -> int:
        told: list[int] = []

        async def send(message: Any) -> None:
            told.append(message.get("status", 0))

        scope = {"type": "http", "method": method, "path": "/events", "headers": []}
        await app(scope, None, send)  # type: ignore[arg-type]
        return told[0]

    async def all_of() -> list[int]:
        app = StreamLimit(endless, most=1)
        before = await ask(app, "HEAD")
        listening = asyncio.create_task(ask(app, "GET"))
        await asyncio.sleep(0)
        told = [before, await ask(app, "GET"), await ask(app, "HEAD")]
        listening.cancel()
        return told

    assert asyncio.run(all_of()) == [204, 503, 503]
