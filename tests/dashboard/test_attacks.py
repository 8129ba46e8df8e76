"""A dashboard under attack: slow requests, broken ones, and too many; Stop goes on to work."""

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
from pathlib import Path
from unittest.mock import Mock
from urllib.parse import urlsplit

import pytest

pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')

import uvicorn
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from hil.core.lock_file import hold_run
from hil.core.throttle import OncePerMinute
from hil.dashboard.limits import LimitedProtocol, Limits
from hil.dashboard.server import create_app
from hil.dashboard.settings import Settings
from hil.recording.run_directory import RunDirectory
from tests.support.waiting import until

HERE = "http://127.0.0.1:8350"
TOKEN = "correct horse battery staple"
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
            assert b"does not listen at the moment" in answer  # found, and its process is a test
            serving.send_signal(signal.SIGINT)
            serving.wait(WITHIN_S)
        finally:
            serving.kill()
    lines = log.read_text().splitlines()
    assert "Traceback" not in log.read_text()
    assert len(lines) < 10, lines
