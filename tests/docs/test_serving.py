"""Every documented line that serves the dashboard serves it, at the address that it prints."""

from __future__ import annotations

import http.client
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.support import docs_commands

pytestmark = pytest.mark.wire

LINE = re.compile(r"^(?:ExecStart=)?(?:\S*/)?(hil serve\b.*?)\s*(?:#.*)?$", re.M)
LINES = sorted(
    {
        line
        for page in docs_commands.PAGES
        for block in docs_commands.blocks(page)
        for line in LINE.findall(block.text)
    }
)


def test_the_documentation_serves_here_to_everybody_and_by_systemd() -> None:
    assert "hil serve" in LINES
    assert sum("--host 0.0.0.0" in line for line in LINES) >= 2
    assert any("--schedules" in line for line in LINES)


@pytest.mark.parametrize("line", LINES)
def test_what_it_prints_is_where_the_dashboard_is(line: str, tmp_path: Path) -> None:
    for folder in ("experiments", "specs"):
        (tmp_path / folder).mkdir()
    env = {key: value for key, value in os.environ.items() if not key.startswith("HIL_")}
    with subprocess.Popen(
        [sys.executable, "-m", *shlex.split(line)],
        cwd=tmp_path,
        env=env,
        stdout=subprocess.PIPE,
        text=True,
    ) as serving:
        try:
            assert serving.stdout is not None
            printed = serving.stdout.readline().removeprefix("dashboard: ").strip()
            assert status_of(printed) == 200
        finally:
            serving.terminate()
        assert serving.wait(20) == 130  # as every command that a signal ends


def status_of(address: str) -> int:
    """What a browser gets there that knows the name, cookies kept and forwardings followed."""
    parts = urlsplit(address)
    assert parts.port is not None
    line = http.client.HTTPConnection("127.0.0.1", parts.port, timeout=10)
    path, cookie = f"{parts.path}?{parts.query}", ""
    for _ in range(3):
        line.request("GET", path, headers={"Host": parts.netloc, "Cookie": cookie})
        answer = line.getresponse()
        answer.read()
        if answer.status not in (302, 303, 307):
            break
        path = answer.headers["Location"]
        cookie = (answer.headers["Set-Cookie"] or cookie).partition(";")[0]
    line.close()
    return answer.status
