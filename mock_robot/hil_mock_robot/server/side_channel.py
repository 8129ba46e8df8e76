"""The side channel of a mock: requests past its protocol, for tests and for `hil mock … tell`.

One JSON object a line, each answered by one line, in order; `{"error": …}` when it cannot be. All
mocks know `fault`, `clear`, `state`, `push` and `mount` (`Requests`); a mock adds its own.
`SideChannel` serves them over a socket of this user, and waits for no client. `Tell` is the other
end: one request from a shell.
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
"""Wall time a client may leave an answer unread; it is hung up on then."""

ANSWER_S = 60.0
"""How long an answer may take: a long step of a mock in lock-step takes a while [s]."""

NO_SIDE = "none"
"""`--side none`: there is no side channel."""


class Requests(ABC):
    """Requests to a mock.

    Args:
        faults: Of the mock.
        axes: How many joints its arm has.

    Attributes:
        answers: Request → what answers it; None: the answer comes later.
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
        """Let an external joint torque (n,) [N·m] act from now on; zeros end it."""

    @abstractmethod
    def mount(self, payload: Payload | None) -> None:
        """Mount a load, whatever is declared; None for the declared one."""

    def answer(self, request: object) -> Answer | None:
        """Carry out a request and return its answer.

        Raises:
            HilError: It cannot be done.
        """
        do = request.get("do") if isinstance(request, dict) else None
        if not isinstance(request, dict) or not isinstance(do, str) or do not in self.answers:
            raise SpecError(
                f"the side channel does not know {request!r}",
                hint=f'send {{"do": …}} with one of {", ".join(self.answers)}',
            )
        return self.answers[do](request)

    def line(self, line: bytes) -> Answer | None:
        """Answer a line of JSON; errors are answers, too."""
        try:
            return self.answer(json.loads(line))
        except HilError as error:
            return {"error": error.message, "hint": error.hint}
        except (ValueError, RecursionError) as error:
            return {"error": f"no JSON: {error}", "hint": "send one JSON object a line"}

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
    """(n,) external joint torque [N·m].

    Raises:
        SpecError: It is none.
    """
    torque = numbers_of(request.get("torque"), n)
    if torque is None or max(map(abs, torque)) > MOST_TORQUE_NM:
        raise SpecError(
            f"push: torque is {request.get('torque')!r}",
            hint=f"give {n} numbers up to {MOST_TORQUE_NM:g} N·m; zeros end the push",
        )
    return np.array(torque)


def payload_in(request: Request) -> Payload | None:
    """Return the load to be mounted; None for the declared one.

    Raises:
        SpecError: It is no body.
    """
    if request.get("mass_kg", 0) is None:
        return None
    mass = numbers_of([request.get("mass_kg")], 1)
    com = numbers_of(request.get("com_m", [0.0, 0.0, 0.0]), 3)
    if mass is None or com is None or not 0 <= mass[0] <= MOST_KG or max(map(abs, com)) > MOST_M:
        raise SpecError(
            f"mount: {dict(request)}",
            hint=f"give mass_kg from 0 to {MOST_KG:g}, and com_m, three numbers up to {MOST_M:g} m",
        )
    return Payload(mass[0], (com[0], com[1], com[2]))


def factor_in(request: Request) -> float:
    """Device seconds per second of wall time.

    Raises:
        SpecError: That is no speed.
    """
    number = numbers_of([request.get("factor")], 1)
    if number is None or not LEAST_FACTOR <= number[0] <= MOST_FACTOR:
        hint = f"use a number from {LEAST_FACTOR:g} to {MOST_FACTOR:g}"
        raise SpecError(f"speed: factor is {request.get('factor')!r}", hint=hint)
    return number[0]


def listed(values: FloatArray) -> list[float | None]:
    """Return an array for JSON; None stands for NaN."""
    return [float(value) if math.isfinite(value) else None for value in values]


