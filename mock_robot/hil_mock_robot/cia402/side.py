"""The side channel: what tests ask of the mock itself, past every bus.

One JSON object a line over a socket of this user, each answered by one line; `{"error": …}` when
it cannot be.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hil.can import private_folder
from hil.core import HilError, PluginError, SpecError
from hil_mock_robot.cia402.faults import Target
from hil_mock_robot.cia402.station import Station
from hil_mock_robot.cia402.truths import truth_of
from hil_mock_robot.server.faults import Faults
from hil_mock_robot.server.side_channel import Request, SideClient, payload_in, torque_in

Answer = dict[str, Any]


class Requests:
    """What may be asked, whoever asks.

    Args:
        station: The drives.
        faults: What is wrong with them.
    """

    def __init__(self, station: Station, faults: Faults[Target]) -> None:
        self._station, self._faults = station, faults
        self._answers: dict[str, Callable[[Request], Answer]] = {
            "fault": self._fault,
            "clear": self._clear,
            "state": self._state,
            "push": self._push,
            "mount": self._mount,
        }

    def answer(self, request: object) -> Answer:
        """Do it.

        Raises:
            HilError: It cannot be done.
        """
        do = request.get("do") if isinstance(request, dict) else None
        if not isinstance(request, dict) or not isinstance(do, str) or do not in self._answers:
            raise SpecError(
                f"the side channel does not know {request!r}",
                hint=f'send {{"do": …}} with one of {", ".join(self._answers)}',
            )
        return self._answers[do](request)

    def line(self, line: bytes) -> bytes:
        """The same as a line of JSON."""
        try:
            answer = self.answer(json.loads(line))
        except HilError as error:
            answer = {"error": error.message, "hint": error.hint}
        except (ValueError, RecursionError) as error:
            answer = {"error": f"no JSON: {error}", "hint": "send one JSON object a line"}
        return json.dumps(answer).encode() + b"\n"

    def _fault(self, request: Request) -> Answer:
        given = {key: value for key, value in request.items() if key != "do"}
        return {"fault": self._faults.add(given).kind}

    def _clear(self, request: Request) -> Answer:
        self._faults.clear()
        return {}

    def _state(self, request: Request) -> Answer:
        faults = [fault.kind for fault in self._faults.lasting]
        return {**truth_of(self._station), "faults": faults}

    def _push(self, request: Request) -> Answer:
        self._station.body.push(torque_in(request, len(self._station.axes)))
        return {}

    def _mount(self, request: Request) -> Answer:
        self._station.mount(payload_in(request))
        return {}


class SideChannel:
    """Listens for those who run the mock; nobody is waited for.

    Args:
        path: Of its socket; what a dead mock has left there is replaced.
        requests: What may be asked.

    Raises:
        PluginError: It cannot listen there.
    """

    def __init__(self, path: Path | str, requests: Requests) -> None:
        self.path, self._requests = Path(path), requests
        self._listening = _listening(self.path)
        self._clients: dict[socket.socket, SideClient] = {}

    @property
    def sockets(self) -> list[socket.socket]:
        """Readable when there is something to serve."""
        return [self._listening, *self._clients]

    def serve(self) -> None:
        """Answer what was asked, without waiting."""
        ready, _, _ = select.select(self.sockets, [], [], 0.0)
        if self._listening in ready:
            self._accept()
        for line, client in list(self._clients.items()):
            try:
                if line in ready:
                    client.ask(self._requests.line)
                client.hear(time.monotonic())
            except OSError:
                del self._clients[line]
                line.close()

    def close(self) -> None:
        """Hang up on everybody."""
        for each in self.sockets:
            each.close()
        with contextlib.suppress(OSError):
            self.path.unlink()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            line, _ = self._listening.accept()
            self._clients[line] = SideClient(line)


def _listening(path: Path) -> socket.socket:
    private_folder(path)
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if path.is_socket() and not _alive(path):
            path.unlink()
        listening.bind(os.fspath(path))
        path.chmod(0o600)
        listening.listen()
    except OSError as error:
        listening.close()
        raise PluginError(
            f"the side channel cannot listen at {path}: {error.strerror}",
            hint="end the mock that runs there, or give another --side",
        ) from error
    listening.setblocking(False)
    return listening


def _alive(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        return probe.connect_ex(os.fspath(path)) == 0
