"""What is asked of a run in the dashboard: the question that was read, and Stop at any time."""

from __future__ import annotations

import asyncio
import html
import json
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlencode

import pytest
from starlette.requests import Request
from starlette.testclient import TestClient

from hil.core.errors import DataError
from hil.core.lock_file import hold_run
from hil.dashboard import live_runs, plan_preview, run_page, start_page
from hil.dashboard.limits import THREADS, StreamLimit
from hil.dashboard.server import create_app
from hil.dashboard.settings import Settings
from hil.recording.run_directory import RunDirectory
from hil.workflow.live_state import LIVE_FILE, LiveState, read_live
from hil.workflow.remote_control import answer_run, question_of, waiting

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
        with pytest.raises(DataError, match="asks nothing"):
            question_of(held.path)
        held.view = LiveState(held.path)
        held.asks("Mount the 3 kg disc")
        refused = held.answer(old)
        assert "asks something else now" in refused.text
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
    assert "asks something else now" in late.json()["error"]
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


@pytest.mark.parametrize(("do", "refused"), [("check", 58), ("start", 0)])
def test_stop_finds_a_thread_while_everybody_plans_or_starts(
    do: str, refused: int, held: Held, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.yaml").write_text("hil: 1\n")
    over, busy = threading.Event(), []

    def slow(*_: Any) -> tuple[()]:
        busy.append(1)
        over.wait(5)
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

    async def hurry() -> tuple[float, int, list[int]]:
        checks = [
            asyncio.create_task(asked(held.app, "/start", csrf=csrf, spec="a.yaml", do=do))
            for _ in range(60)
        ]
        while not busy:
            await asyncio.sleep(0.01)
        begin = time.monotonic()
        stopped = await asked(held.app, f"{held.address}/stop", csrf=csrf)
        took = time.monotonic() - begin
        # The others are told at once, while two are still made.
        while sum(one.done() for one in checks) < refused and time.monotonic() < begin + 4:
            await asyncio.sleep(0.01)
        told = [one.result() for one in checks if one.done()]
        over.set()
        await asyncio.gather(*checks)
        return took, stopped, told

    took, stopped, told = asyncio.run(hurry())
    assert stopped == 200
    assert took < 2.0
    assert [one["what"] for one in held.dropped()] == ["stop"]
    assert told == [503] * refused
    assert len(busy) == 60 - refused


def test_stop_finds_a_thread_while_everybody_goes_on(
    held: Held, monkeypatch: pytest.MonkeyPatch
) -> None:
    over, busy = threading.Event(), []

    def slow(*_: Any, **__: Any) -> Any:
        busy.append(1)
        over.wait(5)
        return SimpleNamespace(id="1")

    monkeypatch.setattr(run_page, "resumption_of", lambda *_: ("", False))
    monkeypatch.setattr(run_page, "go_on_with", slow)
    csrf = held.settings.csrf

    async def hurry() -> tuple[float, int]:
        path = f"{held.address}/go-on"
        sent = [
            asyncio.create_task(asked(held.app, path, csrf=csrf, once=str(i))) for i in range(60)
        ]
        while len(busy) < THREADS["start"]:  # nobody waits for another's start
            await asyncio.sleep(0.01)
        begin = time.monotonic()
        stopped = await asked(held.app, f"{held.address}/stop", csrf=csrf)
        took = time.monotonic() - begin
        over.set()
        await asyncio.gather(*sent)
        return took, stopped

    took, stopped = asyncio.run(asyncio.wait_for(hurry(), 10))
    assert stopped == 200
    assert took < 2.0
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
