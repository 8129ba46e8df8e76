"""Starting runs from the dashboard: what is offered, planned, checked, and started as checked."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import platform
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, replace
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.error import URLError
from urllib.parse import urlencode
from urllib.request import urlopen

import pytest
from starlette.testclient import TestClient

from hil.core.errors import PlanError, RecordingError, RobotConnectionError, SpecError
from hil.dashboard import plan_preview, start_page
from hil.dashboard.plan_preview import experiments_digest
from hil.dashboard.server import create_app
from hil.dashboard.settings import Settings
from hil.dashboard.start_page import FILE_KEYS, Idempotency, lock_owner
from hil.excitation.dwell import MOST_QUOTED, read_waypoints
from hil.planning.experiment import Experiment
from hil.planning.experiment import load as load_experiment
from hil.recording.run_directory import RunDirectory
from hil.robot.lease import leased
from hil.spec.experiment import ExperimentSpec
from hil.spec.model_tree import tree
from hil.workflow.background_runs import FOLDER, Started, started_runs, ticks_of
from tests.support.started_parts import PROMPT, written
from tests.support.waiting import until
from tests.support.web_parts import dashboard, failing

# Starting runs from the dashboard: what is offered, what is checked, what becomes of it


PAGE = {"accept": "text/html"}


class Desk:
    """A browser at a dashboard with some specs."""

    def __init__(self, folder: Path, **more: Any) -> None:
        specs = folder / "specs"
        specs.mkdir()
        self.files = written(specs)
        self.settings = Settings(folder / "runs", folder / "registry", specs, port=8350, **more)
        app = create_app(self.settings)
        self.browser = TestClient(app, base_url="http://127.0.0.1:8350", follow_redirects=False)

    def post(self, **fields: str) -> Any:
        given = {"csrf": self.settings.csrf, "spec": "asks.yaml", "station": "wall.yaml"} | fields
        return self.browser.post("/start", data=given, headers=PAGE)

    def options(self) -> list[str]:
        files = self.browser.get("/start").text.partition("<fieldset")[0]
        return re.findall(r"<option[^>]*>([^<]+)<", files)


@pytest.fixture
def planned_here(plans_once: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Plan in this process, and draw nothing: each takes a second, and neither is the point."""

    async def planned(asked: dict[str, Any], gone: object) -> dict[str, Any]:
        return plan_preview._plan(asked)

    monkeypatch.setattr(plan_preview, "plan_in_process", planned)
    monkeypatch.setattr(plan_preview, "PICTURES", 0)


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path)


def test_specs_and_stations_of_the_folder_are_offered_and_nothing_else(desk: Desk) -> None:
    specs = desk.settings.specs
    assert specs is not None
    (specs / "deep").mkdir()
    (specs / "deep" / "s.yaml").write_text("hil_series: 1\nname: s\n")
    (specs / "weekly.yaml").write_text("hil_schedule: 1\n")
    (specs / "other.yaml").write_text("x: 1\n# hil: 1\n")
    options = desk.options()
    assert options[1:] == [
        "asks.yaml", "deep/s.yaml", "the one beside the spec, or the built-in mock bench",
        "wall.yaml",
    ]  # fmt: skip


def test_the_page_says_which_folder_is_offered_and_how_to_offer_another(desk: Desk) -> None:
    text = desk.browser.get("/start").text
    assert f"<code>{desk.settings.specs}</code>" in text
    assert "<code>hil serve --specs FOLDER</code>" in text


