"""Under which names the dashboard answers, and what it makes of headers that no browser sends."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from hil.web.app import create_app
from hil.web.serving import address
from hil.web.settings import Settings

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
    opened = address(made)
    browser = TestClient(create_app(made), base_url=opened.partition("?")[0])
    answer = browser.get(opened)
    assert answer.status_code == 200, (opened, answer.text[:200])
    assert answer.url.path == "/"
    assert not made.knows("evil.example:8350")
    assert not made.knows("")
