"""Side channel of a mock: requests beside its protocol, for tests and for `hil mock … send`.

Each request is a JSON object on one line and is answered by one line, in order; a failed request is
answered by `{"error": …}`. All mocks support `fault`, `clear`, `state`, `push` and `mount`
(`Requests`); a mock can add further requests. `SideChannel` serves the requests over a socket of
the same user, and never waits for a client. `Tell` is the client side: an instance sends one
request from a shell.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import select
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.can import private_folder, runtime_folder
from hil.core import (
    CommandRefused,
    FloatArray,
    HilError,
    PluginError,
    RobotConnectionError,
    SpecError,
)
from hil_mock_robot.server.faults import Faults
from hil_mock_robot.server.options import (
    LEAST_FACTOR,
    MOST_FACTOR,
    MOST_KG,
    MOST_M,
    MOST_TORQUE_NM,
    numbers_of,
)

Request = Mapping[str, Any]
Answer = dict[str, Any]

LONGEST_LINE = 100_000
UNREAD_S = 1.0
"""Wall time [s] after which a client that does not read an answer is disconnected."""

ANSWER_S = 60.0
"""Maximum wait for an answer [s]; a long step of a mock in lock-step takes time."""

NO_SIDE = "none"
"""Value of `--side` for a mock without a side channel."""


class Requests(ABC):
    """Handler of the requests to a mock.

    Args:
        faults: Fault schedule of the mock.
        axes: Number of joints of the arm.

    Attributes:
        answers: Map from request to the function that returns its answer, or None if the answer
            follows later.
    """

    def __init__(self, faults: Faults[Any], axes: int) -> None:
        self.faults, self._axes = faults, axes
        self.answers: dict[str, Callable[[Request], Answer | None]] = {
            "fault": self._fault,
            "clear": self._clear,
            "state": self._state,
            "push": self._push,
            "mount": self._mount,
        }

    @abstractmethod
    def truth(self) -> Answer:
        """Return the true state of arm and mock, for tests."""

    @abstractmethod
    def push(self, torque: FloatArray) -> None:
        """Apply an external joint torque (n,) [N·m] from now on; zeros end it."""

    @abstractmethod
    def mount(self, payload: Payload | None) -> None:
        """Mount a payload, independent of the declared payload; None for the declared payload."""

    def answer(self, request: object) -> Answer | None:
        """Execute a request and return its answer.

        Raises:
            HilError: The request is unknown, invalid or refused.
        """
        do = request.get("do") if isinstance(request, dict) else None
        if not isinstance(request, dict) or not isinstance(do, str) or do not in self.answers:
            raise SpecError(
                f"unknown request {request!r}",
                hint=f'send {{"do": …}} with one of {", ".join(self.answers)}',
            )
        return self.answers[do](request)

    def line(self, line: bytes) -> Answer | None:
        """Return the answer to a line of JSON; an error is an answer too."""
        try:
            return self.answer(json.loads(line))
        except HilError as error:
            return {"error": error.message, "hint": error.hint}
        except (ValueError, RecursionError) as error:
            return {"error": f"not JSON: {error}", "hint": "send one JSON object a line"}

    def _fault(self, request: Request) -> Answer:
        given = {key: value for key, value in request.items() if key != "do"}
        return {"fault": self.faults.add(given).kind}

    def _clear(self, request: Request) -> Answer:
        self.faults.clear()
        return {}

    def _state(self, request: Request) -> Answer:
        return {**self.truth(), "faults": [fault.kind for fault in self.faults.lasting]}

    def _push(self, request: Request) -> Answer:
        self.push(torque_in(request, self._axes))
        return {}

    def _mount(self, request: Request) -> Answer:
        self.mount(payload_in(request))
        return {}


def torque_in(request: Request, n: int) -> FloatArray:
    """Return the external joint torque (n,) of a request [N·m].

    Raises:
        SpecError: The torque is invalid.
    """
    torque = numbers_of(request.get("torque"), n)
    if torque is None or max(map(abs, torque)) > MOST_TORQUE_NM:
        raise SpecError(
            f"push: invalid torque {request.get('torque')!r}",
            hint=f"give {n} numbers up to {MOST_TORQUE_NM:g} N·m; zeros end the push",
        )
    return np.array(torque)


def payload_in(request: Request) -> Payload | None:
    """Return the payload to mount; None for the declared payload.

    Raises:
        SpecError: Mass or centre of mass is invalid.
    """
    if request.get("mass_kg", 0) is None:
        return None
    mass = numbers_of([request.get("mass_kg")], 1)
    com = numbers_of(request.get("com_m", [0.0, 0.0, 0.0]), 3)
    if mass is None or com is None or not 0 <= mass[0] <= MOST_KG or max(map(abs, com)) > MOST_M:
        raise SpecError(
            f"mount: invalid payload {dict(request)}",
            hint=f"give mass_kg from 0 to {MOST_KG:g}, and com_m, three numbers up to {MOST_M:g} m",
        )
    return Payload(mass[0], (com[0], com[1], com[2]))


def factor_in(request: Request) -> float:
    """Return the device seconds per second of wall time in a request.

    Raises:
        SpecError: The factor is invalid.
    """
    number = numbers_of([request.get("factor")], 1)
    if number is None or not LEAST_FACTOR <= number[0] <= MOST_FACTOR:
        hint = f"use a number from {LEAST_FACTOR:g} to {MOST_FACTOR:g}"
        raise SpecError(f"speed: invalid factor {request.get('factor')!r}", hint=hint)
    return number[0]


def listed(values: FloatArray) -> list[float | None]:
    """Return an array as a list for JSON; non-finite numbers become None."""
    return [float(value) if math.isfinite(value) else None for value in values]


class SideChannel:
    """Server of the side channel for the operator of the mock.

    Args:
        path: Path of the server's socket; a socket file of a dead mock is replaced.
        requests: Handler that answers each request immediately.

    Raises:
        PluginError: The server cannot listen at this path.
    """

    def __init__(self, path: Path | str, requests: Requests) -> None:
        self.path, self._requests = Path(path), requests
        self._listening = _listening(self.path)
        self._clients: dict[socket.socket, _Client] = {}

    @property
    def sockets(self) -> list[socket.socket]:
        """Sockets of the server; one of them is readable if a request or a new client arrives."""
        return [self._listening, *self._clients]

    def serve(self) -> None:
        """Answer the waiting requests, without waiting for further requests."""
        ready, _, _ = select.select(self.sockets, [], [], 0.0)
        if self._listening in ready:
            with contextlib.suppress(OSError):
                line, _ = self._listening.accept()
                self._clients[line] = _Client(line)
        for line, client in list(self._clients.items()):
            try:
                if line in ready:
                    client.ask(self._answer)
                client.hear(time.monotonic())
            except OSError:
                del self._clients[line]
                line.close()

    def close(self) -> None:
        """Close all connections."""
        for each in self.sockets:
            each.close()
        with contextlib.suppress(OSError):
            self.path.unlink()

    def _answer(self, line: bytes) -> bytes:
        return json.dumps(self._requests.line(line)).encode() + b"\n"


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


def usual_path(name: str) -> str:
    """Return the default path of a mock's side channel."""
    return os.fspath(runtime_folder() / f"{name}.side")