@pytest.mark.thorough
def test_checking_shows_the_plan_and_moves_nothing(desk: Desk) -> None:
    answer = desk.post(do="check", overrides="excitation.waypoints=8")
    assert answer.status_code == 200
    shown = dict(re.findall(r'<th scope="row">([^<]+)</th><td>([^<]+)</td>', answer.text))
    assert shown["poses"] == "8"
    assert PROMPT in answer.text
    assert shown["tracking error"]
    assert re.fullmatch(r"[\d.]+ m?rad/s", shown["margin: velocity"])
    assert re.fullmatch(r"[\d.]+ [kM]B", shown["recording"])
    assert "e-0" not in "".join(shown.values())
    assert not desk.settings.runs.exists()
    assert "excitation.waypoints=8" in answer.text  # what was typed is still there


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"spec": "../asks.yaml"}, "not offered"),
        ({"spec": "/etc/passwd"}, "not offered"),
        ({"station": "asks.yaml"}, "not offered"),
        ({"overrides": "excitation.waypoints"}, "is not an override"),
        ({"overrides": "excitation.waypoint=3"}, "waypoint"),
        ({"overrides": "excitation.waypoints=many"}, "waypoints"),
        ({"overrides": "excitation.waypoints=8\0"}, "control characters (U+0000)"),
        ({"overrides": "name=a\x1b[2J"}, "control characters (U+001B)"),
        ({"operator": "an\0na"}, "control characters (U+0000)"),
        ({"operator": "anna\nbert"}, "control characters (U+000A)"),
        ({"spec": "asks.yaml\0"}, "not offered"),
    ],
)
@pytest.mark.parametrize("do", ["check", "start"])
def test_what_is_wrong_is_said_and_nothing_starts(
    desk: Desk, fields: dict[str, str], told: str, do: str
) -> None:
    answer = desk.post(do=do, **fields)
    assert answer.status_code == 422
    assert told in re.sub("<[^>]+>", "", answer.text)
    assert not desk.settings.runs.exists()


@pytest.mark.parametrize("do", ["check", "start"])
def test_a_name_of_a_cookie_is_looked_at_as_well(desk: Desk, do: str) -> None:
    desk.browser.cookies.set("hil_who", "an%00na")
    answer = desk.post(do=do)
    assert answer.status_code == 422
    assert "control characters" in answer.text


class Starts:
    """In place of `start_run`: notes what would be started; slow enough to be asked twice."""

    def __init__(self) -> None:
        self.what: list[dict[str, Any]] = []

    def __call__(self, spec: Path, runs: Path, **more: Any) -> Any:
        time.sleep(0.1)
        self.what.append({"spec": spec, **more})
        return SimpleNamespace(id=str(len(self.what)))


def once(desk: Desk) -> str:
    """The value that a form of its own hides."""
    (value,) = re.findall(r'name="once" value="([^"]+)"', desk.browser.get("/start").text)
    return str(value)


