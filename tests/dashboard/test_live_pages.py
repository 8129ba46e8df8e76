"""Pages of what goes on: what they show of runs that this process holds."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from hil.core.lock_file import hold_run
from hil.dashboard.live_runs import LiveRun, header_of
from hil.dashboard.server import create_app
from hil.dashboard.settings import Settings
from hil.recording.run_directory import RunDirectory
from hil.robot import Capabilities
from hil.workflow.live_state import ArmView, LiveState
from tests.support.interlock_parts import NAMES, made, rows

ROBOT = Capabilities(joint_names=NAMES, rate_hz=125.0, effort_kind="current")
PAGE = {"accept": "text/html"}
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
    assert "“stale” has none" in html  # it is not forgotten: bars are made of samples
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