class _Client:
    """Connection of one client, for which the mock never waits.

    Args:
        line: Socket of the connection.
    """

    def __init__(self, line: socket.socket) -> None:
        line.setblocking(False)
        self.line, self._asked, self._answers = line, b"", b""
        self._unread_s = time.monotonic()

    def ask(self, answer: Callable[[bytes], bytes]) -> None:
        """Read requests, and store the answers.

        Args:
            answer: Function that returns the answer to one line.

        Raises:
            OSError: The client has disconnected, or its request is too long.
        """
        data = self.line.recv(65_536)
        *lines, self._asked = (self._asked + data).split(b"\n")
        for line in lines:
            if line.strip():
                self._answers += answer(line)
        if not data or len(self._asked) > LONGEST_LINE:
            raise ConnectionError

    def hear(self, now_s: float) -> None:
        """Send as much of the stored answers as the client accepts.

        Args:
            now_s: Present time of the monotonic clock [s].

        Raises:
            OSError: The client has disconnected, or does not read.
        """
        while self._answers:
            try:
                sent = self.line.send(self._answers)
            except BlockingIOError:
                if now_s - self._unread_s > UNREAD_S:
                    raise
                return
            self._answers = self._answers[sent:]
            self._unread_s = now_s
        self._unread_s = now_s