@pytest.mark.thorough
def test_a_form_that_is_sent_twice_starts_one_run(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts = Starts()
    monkeypatch.setattr("hil.dashboard.start_page.start_run", starts)
    form = once(desk)
    with ThreadPoolExecutor(2) as both:
        answers = list(both.map(lambda _: desk.post(do="start", once=form), range(2)))
    again = desk.post(do="start", once=form)
    assert [each.headers["location"] for each in (*answers, again)] == ["/start/1"] * 3
    assert len(starts.what) == 1
    assert desk.post(do="start", once=once(desk)).headers["location"] == "/start/2"
    changed = desk.post(do="start", once=form, overrides="excitation.waypoints=8")
    assert changed.headers["location"] == "/start/3"  # gone back and changed: not the one before
    assert desk.post(do="start").headers["location"] == "/start/4"  # a program need not hide any


def test_what_could_not_be_started_may_be_sent_again(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> Any:
        raise RecordingError("no space left on device")

    form, starts = once(desk), Starts()
    monkeypatch.setattr("hil.dashboard.start_page.start_run", full)
    assert desk.post(do="start", once=form).status_code == 422
    monkeypatch.setattr("hil.dashboard.start_page.start_run", starts)
    assert desk.post(do="start", once=form).status_code == 303


def test_what_was_sent_is_forgotten_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 100.0
    monkeypatch.setattr("hil.dashboard.start_page.time", SimpleNamespace(monotonic=lambda: now_s))
    done: list[int] = []

    def do() -> str:
        done.append(1)
        return str(len(done))

    brief = Idempotency(0.05)
    assert [brief.result("a", do), brief.result("a", do), brief.result("b", do)] == ["1", "1", "2"]
    now_s += 0.06
    assert brief.result("a", do) == "3"


def test_read_only_offers_no_start(tmp_path: Path) -> None:
    desk = Desk(tmp_path, read_only=True)
    assert desk.post(do="start").status_code == 403
    assert "<form" not in desk.browser.get("/start").text


@pytest.mark.wire
def test_a_run_is_started_by_whom_it_says_with_what_was_laid_over_it(desk: Desk) -> None:
    answer = desk.post(do="start", operator="Žofie", overrides="excitation.waypoints=8")
    assert answer.status_code == 303
    where = answer.headers["location"]
    (started,) = started_runs(desk.settings.runs)
    try:
        waiting = desk.browser.get(where, headers=PAGE)
        assert 'http-equiv="refresh"' in waiting.text or waiting.status_code == 303
        until(lambda: started.made, 30)
        leads = desk.browser.get(where, headers=PAGE).headers["location"]
        assert leads == f"/runs/{started.made[0].relative_to(desk.settings.runs)}"
        until(lambda: "operator" in RunDirectory(started.made[0]).start)
        assert RunDirectory(started.made[0]).start["operator"] == "Žofie"
        assert "waypoints: 8" in (started.made[0] / "spec.yaml").read_text()
    finally:
        started.cancel()
        until(lambda: not started.alive, 20)


@pytest.mark.wire
def test_one_that_did_not_begin_says_its_last_words(desk: Desk) -> None:
    answer = desk.post(do="start")
    (started,) = started_runs(desk.settings.runs)
    cancelled = desk.browser.post(
        f"{answer.headers['location']}/cancel", data={"csrf": desk.settings.csrf}
    )
    assert cancelled.status_code == 303
    until(lambda: not started.alive, 20)
    ended = desk.browser.get(answer.headers["location"], headers=PAGE)
    if not started.made:  # it is quick, but not that quick
        assert "did not start" in ended.text
        assert "http-equiv" not in ended.text


@pytest.mark.wire
def test_what_is_being_planned_can_be_cancelled_from_every_page(desk: Desk) -> None:
    where = desk.post(do="start").headers["location"]
    (started,) = started_runs(desk.settings.runs)
    try:
        html = desk.browser.get("/models", headers=PAGE).text
        assert started.made or f'action="{where}/cancel"' in html
        assert desk.browser.post(f"{where}/cancel", data={"csrf": desk.settings.csrf}).is_redirect
        until(lambda: not started.alive, 20)
        html = desk.browser.get("/models", headers=PAGE).text
        assert f'action="{where}/cancel"' not in html
    finally:
        started.cancel()


def rows_of(html: str) -> dict[str, str]:
    return dict(re.findall(r'<th scope="row">([^<]+)</th><td>([^<]+)</td>', html))


@pytest.mark.thorough
def test_the_plan_is_drawn_and_speaks_of_no_command_line(desk: Desk) -> None:
    answer = desk.post(do="check", overrides="excitation.waypoints=8")
    (data,) = re.findall(r'<img [^>]*src="data:image/svg\+xml;base64,([^"]+)"', answer.text)
    picture = base64.b64decode(data).decode()
    assert "Joint angles over the whole plan" in picture
    assert "img-src 'self' data:" in answer.headers["content-security-policy"]
    assert "the run plans again from the current pose of the arm" in answer.text
    assert "--connect" not in answer.text
    assert "hil run" not in answer.text


@pytest.mark.usefixtures("planned_here")
@pytest.mark.thorough
def test_a_first_time_is_planned_slower_and_shorter(desk: Desk) -> None:
    whole = rows_of(desk.post(do="check").text)
    answer = desk.post(do="check", speed="25%", first="4")
    shown = rows_of(answer.text)
    assert shown["part of the program"] == "at 25 % of the speed, only the first 4 of 12 measured"
    assert (whole["poses"], shown["poses"]) == ("12", "4")
    assert "condition number" not in shown
    assert "nothing is fitted or evaluated" in answer.text
    assert re.search(r"<option selected>25%<", answer.text)
    assert 'name="first" value="4"' in answer.text


@pytest.mark.parametrize(("field", "value"), [("speed", "300%"), ("speed", "x"), ("first", "-1")])
@pytest.mark.parametrize("do", ["check", "start"])
def test_a_part_that_cannot_be_is_said(desk: Desk, field: str, value: str, do: str) -> None:
    answer = desk.post(do=do, **{field: value})
    assert answer.status_code == 422
    option = {"speed": "--speed-scale", "first": "--limit"}[field]
    assert f"{option} {value} is n" in unescape(answer.text)
    assert not desk.settings.runs.exists()


def test_the_part_is_started_and_another_part_is_another_run(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts, form = Starts(), once(desk)
    monkeypatch.setattr("hil.dashboard.start_page.start_run", starts)
    for first in ("4", "4", "5"):
        desk.post(do="start", once=form, speed="10%", first=first)
    assert [(one["speed"], one["first"]) for one in starts.what] == [("10%", "4"), ("10%", "5")]


# What was checked is what is started: a form carries the digest of its plan


POSES = "0, -90, 90, 0, 0, 0\n10, -80, 80, 0, 0, 0\n"


class NotingDesk:
    """A browser at a dashboard that notes what it would start."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (folder / "specs").mkdir()
        self.spec, self.station = written(folder / "specs")
        self.browser: TestClient = dashboard(folder)
        self.started: list[dict[str, Any]] = []
        monkeypatch.setattr(start_page, "start_run", self._start)

    def _start(self, spec: Path, runs: Path, **more: Any) -> Any:
        self.started.append(more)
        return SimpleNamespace(id=str(len(self.started)))

    def post(self, do: str, **fields: str) -> Any:
        settings = self.browser.app.state.settings  # type: ignore[attr-defined]
        form = {"csrf": settings.csrf, "spec": "asks.yaml", "station": "wall.yaml", "do": do}
        return self.browser.post("/start", data=form | fields, follow_redirects=False)


@pytest.fixture
def noting_desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> NotingDesk:
    return NotingDesk(tmp_path, monkeypatch)


def checked(html: str) -> str:
    (digest,) = re.findall(r'name="checked" value="([0-9a-f]{64})"', html)
    return str(digest)


@pytest.mark.usefixtures("planned_here")
@pytest.mark.thorough
def test_what_was_changed_since_it_was_checked_is_shown_anew_and_not_started(
    noting_desk: NotingDesk,
) -> None:
    first = checked(noting_desk.post("check").text)
    text, when = noting_desk.spec.read_text(), noting_desk.spec.stat().st_mtime_ns
    noting_desk.spec.write_text(text.replace("waypoints: 12", "waypoints: 13"))
    os.utime(noting_desk.spec, ns=(when, when))
    answer = noting_desk.post("start", checked=first)
    assert answer.status_code == 409
    assert noting_desk.started == []
    assert "changed after the check" in answer.text
    assert re.search(r'<th scope="row">poses</th><td>13</td>', answer.text)
    assert checked(answer.text) != first
    assert noting_desk.post("start", checked=checked(answer.text)).headers["location"] == "/start/1"


@pytest.mark.usefixtures("planned_here")
@pytest.mark.thorough
def test_what_is_as_it_was_checked_is_started(noting_desk: NotingDesk) -> None:
    digest = checked(noting_desk.post("check", speed="25%").text)
    noting_desk.spec.write_text("# a comment more\n" + noting_desk.spec.read_text())
    assert noting_desk.post("start", checked=digest, speed="25%").status_code == 303
    assert noting_desk.post("start").status_code == 303  # checking is offered, not demanded


@pytest.mark.thorough
@pytest.mark.parametrize(
    "fields",
    [{"overrides": "excitation.waypoints=8"}, {"station": ""}, {"speed": "10%"}, {"first": "4"}],
)
def test_a_form_that_was_changed_since_is_checked_anew(
    noting_desk: NotingDesk, fields: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def planned(asked: Any, gone: Any) -> Any:
        return {"plans": [], "digest": "0" * 64}

    digest = experiments_digest([load_experiment(noting_desk.spec, noting_desk.station)])
    monkeypatch.setattr(plan_preview, "plan_in_process", planned)
    answer = noting_desk.post("start", checked=digest, **fields)
    assert answer.status_code == 409
    assert noting_desk.started == []
    assert checked(answer.text) == "0" * 64
    assert noting_desk.post("start", checked=digest).status_code == 303


def test_an_empty_form_carries_no_digest(noting_desk: NotingDesk) -> None:
    assert 'name="checked"' not in noting_desk.browser.get("/start").text


def changed(experiment: Experiment, file: Path, text: str) -> tuple[str, str]:
    before = experiments_digest([experiment])
    file.write_text(text)
    return before, experiments_digest([experiment])


def test_files_that_are_named_count_by_their_content(tmp_path: Path) -> None:
    spec, station = written(tmp_path)
    (tmp_path / "poses.csv").write_text(POSES)
    experiment = load_experiment(spec, station, overrides={"excitation.file": "poses.csv"})
    before, after = changed(experiment, tmp_path / "poses.csv", POSES.replace("10", "11"))
    assert before != after
    (tmp_path / "own.yaml").write_text("a: 1\n")
    robot = experiment.robot.model_copy(update={"model": str(tmp_path / "own.yaml")})
    before, after = changed(replace(experiment, robot=robot), tmp_path / "own.yaml", "a: 2\n")
    assert before != after


# A plan for the start page is a process of its own, which ends: in time, and with others


ENDLESS = "excitation.waypoints=100000"
ASKED = {"spec": "", "station": "", "overrides": {}, "speed": "", "first": ""}


async def stays() -> bool:
    return False


async def leaves() -> bool:
    return True


@pytest.fixture
def plans_as(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Plan by another program: the text of a module, which may note its process in `pid`."""

    def so(text: str) -> Path:
        note = f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid()))"
        (tmp_path / "planned_so.py").write_text(f"import os, sys, time\n{note}\n{text}")
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))
        monkeypatch.setattr(plan_preview, "MODULE", "planned_so")
        return tmp_path / "pid"

    return so


