"""The side channel: what tests ask of the mock itself, past every interface of a controller.

One JSON object a line, each answered by one line, in order; `{"error": …}` when it cannot be.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable
from typing import Any

from hil.core import CommandRefused, HilError, SpecError
from hil_mock_robot.server.side_channel import Request, payload_in, torque_in
from hil_mock_robot.ur.contracts import Link
from hil_mock_robot.ur.dashboard import pressed
from hil_mock_robot.ur.faults import UrFaults
from hil_mock_robot.ur.loop import LockStep, RealTime
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.side_requests import factor_in, ticks_in, truth_of

LONGEST_LINE = 100_000
MOST_WAITING = 1_000_000
"""Bytes of requests that wait for the end of a step; the client is hung up on beyond that."""
LINE_BYTES = 100
AXES = 6

Answer = dict[str, Any]


class SideService:
    """Listens for those who run the mock.

    Args:
        port: TCP port.
        machine: The controller.
        faults: What is wrong with it.
        pacer: Of its time.
    """

    def __init__(self, port: int, machine: Machine, faults: UrFaults, pacer: object) -> None:
        self.port = port
        self.machine, self.faults, self.pacer = machine, faults, pacer
        self._sessions: list[SideSession] = []

    def accept(self, link: Link) -> SideSession:
        """See `Service`."""
        session = SideSession(self, link)
        self._sessions.append(session)
        return session

    def forget(self, session: SideSession) -> None:
        """It is gone, and its permits with it."""
        self._sessions.remove(session)
        if isinstance(self.pacer, LockStep):
            self.pacer.permitted -= session.left

    def ticked(self) -> None:
        """A tick is over, and everybody was sent what was due."""
        for session in self._sessions:
            if session.left:
                try:
                    session.stepped()
                except Exception as error:
                    self.machine.mishaps.met(error, "the side channel")
                    session.close()
                return


class SideSession:
    """One client.

    Args:
        service: What it is connected to.
        link: The connection.

    Attributes:
        left: Ticks of its present step that were not made yet.
    """

    lossless = False

    def __init__(self, service: SideService, link: Link) -> None:
        self._service, self._link = service, link
        self._rest = b""
        self._waiting: deque[bytes] = deque()
        self._waits = 0
        self.left = 0
        self._answers: dict[str, Callable[[Request], Answer | None]] = {
            "fault": self._fault,
            "clear": self._clear,
            "state": self._state,
            "step": self._step,
            "speed": self._speed,
            "push": self._push,
            "mount": self._mount,
            "pendant": self._pendant,
        }

    def received(self, data: bytes) -> None:
        """See `Session`."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        asked = [line for line in lines if line.strip()]
        self._waiting.extend(asked)
        self._waits += sum(map(_size, asked))
        if len(self._rest) > LONGEST_LINE:
            self.close()
        self._go_on()
        if self._waits > MOST_WAITING and not self._link.closed:
            self._answer({"error": "too many requests wait", "hint": "read the answers first"})
            self.close()

    def close(self) -> None:
        """Hang up."""
        self._link.close()

    def ticked(self) -> None:
        """See `Session`; what is due after a tick is done when all other clients had theirs."""

    def hung_up(self) -> None:
        """See `Session`."""
        self._service.forget(self)

    def stepped(self) -> None:
        """One tick of the present step was made."""
        self.left -= 1
        if not self.left:
            self._answer({"device_time": self._service.machine.now_s})
            self._go_on()

    def _go_on(self) -> None:
        while self._waiting and not self.left and not self._link.closed:
            line = self._waiting.popleft()
            self._waits -= _size(line)
            answer = self._done(line)
            if answer is not None:
                self._answer(answer)

    def _done(self, line: bytes) -> Answer | None:
        try:
            request = json.loads(line)
            do = request.get("do") if isinstance(request, dict) else None
            if not isinstance(do, str) or do not in self._answers:
                raise SpecError(
                    f"the side channel does not know {line.decode('utf-8', 'replace')}",
                    hint=f'send {{"do": …}} with one of {", ".join(self._answers)}',
                )
            return self._answers[do](request)
        except HilError as error:
            return {"error": error.message, "hint": error.hint}
        except (ValueError, RecursionError) as error:
            return {"error": f"no JSON: {error}", "hint": "send one JSON object a line"}

    def _answer(self, answer: Answer) -> None:
        self._link.send(json.dumps(answer).encode() + b"\n")

    def _fault(self, request: Request) -> Answer:
        given = {key: value for key, value in request.items() if key != "do"}
        return {"fault": self._service.faults.add(given).kind}

    def _clear(self, request: Request) -> Answer:
        self._service.faults.clear()
        return {}

    def _state(self, request: Request) -> Answer:
        pacer = self._service.pacer
        clock: Answer = {"behind_s": None, "pace": None}
        if isinstance(pacer, RealTime):
            clock = {"behind_s": round(pacer.behind_s, 6), "pace": round(pacer.pace, 3)}
        faults = [fault.kind for fault in self._service.faults.lasting]
        return {**truth_of(self._service.machine), **clock, "faults": faults}

    def _step(self, request: Request) -> Answer | None:
        pacer = self._service.pacer
        if not isinstance(pacer, LockStep):
            hint = "start it with --speed lock-step"
            raise CommandRefused("step: this mock's time passes by itself", hint=hint)
        self.left = ticks_in(request)
        pacer.allow(self.left)
        return None

    def _speed(self, request: Request) -> Answer:
        pacer = self._service.pacer
        if not isinstance(pacer, RealTime):
            raise CommandRefused("speed: this mock does not follow the clock", hint="use --speed 1")
        pacer.change(factor_in(request))
        return {}

    def _push(self, request: Request) -> Answer:
        self._service.machine.body.push(torque_in(request, AXES))
        return {}

    def _mount(self, request: Request) -> Answer:
        self._service.machine.body.mount(payload_in(request))
        return {}

    def _pendant(self, request: Request) -> Answer:
        if self._service.faults.mock.dark:
            raise CommandRefused("pendant: the controller is booting", hint="wait for its end")
        return pressed(self._service.machine, request)


def _size(line: bytes) -> int:
    """What a request that waits takes [bytes]."""
    return len(line) + LINE_BYTES
