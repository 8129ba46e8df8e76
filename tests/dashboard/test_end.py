"""How `hil serve` ends while pages listen: in time, and without a word."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.support.waiting import until

pytestmark = pytest.mark.wire


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
    assert (said, errors) == ("", "Ctrl-C ends it; runs that it started go on.\n")
    assert heard.endswith(b"0\r\n\r\n")  # the page hears that it is over, and not that it is lost