@dataclass(frozen=True)
class Tell:
    """Command-line client of the side channel, which sends a request to a running mock.

    Attributes:
        command: Command of the mock, such as `hil mock ur`.
        who: Subject of the message that no mock answers.
        requests: Names of the requests, for the help.
        examples: Examples for the help.
        places: Map from an option that selects the mock to its type and help text.
        elsewhere: Hint that is printed if no mock listens.
        main_keys: Map from request to the key that is assumed for a value without a key.
    """

    command: str
    who: str
    requests: str
    examples: str
    places: Mapping[str, tuple[type, str]]
    elsewhere: str
    main_keys: Mapping[str, str] = field(default_factory=lambda: {"fault": "kind"})

    def add_to(self, parser: argparse.ArgumentParser) -> None:
        """Add the subcommand `send`, formerly `tell`, with a request to a command line."""
        commands = parser.add_subparsers(
            dest="command", metavar="[send REQUEST …]", parser_class=argparse.ArgumentParser
        )
        send = commands.add_parser(
            "send",
            help="send a request to a running mock, such as a fault, instead of starting a mock; "
            "see `send --help`",
            epilog=f"examples:\n{self.examples}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            description="Send one request to a running mock, and print its answer as JSON.",
        )
        commands.choices["tell"] = send  # former name, not listed in the help
        left_out = argparse.SUPPRESS  # a default would override an option before `send`
        for option, (kind, words) in self.places.items():
            send.add_argument(option, type=kind, default=left_out, help=words)
        send.add_argument("request", help=self.requests)
        send.add_argument("more", nargs="*", metavar="KEY=VALUE", help="keys of the request")

    def request(self, do: str, more: Sequence[str]) -> dict[str, Any]:
        """Return the request for the words of a command line; parse values as JSON if possible.

        Args:
            do: Name of the request.
            more: Words `KEY=VALUE`, or a value without a key.

        Raises:
            SpecError: A word has no key, or a key is repeated.
        """
        request: dict[str, Any] = {"do": do}
        for word in more:
            key, equals, value = word.partition("=")
            if not equals:
                key, value = self.main_keys.get(do, ""), word
            if not key or key in request:
                raise SpecError(f"send {do}: {word!r} is not KEY=VALUE", hint="such as for_s=2")
            request[key] = value
            with contextlib.suppress(ValueError):
                request[key] = json.loads(value)
        return request

    def ask(self, place: str | tuple[str, int], request: Request) -> Answer:
        """Send a request to a mock and return its answer.

        Args:
            place: Path of the socket, or address and port.
            request: Request; see the reference of the mock.

        Raises:
            RobotConnectionError: No mock answers at this path or address.
            CommandRefused: The mock answered with an error.
        """
        unix = isinstance(place, str)
        try:
            with socket.socket(socket.AF_UNIX if unix else socket.AF_INET) as line:
                line.settimeout(ANSWER_S)
                line.connect(place)
                line.sendall(json.dumps(request).encode() + b"\n")
                with line.makefile("r", encoding="utf-8") as answers:
                    answer = dict(json.loads(answers.readline()))
        except (OSError, ValueError) as error:
            where = place if isinstance(place, str) else f"{place[0]}:{place[1]}"
            raise RobotConnectionError(
                f"no {self.who} at {where}: {error}",
                hint=f"start one: {self.command}; {self.elsewhere}",
            ) from error
        if "error" in answer:
            raise CommandRefused(answer["error"], hint=answer.get("hint", ""))
        return answer
