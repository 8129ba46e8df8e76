"""What `hil serve` says of a port that is taken."""

from __future__ import annotations

import socket

import pytest

from hil.core.errors import RobotConnectionError
from hil.dashboard import server


def test_a_port_that_is_taken_is_told_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(RobotConnectionError) as caught:
            server.listen("127.0.0.1", port)
    assert caught.value.message == f"cannot listen on 127.0.0.1:{port}: Address already in use"
