"""Under which names the dashboard answers, and what it makes of headers that no browser sends."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from hil.dashboard.security import POLICY
from hil.dashboard.server import browser_address, create_app
from hil.dashboard.settings import Settings
from tests.support.web_parts import failing

TOKEN = "correct horse battery staple"


def settings(tmp_path: Path, **more: Any) -> Settings:
    return Settings(runs=tmp_path / "runs", registry=tmp_path / "registry", port=8350, **more)


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