def check(folder: Path) -> tuple[int, str]:
    (folder / "specs").mkdir()
    written(folder / "specs")
    desk = dashboard(folder)
    csrf = desk.app.state.settings.csrf  # type: ignore[attr-defined]
    answer = desk.post("/start", data={"csrf": csrf, "spec": "asks.yaml", "do": "check"})
    return answer.status_code, unescape(re.sub("<[^>]+>", " ", answer.text))


@pytest.mark.thorough
def test_modules_in_the_working_folder_are_not_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark = tmp_path / "mark"
    (tmp_path / "numpy.py").write_text(f"open({str(mark)!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    status, text = check(tmp_path)
    assert status == 200, text
    assert not mark.exists()


@pytest.mark.thorough
def test_a_plan_that_takes_too_long_is_ended_and_said(
    tmp_path: Path, plans_as: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan_preview, "LIMIT_S", 1.0)
    pid = plans_as("time.sleep(60)")
    status, text = check(tmp_path)
    assert status == 422
    assert "this plan takes longer than 1 s" in text
    assert "plan it with `hil plan`" in text
    assert not ticks_of(int(pid.read_text()))


@pytest.mark.thorough
def test_a_plan_has_so_much_memory_and_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan_preview, "MOST_BYTES", 150 * 1024**2)
    status, text = check(tmp_path)
    assert status == 422
    assert "no plan" in text
    assert "a plan may use 0.15 GB of memory here" in text


