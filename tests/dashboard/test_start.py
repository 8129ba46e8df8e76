"""Starting runs from the dashboard: what is offered, what is checked, what becomes of it."""

from __future__ import annotations

import base64
import re
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.testclient import TestClient

from hil.core.errors import RecordingError
from hil.dashboard.server import create_app
from hil.dashboard.settings import Settings
from hil.dashboard.start_page import Idempotency
from hil.recording.run_directory import RunDirectory
from hil.workflow.background_runs import started_runs
from tests.support.started_parts import PROMPT, written
from tests.support.waiting import until

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
        ({"overrides": "excitation.waypoints"}, "changes nothing"),
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
        assert "did not begin" in ended.text
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
    assert "once started, the run plans anew from where the arm stands" in answer.text
    assert "--connect" not in answer.text
    assert "hil run" not in answer.text


@pytest.mark.thorough
def test_a_first_time_is_planned_slower_and_shorter(desk: Desk) -> None:
    whole = rows_of(desk.post(do="check").text)
    answer = desk.post(do="check", speed="25%", first="4")
    shown = rows_of(answer.text)
    assert shown["part of the program"] == "at 25 % of the speed, only the first 4 of 12 measured"
    assert (whole["poses"], shown["poses"]) == ("12", "4")
    assert "condition number" not in shown
    assert "nothing is fitted or judged" in answer.text
    assert re.search(r"<option selected>25%<", answer.text)
    assert 'name="first" value="4"' in answer.text


@pytest.mark.parametrize(("field", "value"), [("speed", "300%"), ("speed", "x"), ("first", "-1")])
@pytest.mark.parametrize("do", ["check", "start"])
def test_a_part_that_cannot_be_is_said(desk: Desk, field: str, value: str, do: str) -> None:
    answer = desk.post(do=do, **{field: value})
    assert answer.status_code == 422
    assert "cannot be" in answer.text
    assert not desk.settings.runs.exists()


def test_the_part_is_started_and_another_part_is_another_run(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts, form = Starts(), once(desk)
    monkeypatch.setattr("hil.dashboard.start_page.start_run", starts)
    for first in ("4", "4", "5"):
        desk.post(do="start", once=form, speed="10%", first=first)
    assert [(one["speed"], one["first"]) for one in starts.what] == [("10%", "4"), ("10%", "5")]
