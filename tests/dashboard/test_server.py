"""The dashboard's server: who may look and act, attacks, names, ports, and its end."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock
from urllib.parse import urlsplit

import pytest
import uvicorn
from starlette.routing import Route
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from hil.cli.serve import serve, specs_folder
from hil.core.errors import RobotConnectionError, SpecError
from hil.core.lock_file import hold_run
from hil.core.throttle import OncePerMinute
from hil.dashboard import server
from hil.dashboard.limits import LimitedProtocol, Limits, StreamLimit
from hil.dashboard.security import MOST_BYTES, POLICY
from hil.dashboard.server import browser_address, create_app
from hil.dashboard.settings import Settings
from hil.recording.run_directory import RunDirectory
from tests.support.waiting import until
from tests.support.web_parts import failing

# Who may look at the dashboard, and who may act: also on loopback, where any web page can post


HERE = "http://127.0.0.1:8350"
TOKEN = "correct horse battery staple"


def settings(tmp_path: Path, **more: object) -> Settings:
    return Settings(runs=tmp_path / "runs", registry=tmp_path / "registry", port=8350, **more)


def client(made: Settings, base: str = HERE) -> TestClient:
    return TestClient(create_app(made), base_url=base, follow_redirects=False)


@pytest.fixture
def own(tmp_path: Path) -> Settings:
    return settings(tmp_path)


@pytest.mark.parametrize(
    ("host", "known"),
    [
        ("127.0.0.1:8350", True),
        ("localhost:8350", True),
        ("[::1]:8350", True),
        ("127.0.0.1.evil.example", False),
        ("evil.example:8350", False),
        ("192.168.0.7:8350", False),
        ("", False),
    ],
)
def test_on_loopback_only_names_of_loopback_are_ours(own: Settings, host: str, known: bool) -> None:
    answer = client(own).get("/", headers={"host": host})
    assert (answer.status_code == 200) is known


def test_elsewhere_addresses_and_given_names_are_ours(tmp_path: Path) -> None:
    made = settings(tmp_path, host="0.0.0.0", names=("lab-pc",), token=TOKEN)
    assert made.knows("192.168.0.7:8350")
    assert made.knows("LAB-PC:8350")
    assert not made.knows("evil.example")


def test_a_form_of_ours_is_taken(own: Settings) -> None:
    answer = client(own).post("/who", data={"csrf": own.csrf, "who": "Žofie & co"})
    assert answer.status_code == 303
    assert "HttpOnly" in answer.headers["set-cookie"]
    assert "SameSite=strict" in answer.headers["set-cookie"]
    named = client(own)
    named.cookies.set("hil_who", answer.headers["set-cookie"].split(";")[0].partition("=")[2])
    assert 'value="Žofie &amp; co"' in named.get("/").text


@pytest.mark.parametrize("shown", ["", "x", "ž", None])
def test_a_form_without_the_value_only_our_pages_show_is_refused(
    own: Settings, shown: str | None
) -> None:
    data = {"who": "me"} | ({} if shown is None else {"csrf": shown})
    answer = client(own).post("/who", data=data)
    assert answer.status_code == 403
    assert "reload" in answer.text
    assert "set-cookie" not in answer.headers


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "https://evil.example"},
        {"origin": "null"},
        {"origin": "http://127.0.0.1:9999"},
        {"sec-fetch-site": "cross-site"},
        {"sec-fetch-site": "same-site"},
    ],
)
def test_what_another_site_asks_is_refused_though_it_knew_the_value(
    own: Settings, headers: dict[str, str]
) -> None:
    answer = client(own).post("/who", data={"csrf": own.csrf, "who": "me"}, headers=headers)
    assert answer.status_code == 403
    assert "different site" in answer.text


def test_our_own_origin_may_ask(own: Settings) -> None:
    headers = {"origin": HERE, "sec-fetch-site": "same-origin"}
    answer = client(own).post("/who", data={"csrf": own.csrf, "who": "me"}, headers=headers)
    assert answer.status_code == 303


def test_a_huge_form_is_refused(own: Settings) -> None:
    answer = client(own).post("/who", content=b"a" * (MOST_BYTES + 1))
    assert answer.status_code == 403
    assert str(MOST_BYTES) in answer.text


def test_read_only_nothing_can_be_asked(tmp_path: Path) -> None:
    made = settings(tmp_path, read_only=True)
    answer = client(made).post("/who", data={"csrf": made.csrf, "who": "me"})
    assert answer.status_code == 403
    shown = client(made).get("/").text
    assert "read-only" in shown
    assert "<form" not in shown


def test_without_the_token_nothing_is_shown(tmp_path: Path) -> None:
    made = settings(tmp_path, token=TOKEN)
    for path in ("/", "/runs", "/static/hil.css", "/?token=wrong", "/nothing"):
        answer = client(made).get(path)
        assert answer.status_code == 401
        assert "hil serve" in answer.text
    refused = client(made).post("/who", data={"csrf": made.csrf, "who": "me"})
    assert refused.status_code == 401


def test_the_token_opens_once_and_leaves_the_address(tmp_path: Path) -> None:
    made = settings(tmp_path, token=TOKEN)
    visitor = client(made)
    first = visitor.get("/", params={"token": TOKEN, "query": "a b"})
    assert first.status_code == 303
    assert first.headers["location"] == "/?query=a+b"
    assert visitor.get("/").status_code == 200  # by its cookie
    assert client(made).get("/", headers={"authorization": f"Bearer {TOKEN}"}).status_code == 200


def test_a_token_in_an_address_does_not_let_anything_be_asked(tmp_path: Path) -> None:
    made = settings(tmp_path, token=TOKEN)
    answer = client(made).post("/who", params={"token": TOKEN}, data={"csrf": made.csrf})
    assert answer.status_code == 401


@pytest.mark.parametrize("path", ["/", "/nothing", "/static/hil.css"])
def test_every_answer_carries_the_policy(own: Settings, path: str) -> None:
    answer = client(own).get(path)
    assert answer.headers["content-security-policy"] == POLICY
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["cache-control"] == "no-store"


def test_a_form_leads_back_only_to_pages_of_ours(own: Settings) -> None:
    for referer in ("https://evil.example/x", f"{HERE}//evil.example/x", "javascript:alert(1)"):
        data = {"csrf": own.csrf, "who": "me"}
        answer = client(own).post("/who", data=data, headers={"referer": referer})
        assert not answer.headers["location"].startswith("//")
        assert "evil" not in answer.headers["location"] or answer.headers["location"][1] != "/"


def test_what_is_not_there_is_told_as_a_page_or_as_json(own: Settings) -> None:
    page = client(own).get("/<b>x", headers={"accept": "text/html"})
    assert page.status_code == 404
    assert "<b>x" not in page.text
    assert client(own).get("/nothing").json()["error"]


def test_a_page_that_fails_says_so_and_leaves_the_others(own: Settings) -> None:
    def broken(request: object) -> None:
        raise ValueError("two <b>")

    made = create_app(own)
    made.router.routes.insert(0, Route("/broken", broken))
    visitor = TestClient(made, base_url=HERE, raise_server_exceptions=False)
    answer = visitor.get("/broken", headers={"accept": "text/html"})
    assert answer.status_code == 500
    assert "ValueError: two &lt;b&gt;" in answer.text
    assert answer.headers["content-security-policy"] == POLICY
    assert visitor.get("/").status_code == 200


@pytest.mark.parametrize(
    ("headers", "taken"), [({"origin": HERE}, True), ({}, False), ({"origin": "null"}, False)]
)
def test_stop_is_taken_from_a_page_of_an_earlier_dashboard(
    own: Settings, headers: dict[str, str], taken: bool
) -> None:
    data = {"csrf": "of the one before"}
    answer = client(own).post("/runs/2026/ur5/0001-a/stop", data=data, headers=headers)
    assert answer.status_code == (404 if taken else 403)  # there is no such run
    other = client(own).post("/runs/2026/ur5/0001-a/pause", data=data, headers=headers)
    assert other.status_code == 403


def test_a_file_that_may_not_be_read_is_no_forbidden_form(own: Settings) -> None:
    def closed(request: object) -> None:
        raise PermissionError(13, "Permission denied", "/lab/runs")

    made = create_app(own)
    made.router.routes.insert(0, Route("/closed", closed))
    answer = TestClient(made, base_url=HERE).get("/closed")
    assert answer.status_code == 500
    assert "/lab/runs: Permission denied" in answer.json()["error"]


def test_a_token_of_the_environment_is_not_printed(tmp_path: Path) -> None:
    made = settings(tmp_path, token="k" * 16)
    assert browser_address(made) == f"http://127.0.0.1:{made.port}/?token={'k' * 16}"
    assert browser_address(replace(made, token_given=True)) == f"http://127.0.0.1:{made.port}/"
    assert "kkk" not in repr(made)


def test_a_network_may_not_guess_the_token(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HIL_TOKEN", "k" * 15)
    with pytest.raises(SpecError, match="15 characters"):
        serve(host="0.0.0.0", port=0)


def test_so_many_may_listen_and_no_more() -> None:
    waiting, over = 0, asyncio.Event()
    answers: list[int] = []

    async def forever(scope: object, receive: object, send: object) -> None:
        nonlocal waiting
        waiting += 1
        await over.wait()

    async def send(message: Any) -> None:
        if message["type"] == "http.response.start":
            answers.append(message["status"])

    async def listen(app: StreamLimit, path: str) -> None:
        await app({"type": "http", "method": "GET", "path": path}, None, send)  # type: ignore[arg-type]

    async def everybody() -> None:
        app = StreamLimit(forever, most=2)  # type: ignore[arg-type]
        paths = ["/events", "/runs/2026/ur5/0001-a/events", "/events", "/runs"]
        asked = [asyncio.create_task(listen(app, path)) for path in paths]
        await asyncio.sleep(0)
        assert (waiting, answers) == (3, [503])  # the page passes
        over.set()
        await asyncio.gather(*asked)
        await listen(app, "/events")  # there is room again
        assert (waiting, answers) == (4, [503])

    asyncio.run(everybody())


@pytest.mark.thorough
def test_as_many_files_may_be_open_as_are_allowed() -> None:
    told = (
        "import resource as r; from hil.dashboard import server\n"
        "r.setrlimit(r.RLIMIT_NOFILE, (64, 128)); server._allow_many_files()\n"
        "print(*r.getrlimit(r.RLIMIT_NOFILE))"
    )
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True)
    assert done.stdout.split() == ["128", "128"], done.stderr


def test_specs_offered_are_those_of_the_lab_or_of_this_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert specs_folder(None) == Path()
    Path("experiments").mkdir()
    assert specs_folder(None) == Path("experiments")
    with pytest.raises(SpecError, match="--specs elsewhere is not a folder"):
        specs_folder(Path("elsewhere"))


# Under which names the dashboard answers, and what it makes of headers that no browser sends


@pytest.mark.parametrize(
    ("host", "names"),
    [
        ("127.0.0.1", ()),
        ("127.0.0.2", ()),
        ("::1", ()),
        ("localhost", ()),
        ("0.0.0.0", ()),
        ("::", ()),
        ("", ()),
        ("0.0.0.0", ("bench.lab.example",)),
        ("192.168.0.7", ()),
        ("fd00::7", ()),
        ("Bench.lab.example", ()),
    ],
)
def test_the_printed_address_opens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, host: str, names: tuple[str, ...]
) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "Bench-PC")
    made = settings(tmp_path, host=host, names=names, token=TOKEN, read_only=True)
    opened = browser_address(made)
    browser = TestClient(create_app(made), base_url=opened.partition("?")[0])
    answer = browser.get(opened)
    assert answer.status_code == 200, (opened, answer.text[:200])
    assert answer.url.path == "/"
    assert not made.knows("evil.example:8350")
    assert not made.knows("")


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"host": "[::1"}, 421),
        ({"host": "["}, 421),
        ({"host": "]"}, 421),
        ({"host": "[::1]evil.example"}, 421),
        ({"host": "[::1]:8350:1"}, 421),
        ({"host": "127.0.0.1:8350", "origin": "http://["}, 403),
        ({"host": "127.0.0.1:8350", "origin": "http://[::1"}, 403),
        ({"host": "127.0.0.1:8350", "origin": "http://\u2100@"}, 403),
        ({"host": "127.0.0.1:8350", "sec-fetch-site": "\xff"}, 403),
    ],
)
@pytest.mark.parametrize("token", ["", TOKEN])
def test_headers_that_no_browser_sends_are_refused_without_a_page(
    tmp_path: Path, headers: dict[str, str], status: int, token: str
) -> None:
    made = settings(tmp_path, token=token)
    visitor = TestClient(create_app(made), raise_server_exceptions=False)
    sent = {b"accept": b"text/html"}
    sent |= {name.encode(): value.encode() for name, value in headers.items()}
    answer = visitor.post("/who", data={"csrf": made.csrf}, headers=sent)
    assert answer.status_code == (401 if token and status == 403 else status)
    assert_bare(answer, made)


def test_a_guard_that_fails_lets_nobody_in_and_shows_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "hil.dashboard.security.Guard._token_refusal", failing(RuntimeError("a mistake"))
    )
    made = settings(tmp_path, token=TOKEN)
    visitor = TestClient(
        create_app(made), base_url="http://127.0.0.1:8350", raise_server_exceptions=False
    )
    answer = visitor.get("/", headers={"accept": "text/html"})
    assert answer.status_code == 400
    assert_bare(answer, made)


def test_a_referer_that_is_no_address_leads_to_the_overview(tmp_path: Path) -> None:
    made = settings(tmp_path)
    visitor = TestClient(create_app(made), base_url="http://127.0.0.1:8350", follow_redirects=False)
    data = {"csrf": made.csrf, "who": "anna"}
    assert (
        visitor.post("/who", data=data, headers={"referer": "http://["}).headers["location"] == "/"
    )


def assert_bare(answer: Any, made: Settings) -> None:
    """Nothing of the dashboard is in it, and the policy is."""
    assert answer.headers["content-type"].startswith("text/plain")
    assert answer.headers["content-security-policy"] == POLICY
    assert made.csrf not in answer.text
    assert "<" not in answer.text


# A dashboard under attack: slow requests, broken ones, and too many; Stop goes on to work


pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')
SHORT = Limits(headers_s=0.2, body_s=0.2, unread_s=0.2, arriving=3)
WITHIN_S = 20.0
PATIENT = Limits(headers_s=600.0, body_s=600.0, unread_s=600.0, arriving=3)
UPGRADE = {"connection": "upgrade", "upgrade": "websocket", "sec-websocket-version": "13",
           "sec-websocket-key": "dGhlIHNhbXBsZSBub25jZQ=="}  # fmt: skip


@contextlib.contextmanager
def listening(settings: Settings, limits: Limits) -> Iterator[tuple[str, int]]:
    """The dashboard on a port, in a thread, with such limits."""
    protocol = type("Protocol", (LimitedProtocol,), {"limits": limits})
    config = uvicorn.Config(
        create_app(settings), lifespan="off", log_config=None, http=protocol, ws="none",
        timeout_graceful_shutdown=1,
    )  # fmt: skip
    server = uvicorn.Server(config)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        thread = threading.Thread(target=server.run, args=([taken],))
        thread.start()
        try:
            yield taken.getsockname()
        finally:
            server.should_exit = True
            thread.join(WITHIN_S)


def settings_in(tmp_path: Path, **more: object) -> Settings:
    return Settings(runs=tmp_path / "runs", registry=tmp_path / "registry", port=8350, **more)


def connected(where: tuple[str, int], said: str) -> socket.socket:
    made = socket.create_connection(where, WITHIN_S)
    made.sendall(said.encode())
    return made


def heard(connection: socket.socket) -> bytes:
    """Everything until the other end closes, which it does in time."""
    told = b""
    with contextlib.suppress(ConnectionResetError):
        while part := connection.recv(65536):
            told += part
    return told


HEAD = "POST /who HTTP/1.1\r\nHost: 127.0.0.1:8350\r\n"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("said", "status"),
    [
        ("", b"408"),
        ("GET / HT", b"408"),
        (HEAD, b"408"),
        (HEAD + "Content-Length: 9\r\n\r\ncsrf", b""),
        (HEAD + "Transfer-Encoding: chunked\r\n\r\n1\r\na\r\n", b""),
        ("GET / HTTP/1.1\r\nHost: 127.0.0.1:8350\r\n\r\nGET /", b"200"),
    ],
    ids=["nothing", "a line", "headers", "a body", "chunks", "a second request"],
)
def test_a_request_that_never_ends_is_ended(tmp_path: Path, said: str, status: bytes) -> None:
    with listening(settings_in(tmp_path), SHORT) as where, connected(where, said) as slow:
        assert heard(slow)[9:12] == status


def test_a_byte_now_and_then_moves_no_deadline(tmp_path: Path) -> None:
    with listening(settings_in(tmp_path), SHORT) as where, connected(where, HEAD) as slow:
        slow.settimeout(0.05)
        over = time.monotonic() + WITHIN_S
        while time.monotonic() < over:
            try:
                slow.sendall(b"a: b\r\n")
                if slow.recv(100):
                    return  # 408
            except TimeoutError:
                continue
            except ConnectionError:
                return
    pytest.fail("it is still open")


@pytest.mark.thorough
def test_events_go_on_past_every_limit(tmp_path: Path) -> None:
    head = "GET /events HTTP/1.1\r\nHost: 127.0.0.1:8350\r\n\r\n"
    with listening(settings_in(tmp_path), SHORT) as where, connected(where, head) as page:
        told = b""
        while told.count(b"event: beat") < 2:  # one every two seconds
            part = page.recv(4096)
            assert part, "the stream has ended"
            told += part


def test_an_answer_that_is_not_read_is_given_up(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    head = "GET /static/hil.css HTTP/1.1\r\nHost: 127.0.0.1:8350\r\n\r\n"
    with listening(settings_in(tmp_path), SHORT) as where, socket.socket() as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.connect(where)
        deaf.sendall(1000 * head.encode())
        until(lambda: "an answer was not read for 0.2 s" in caplog.text, WITHIN_S)


def test_an_answer_that_is_read_slowly_is_not(tmp_path: Path) -> None:
    left, later = [300], []  # bytes that wait, and what is due next
    config = uvicorn.Config(create_app(settings_in(tmp_path)), log_config=None)
    with contextlib.closing(asyncio.new_event_loop()) as loop:
        slow = LimitedProtocol(config, uvicorn.server.ServerState(), {}, loop)
        slow.loop = Mock(call_later=lambda seconds, do, *to: later.append((do, to)) or Mock())
        slow.connection_made(Mock(get_write_buffer_size=lambda: left[0], is_closing=lambda: False))
        slow.data_received(b"GET / HTTP/1.1\r\nHost: 127.0.0.1:8350\r\n")
        slow.pause_writing()
        for left[0] in (200, 100):
            do, to = later.pop()
            do(*to)
            assert not slow.transport.abort.called
        do, to = later.pop()
        do(*to)  # nothing more was read
        assert slow.transport.close.called or slow.transport.abort.called


def test_the_oldest_of_too_many_gives_its_place_to_the_next(tmp_path: Path) -> None:
    head = "GET / HTTP/1.1\r\nHost: 127.0.0.1:8350\r\n"
    with listening(settings_in(tmp_path), PATIENT) as where, contextlib.ExitStack() as open_:
        slow = [open_.enter_context(connected(where, head)) for _ in range(4)]
        assert heard(slow[0])[9:12] == b"408"
        for one in slow[1:]:
            one.sendall(b"Connection: close\r\n\r\n")
            assert heard(one)[9:12] == b"200"


@pytest.mark.parametrize(
    ("headers", "status"),
    [({}, 400), ({"host": "evil.example"}, 421), ({"authorization": "Bearer x"}, 401)],
    ids=["ours", "another host", "no token"],
)
def test_an_upgrade_meets_the_guard_and_is_refused(
    tmp_path: Path, headers: dict[str, str], status: int
) -> None:
    made = settings_in(tmp_path, token=TOKEN)
    shown = {"host": "127.0.0.1:8350", "authorization": f"Bearer {TOKEN}"} | headers
    lines = "".join(f"{name}: {value}\r\n" for name, value in (UPGRADE | shown).items())
    with listening(made, SHORT) as where, connected(where, f"GET / HTTP/1.1\r\n{lines}\r\n") as one:
        answer = one.recv(65536)
        assert answer[9:12] == str(status).encode(), answer
        assert b"<" not in answer


def test_a_server_that_speaks_websockets_is_refused_too(tmp_path: Path) -> None:
    client = TestClient(create_app(settings_in(tmp_path)), base_url=HERE)
    with pytest.raises(WebSocketDisconnect), client.websocket_connect("/events"):
        pass


def test_a_line_of_a_kind_is_logged_once_a_minute(caplog: pytest.LogCaptureFixture) -> None:
    log = logging.getLogger("test.once")
    once = OncePerMinute(every_s=1000.0)
    log.addFilter(once)
    for _ in range(200):
        log.warning("a client left")
        log.warning("another kind %s", 1)
    assert [record.getMessage() for record in caplog.records] == ["a client left", "another kind 1"]


def test_what_was_left_out_is_counted_in_the_next_line(caplog: pytest.LogCaptureFixture) -> None:
    log = logging.getLogger("test.again")
    once = OncePerMinute(every_s=0.0)
    log.addFilter(once)
    log.warning("a client left")
    once._every_s = 1000.0
    (known,) = once._kinds.values()
    known.left_out = 199
    log.warning("a client left")
    assert caplog.messages[-1] == "a client left (199 more like it since the last line)"


@pytest.mark.wire
def test_stop_is_heard_while_500_slow_connections_are_open_and_200_posts_are_aborted(
    tmp_path: Path,
) -> None:
    run = RunDirectory.create(tmp_path / "runs", "ur5", "held")
    run.write_start({"uid": "u"})
    log = tmp_path / "serve.log"
    command = [sys.executable, "-m", "hil", "serve", "--port", "0"]
    environment = {**os.environ, "HIL_LEASES": str(tmp_path / "leases")}
    with (
        hold_run(run.path),
        log.open("wb") as errors,
        subprocess.Popen(
            command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment
        ) as serving,
        contextlib.ExitStack() as open_,
    ):
        try:
            assert serving.stdout is not None
            where = urlsplit(serving.stdout.readline().removeprefix("dashboard: ").strip())
            there = (where.hostname or "", where.port or 0)
            head = f"POST /who HTTP/1.1\r\nHost: {where.netloc}\r\n"
            for _ in range(200):
                with connected(there, f"{head}Content-Length: 9\r\n\r\ncsrf"):
                    pass
            for _ in range(500):
                open_.enter_context(connected(there, head))
            body = "csrf=of+an+earlier+page"
            ask = (
                f"POST /runs/{run.path.relative_to(tmp_path / 'runs')}/stop HTTP/1.1\r\n"
                f"Host: {where.netloc}\r\nOrigin: http://{where.netloc}\r\nConnection: close\r\n"
                "Content-Type: application/x-www-form-urlencoded\r\n"
                f"Content-Length: {len(body)}\r\n\r\n{body}"
            )
            with connected(there, ask) as asked:
                answer = heard(asked)
            assert b"does not accept requests at present" in answer  # its process is a test
            serving.send_signal(signal.SIGINT)
            serving.wait(WITHIN_S)
        finally:
            serving.kill()
    lines = log.read_text().splitlines()
    assert "Traceback" not in log.read_text()
    assert len(lines) < 10, lines


# How `hil serve` ends while pages listen: in time, and without a word


@pytest.mark.wire
@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_nothing_is_printed_when_it_ends_with_a_page_open(tmp_path: Path, by: int) -> None:
    command = [sys.executable, "-m", "hil", "serve", "--port", "0"]
    environment = {**os.environ, "HIL_LEASES": str(tmp_path / "leases")}
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=environment,
    ) as serving:  # fmt: skip
        try:
            assert serving.stdout is not None
            where = urlsplit(serving.stdout.readline().removeprefix("dashboard: ").strip())
            host, port = where.hostname or "", where.port or 0
            with socket.create_connection((host, port), 10) as page:
                page.sendall(f"GET /events HTTP/1.1\r\nHost: {where.netloc}\r\n\r\n".encode())
                heard = b""

                def told() -> bool:
                    nonlocal heard
                    heard += page.recv(4096)
                    return b"event: live" in heard

                until(told, 10)
                serving.send_signal(by)
                said, errors = serving.communicate(timeout=10)
                while part := page.recv(4096):
                    heard += part
        finally:
            serving.kill()
    assert said == ""
    assert errors == "Ctrl-C ends the dashboard; runs that were started from it continue.\n"
    assert heard.endswith(b"0\r\n\r\n")  # the page hears that it is over, and not that it is lost


# What `hil serve` says of a port that is taken


def test_a_port_that_is_taken_is_told_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(RobotConnectionError) as caught:
            server.listen("127.0.0.1", port)
    assert caught.value.message == f"cannot listen on 127.0.0.1:{port}: Address already in use"