class SideChannel:
    """Listens for those who run the mock.

    Args:
        path: Of its socket; what a dead mock has left there is replaced.
        requests: Answers each request at once.

    Raises:
        PluginError: It cannot listen there.
    """

    def __init__(self, path: Path | str, requests: Requests) -> None:
        self.path, self._requests = Path(path), requests
        self._listening = _listening(self.path)
        self._clients: dict[socket.socket, _Client] = {}

    @property
    def sockets(self) -> list[socket.socket]:
        """Readable when there is something to serve."""
        return [self._listening, *self._clients]

    def serve(self) -> None:
        """Answer waiting requests, without waiting for more."""
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
    """One client; the mock never waits for it.

    Args:
        line: The connection.
    """

    def __init__(self, line: socket.socket) -> None:
        line.setblocking(False)
        self.line, self._asked, self._answers = line, b"", b""
        self._unread_s = time.monotonic()

    def ask(self, answer: Callable[[bytes], bytes]) -> None:
        """Read requests, and keep the answers.

        Args:
            answer: To one line.

        Raises:
            OSError: It has gone, or asks for too much.
        """
        data = self.line.recv(65_536)
        *lines, self._asked = (self._asked + data).split(b"\n")
        for line in lines:
            if line.strip():
                self._answers += answer(line)
        if not data or len(self._asked) > LONGEST_LINE:
            raise ConnectionError

    def hear(self, now_s: float) -> None:
        """Send answers as far as the client takes them.

        Args:
            now_s: Wall time, monotonic.

        Raises:
            OSError: It has gone, or does not read.
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
    """How a shell asks a mock that runs for something.

    Attributes:
        command: Such as `hil mock ur`.
        who: What does not answer where no mock listens.
        requests: Their names, for the help.
        examples: For the help.
        places: Options that say which mock: option → type, help.
        elsewhere: Hint where none listens.
        main_keys: Request → what a bare word after it means.
    """

    command: str
    who: str
    requests: str
    examples: str
    places: Mapping[str, tuple[type, str]]
    elsewhere: str
    main_keys: Mapping[str, str] = field(default_factory=lambda: {"fault": "kind"})

    def add_to(self, parser: argparse.ArgumentParser) -> None:
        """Add `tell` with a request to a command line, in place of starting a mock."""
        commands = parser.add_subparsers(
            dest="command", metavar="[tell REQUEST …]", parser_class=argparse.ArgumentParser
        )
        tell = commands.add_parser(
            "tell",
            help="in place of starting one: ask a mock that runs for something, such as a fault, "
            "or its end; `tell --help` tells more",
            epilog=f"examples:\n{self.examples}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            description="One request to a mock that runs; its answer is printed as JSON.",
        )
        left_out = argparse.SUPPRESS  # or it would overrule what stands before `tell`
        for option, (kind, words) in self.places.items():
            tell.add_argument(option, type=kind, default=left_out, help=words)
        tell.add_argument("request", help=self.requests)
        tell.add_argument("more", nargs="*", metavar="KEY=VALUE", help="what the request holds")

    def request(self, do: str, more: Sequence[str]) -> dict[str, Any]:
        """The request that words of a shell stand for; values are JSON where they can be.

        Args:
            do: The request's name.
            more: `KEY=VALUE`, or a bare value.

        Raises:
            SpecError: A word has no key.
        """
        request: dict[str, Any] = {"do": do}
        for word in more:
            key, equals, value = word.partition("=")
            if not equals:
                key, value = self.main_keys.get(do, ""), word
            if not key or key in request:
                raise SpecError(f"tell {do}: {word!r} is no KEY=VALUE", hint="such as for_s=2")
            request[key] = value
            with contextlib.suppress(ValueError):
                request[key] = json.loads(value)
        return request

    def ask(self, place: str | tuple[str, int], request: Request) -> Answer:
        """Ask a mock for something; its answer.

        Args:
            place: Path of its socket, or address and port.
            request: See the reference of the mock.

        Raises:
            RobotConnectionError: No mock listens there.
            CommandRefused: It does not do that.
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