def test_arrays_that_do_not_fit_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan_preview, "_plan", failing(MemoryError()))
    assert plan_preview._answer(ASKED) == {"error": plan_preview.TOO_LARGE, "broken": True}


@pytest.mark.parametrize("text", ["os._exit(7)", "print('no JSON')", "print('[')", "print('7')"])
def test_a_planning_that_breaks_is_said(plans_as: Any, text: str) -> None:
    plans_as(text)
    with pytest.raises(PlanError, match="ended without an answer"):
        asyncio.run(plan_preview.plan_in_process(ASKED, stays))


def test_nobody_waits_and_nothing_is_planned(plans_as: Any) -> None:
    pid = plans_as("time.sleep(60)")

    async def gone() -> bool:
        return pid.exists() and bool(pid.read_text())

    with pytest.raises(plan_preview.ClientGone):
        asyncio.run(plan_preview.plan_in_process(ASKED, gone))
    assert not ticks_of(int(pid.read_text()))


def test_a_request_that_is_ended_ends_its_plan(plans_as: Any) -> None:
    pid = plans_as("import subprocess\nsubprocess.run(['sleep', '60'])")

    async def ended() -> None:
        task = asyncio.create_task(plan_preview.plan_in_process(ASKED, stays))
        while not (pid.exists() and pid.read_text() and children_of(int(pid.read_text()))):
            await asyncio.sleep(0.02)
        inner.extend(children_of(int(pid.read_text())))
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task

    inner: list[int] = []
    asyncio.run(ended())
    until(lambda: not any(map(ticks_of, [int(pid.read_text()), *inner])))


