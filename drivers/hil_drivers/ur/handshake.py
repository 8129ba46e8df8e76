"""Agreeing with a controller on what it sends: every step with a time-out and in plain words.

Text messages may come between any question and its answer; they are kept and never mistaken for
the answer. Which variables there are depends on series and software: what a controller does not
know is left out and asked for no more.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from hil.core import RobotConnectionError
from hil_drivers.ur.fields import REQUIRED, names_for
from hil_drivers.ur.rtde_wire import (
    HEADER,
    KINDS,
    LONGEST,
    SHORTEST,
    TYPES,
    Kind,
    Layout,
    TextMessage,
    package,
    text_message,
)

PROTOCOL = 2
CB3_HZ, E_SERIES_HZ = 125.0, 500.0
ROUNDS = 4
"""So often the outputs are asked for: a controller may refuse others the second time."""

_VERSION = struct.Struct(">IIII")
_FREQUENCY = struct.Struct(">d")
_REASONS = {
    "NOT_FOUND": "this software does not have it",
    "IN_USE": "another RTDE client or a fieldbus owns it",
}

Version = tuple[int, int, int, int]


@dataclass(frozen=True, slots=True)
class Agreement:
    """What a controller will send once it is started.

    Attributes:
        version: Of its software: major, minor, bug-fix, build.
        frequency_hz: Packages per second asked for.
        layout: Of a data package.
        missing: Variables that are not sent → why not.
    """

    version: Version
    frequency_hz: float
    layout: Layout
    missing: Mapping[str, str]


class Conversation:
    """Questions and answers over one socket.

    Args:
        line: Connected.
        peer: The address, for messages.
        step_s: How long an answer may take [s].
        heard: Is told every text message.
    """

    def __init__(
        self,
        line: socket.socket,
        peer: str,
        step_s: float,
        heard: Callable[[TextMessage], object],
    ) -> None:
        self._line, self._peer, self._step_s, self._heard = line, peer, step_s, heard
        self._said: list[TextMessage] = []

    def agree(self, frequency_hz: float | None, also: Sequence[str] = ()) -> Agreement:
        """Everything before the start.

        Args:
            frequency_hz: Packages per second; None for all that the controller makes.
            also: Variables to be sent beyond the recorded ones.

        Raises:
            RobotConnectionError: No answer in time, no RTDE server, or one that refuses.
        """
        accepted = self._ask(Kind.VERSION, struct.pack(">H", PROTOCOL), "the protocol version")
        if accepted[:1] != b"\x01":
            raise self._problem(
                f"does not speak RTDE protocol {PROTOCOL}", "update the controller's software"
            )
        version = self._controller_version()
        fastest = CB3_HZ if version[0] <= 3 else E_SERIES_HZ
        rate = fastest if frequency_hz is None else frequency_hz
        if not 0 < rate <= fastest:
            raise self._problem(
                f"sends at most {fastest:g} packages per second, not {rate:g}",
                f"ask for a frequency up to {fastest:g} Hz, or for none",
            )
        wanted, missing = names_for(version[0], tuple(also))
        layout = self._outputs(wanted, rate, missing)
        return Agreement(version, rate, layout, missing)

    def start(self) -> None:
        """Let the data packages come.

        Raises:
            RobotConnectionError: The controller refuses, or does not answer.
        """
        if self._ask(Kind.START, b"", "the start")[:1] != b"\x01":
            raise self._problem(
                "refuses to send its state", "see the controller's log; restart it if need be"
            )

    def _controller_version(self) -> Version:
        content = self._ask(Kind.CONTROLLER, b"", "the controller's version")
        if len(content) != _VERSION.size:
            raise self._problem(
                f"tells its version in {len(content)} bytes instead of {_VERSION.size}",
                "is that a UR controller?",
            )
        major, minor, bugfix, build = _VERSION.unpack(content)
        return major, minor, bugfix, build

    def _outputs(self, wanted: list[str], rate: float, missing: dict[str, str]) -> Layout:
        """Ask until every name that is left is known; what is not goes to `missing`."""
        for _ in range(ROUNDS):
            question = _FREQUENCY.pack(rate) + ",".join(wanted).encode()
            answer = self._ask(Kind.OUTPUTS, question, "the list of outputs")
            types = answer[1:].decode("ascii", "replace").strip().rstrip(",").split(",")
            if len(types) != len(wanted):
                raise self._problem(
                    f"names {len(types)} types for {len(wanted)} outputs", "is that a UR robot?"
                )
            refused = {n: _reason(t) for n, t in zip(wanted, types, strict=True) if t not in TYPES}
            if not refused:
                if not answer[0]:
                    raise self._problem("refuses the list of outputs", "see the controller's log")
                return Layout(answer[0], wanted, types)
            self._require(refused)
            missing |= refused
            wanted = [name for name in wanted if name not in refused]
        raise self._problem(
            f"refuses other outputs every time: {', '.join(missing)}", "restart the controller"
        )

    def _require(self, refused: Mapping[str, str]) -> None:
        for name in REQUIRED:
            if name in refused:
                raise self._problem(
                    f"does not send {name}: {refused[name]}",
                    "end the other client, or update the controller's software",
                )

    def _ask(self, kind: Kind, content: bytes, what: str) -> bytes:
        """Send a question and wait for the answer of its kind."""
        deadline = time.monotonic() + self._step_s
        try:
            self._line.settimeout(self._step_s)
            self._line.sendall(package(kind, content))
            while True:
                size, came = HEADER.unpack(self._read(HEADER.size, deadline))
                if came not in KINDS or not SHORTEST <= size <= LONGEST:
                    raise self._problem(
                        f"answers {what} with something that is not RTDE",
                        f"is port {self._peer.rpartition(':')[2]} the RTDE port of a UR robot?",
                    )
                answer = self._read(size - HEADER.size, deadline)
                if came == kind and answer:
                    return answer
                if came != Kind.TEXT:
                    raise self._problem(
                        f"answers {what} by a package {chr(came)!r} of {len(answer)} bytes",
                        "is something between hil and the robot? connect directly",
                    )
                said = text_message(answer, time.time())
                self._said.append(said)
                self._heard(said)
        except TimeoutError as error:
            raise self._problem(
                f"has not answered {what} within {self._step_s:g} s",
                "it may be starting up, or have too many clients: try again, restart it if need be",
            ) from error
        except RobotConnectionError:
            raise
        except OSError as error:
            raise self._problem(f"broke off at {what}: {error}", _AWAY) from error

    def _read(self, count: int, deadline: float) -> bytes:
        got = bytearray()
        while len(got) < count:
            left = deadline - time.monotonic()
            if left <= 0:
                raise TimeoutError
            self._line.settimeout(left)
            more = self._line.recv(count - len(got))
            if not more:
                raise self._problem("hung up during the handshake", _AWAY)
            got += more
        return bytes(got)

    def _problem(self, what: str, hint: str) -> RobotConnectionError:
        said = "".join(f"; it says: {one}" for one in self._said[-3:])
        return RobotConnectionError(f"the controller at {self._peer} {what}{said}", hint=hint)


_AWAY = "is the controller being restarted? too many RTDE clients? see its log and try again"


def _reason(token: str) -> str:
    return _REASONS.get(token, f"its type {token[:40]!r} is not known here")
