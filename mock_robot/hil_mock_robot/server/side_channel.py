"""The side channel of a mock: requests past its protocol, for tests and for `hil mock … tell`."""

from __future__ import annotations

import json
import math
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray, SpecError
from hil_mock_robot.server.options import numbers_of

MOST_TORQUE_NM, MOST_KG, MOST_M = 10_000.0, 100.0, 2.0
Request = Mapping[str, Any]


def request_of(do: str, more: Sequence[str], main_keys: Mapping[str, str]) -> dict[str, Any]:
    """The request that words of a shell stand for; values are JSON where they can be.

    Args:
        do: The request's name.
        more: `KEY=VALUE`, or a bare value.
        main_keys: Request → what a bare value is.

    Raises:
        SpecError: A word has no key.
    """
    request: dict[str, Any] = {"do": do}
    for word in more:
        key, equals, value = word.partition("=")
        if not equals:
            key, value = main_keys.get(do, ""), word
        if not key or key in request:
            raise SpecError(f"tell {do}: {word!r} is no KEY=VALUE", hint="such as for_s=2")
        request[key] = _value(value)
    return request


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


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
    """What is to hang at the flange; None for whatever is declared.

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


def listed(values: FloatArray) -> list[float | None]:
    """An array for JSON; None for what nobody knows."""
    return [float(value) if math.isfinite(value) else None for value in values]


LONGEST_LINE = 100_000

ANSWER_S = 1.0
"""Wall time a client may leave an answer unread; it is hung up on then."""


class SideClient:
    """Somebody at the other end of a connection; it is never waited for.

    Args:
        line: The connection.
    """

    def __init__(self, line: socket.socket) -> None:
        line.setblocking(False)
        self.line, self._asked, self._answers = line, b"", b""
        self._unread_s = time.monotonic()

    def ask(self, answer: Callable[[bytes], bytes]) -> None:
        """Take what has come, and note the answers.

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
        """Send what it takes at once.

        Args:
            now_s: Wall time, monotonic.

        Raises:
            OSError: It has gone, or does not read.
        """
        while self._answers:
            try:
                sent = self.line.send(self._answers)
            except BlockingIOError:
                if now_s - self._unread_s > ANSWER_S:
                    raise
                return
            self._answers = self._answers[sent:]
            self._unread_s = now_s
        self._unread_s = now_s