def test_the_token_is_not_handed_on(plans_as: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HIL_TOKEN", "k" * 16)
    plans_as("import json; print(json.dumps({'plans': [], 'env': dict(os.environ)}))")
    answer = asyncio.run(plan_preview.plan_in_process(ASKED, stays))
    assert "HIL_TOKEN" not in answer["env"]


@pytest.mark.thorough
def test_a_plan_ends_with_whoever_asked_for_it(tmp_path: Path) -> None:
    spec, _ = written(tmp_path)
    asked = {**ASKED, "spec": str(spec), "overrides": dict([ENDLESS.split("=")]), "bytes": 2**32}
    with subprocess.Popen(
        [sys.executable, "-m", "hil.dashboard.plan_preview"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,
    ) as process:  # fmt: skip
        try:
            assert process.stdin is not None
            process.stdin.write(json.dumps(asked).encode() + b"\n")
            process.stdin.flush()
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(1)
            process.stdin.close()
            assert process.wait(10) == -signal.SIGKILL
        finally:
            process.kill()


@pytest.mark.wire
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_dashboard_ends_while_it_plans(tmp_path: Path, number: int) -> None:
    written(tmp_path)
    with subprocess.Popen(
        [sys.executable, "-m", "hil", "serve", "--port", "0", "--specs", "."],
        cwd=tmp_path, stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            address = process.stdout.readline().split()[-1]
            (csrf,) = set(re.findall(r'name="csrf" value="([^"]+)"', opened(f"{address}start")))
            form = {"csrf": csrf, "spec": "asks.yaml", "do": "check", "overrides": ENDLESS}
            asking = threading.Thread(target=opened, args=(f"{address}start", form), daemon=True)
            asking.start()
            until(lambda: children_of(process.pid), 20)
            (child,) = children_of(process.pid)
            time.sleep(0.5)
            process.send_signal(number)
            assert process.wait(20) == 130  # in a second, where there is nothing else to do
            until(lambda: not ticks_of(child))
        finally:
            process.kill()


STUCK = """
import sys, time
from pathlib import Path
from starlette.routing import Route
from hil.dashboard import server
from hil.dashboard.server import create_app
from hil.dashboard.settings import Settings

def stuck(request):
    print("here", flush=True)
    time.sleep(60)

def made(settings):
    app = create_app(settings)
    app.router.routes.insert(0, Route("/stuck", stuck))
    return app

server.create_app = made
settings = Settings(Path("runs"), Path("registry"))
server.serve(settings, server.listen("127.0.0.1", 0), lambda told: print(told, flush=True))
"""


@pytest.mark.wire
def test_the_dashboard_ends_though_a_page_never_answers(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", f"import signal\n{HANDLED}\n{STUCK}"],
        cwd=tmp_path, stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            threading.Thread(target=opened, args=(f"{address}stuck",), daemon=True).start()
            assert process.stdout.readline() == "here\n"
            process.send_signal(signal.SIGTERM)
            assert process.wait(10) == 130
        finally:
            process.kill()


HANDLED = "signal.signal(signal.SIGTERM, signal.default_int_handler)"
"""As the command line does."""


def opened(address: str, form: dict[str, str] | None = None) -> str:
    try:
        with urlopen(address, urlencode(form).encode() if form else None, timeout=30) as answer:
            return str(answer.read().decode())
    except (URLError, OSError):
        return ""


def children_of(pid: int) -> list[int]:
    try:
        return [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


# Files that values from a browser may name: those of the offered folder, and nothing is quoted


SECRET = "root:x:0:0:of:one:line,only"


@pytest.fixture
def files_desk(tmp_path: Path) -> TestClient:
    specs = tmp_path / "specs"
    (specs / "deep").mkdir(parents=True)
    written(specs)
    (tmp_path / "secret.txt").write_text(SECRET + "\n")
    (specs / "link.csv").symlink_to(tmp_path / "secret.txt")
    (specs / "loop.csv").symlink_to(specs / "loop.csv")
    (specs / "mine.csv").write_text("of, mine\n")
    (specs / "deep" / "mine.csv").write_text("of, mine\n")
    return dashboard(tmp_path)


def asked(files_desk: TestClient, do: str, overrides: str) -> tuple[int, str]:
    settings: Any = files_desk.app.state.settings  # type: ignore[attr-defined]
    form = {"csrf": settings.csrf, "spec": "asks.yaml", "do": do, "overrides": overrides}
    answer = files_desk.post("/start", data=form, follow_redirects=False)
    assert not settings.runs.exists()
    return answer.status_code, unescape(re.sub("<[^>]+>", "", answer.text))


@pytest.mark.parametrize(
    "overrides",
    [
        "excitation.file=/etc/passwd",
        "excitation.file=/no/such/file",
        "excitation.file=/proc/self/environ",
        "excitation.file=../secret.txt",
        "excitation.file=deep/../../secret.txt",
        "excitation.file=link.csv",
        "excitation.file=loop.csv",
        'excitation.file="\\\\x2fetc/passwd"',
        "excitation={kind: dwell, waypoints: 2, file: ../secret.txt}",
        "excitation={kind: dwell, waypoints: 2, file: &a ../secret.txt}",
        "fit=[{estimator: static-wls, prior: /etc/passwd}]",
        "fit=[{estimator: static-wls, prior: [a, {b: ../secret.txt}]}]",
        "interlocks=[{kind: of-a-plug-in, limits: ../secret.txt}]",
    ],
)
@pytest.mark.parametrize("do", ["check", "start"])
def test_a_file_outside_is_neither_read_nor_told_of(
    files_desk: TestClient, overrides: str, do: str
) -> None:
    status, text = asked(files_desk, do, overrides.replace("\\\\", "\\"))
    assert status == 422
    assert "is not in the folder of specs" in text
    assert SECRET[:6] not in text


@pytest.mark.parametrize("file", ["mine.csv", "deep/mine.csv", "./deep/../mine.csv"])
def test_a_file_of_the_offered_folder_is_read(files_desk: TestClient, file: str) -> None:
    status, text = asked(files_desk, "check", f"excitation.file={file}")
    assert status == 422
    assert "neither a pose nor the joints' names: of, mine" in text


@pytest.mark.parametrize("do", ["check", "start"])
def test_a_file_that_no_program_has_is_not_read(files_desk: TestClient, do: str) -> None:
    with (files_desk.app.state.settings.specs / "long.csv").open("wb") as file:  # type: ignore[attr-defined]
        file.truncate(10**10)
    status, text = asked(files_desk, do, "excitation.file=long.csv")
    assert status == 422
    assert "more than 20 MB" in text


def test_prose_may_look_like_a_path(files_desk: TestClient) -> None:
    status, text = asked(files_desk, "check", "description=see /etc\nexcitation.waypoints=none")
    assert status == 422
    assert "is not in the folder" not in text


def test_every_key_that_is_a_file_is_known() -> None:
    """Of the keys that are told to be paths or files; a new one belongs into `FILE_KEYS`."""
    found = {
        name
        for _, model in tree(ExperimentSpec)
        for name, field in model.model_fields.items()
        if str in getattr(field.annotation, "__args__", (field.annotation,))
        and re.search(r"\b(path|file|folder)\b", field.description or "", re.IGNORECASE)
    }
    assert found - {"file_unit"} == set(FILE_KEYS)


@pytest.mark.parametrize(
    "text",
    ["s" * 500, "s" * 200_000, "0,0\n0," + "s" * 500, "0,0\n0," + "9" * 500, "0,0\n" + "s" * 500],
)
def test_of_a_line_that_is_no_pose_little_is_quoted(tmp_path: Path, text: str) -> None:
    path = tmp_path / "0.csv"
    path.write_text(text)
    try:
        told = "\n".join(read_waypoints(path, ["a", "b"], "deg").problems)
    except SpecError as error:
        told = error.message
    assert told.startswith(f"{path}:")
    assert max(map(len, re.findall("sss+|999+", told)), default=0) <= MOST_QUOTED


# A start that found its robot held leads to the run that holds it


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(tmp_path / "runs", tmp_path / "registry", port=8350)


def words(run: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """What `hil run` says of a robot that a run has."""
    monkeypatch.setenv("HIL_LEASES", str(run.parent / "leases"))
    robot: Any = SimpleNamespace(resource="arm-17")
    about = {"name": "ur5", "driver": "mock", "station": "bench"}
    with leased(robot, **about) as lease:
        lease.note_run(run)
        with pytest.raises(RobotConnectionError) as refused:
            leased(robot, **about)
    return f"RobotConnectionError: {refused.value.message}"


def test_the_page_of_the_start_leads_to_the_run(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = settings.runs / "2026-11-23" / "ur5" / "0006-ci-dwell-12"
    run.mkdir(parents=True)
    (settings.runs / FOLDER).mkdir()
    said = Started(
        id="17", runs=str(settings.runs), spec="a.yaml", station="", operator="anna", pid=1,
        ticks=1, time=0.0, host=platform.node(),
    )  # fmt: skip
    (settings.runs / FOLDER / "17.json").write_text(json.dumps(asdict(said)))
    said.log.write_text(f"{words(run, monkeypatch)}\n  next: wait\n")
    text = TestClient(create_app(settings), base_url="http://127.0.0.1:8350").get("/start/17").text
    link = '<a href="/runs/2026-11-23/ur5/0006-ci-dwell-12">2026-11-23/ur5/0006-ci-dwell-12</a>'
    assert f"a.yaml did not start: robot ur5 is held by run {link}." in text


def test_a_run_kept_elsewhere_and_other_words_lead_nowhere(
    settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings.runs.mkdir()
    elsewhere = tmp_path / "others" / "0001-a"
    elsewhere.mkdir(parents=True)
    assert lock_owner([words(elsewhere, monkeypatch), "SpecError: a", ""], settings) is None
