"""Side channel of the mock controller: a separate port for tests, in addition to the UR interfaces.

`UrRequests` answers the requests; `SideService` is the port and `SideSession` one client. In a mock
in lock-step, a `step` request is answered after its ticks have been executed.
"""

from __future__ import annotations

import json
from collections import deque

from hil.arms import Payload
from hil.core import CommandRefused, FloatArray, SpecError
from hil_mock_robot.server.side_channel import (
    LONGEST_LINE,
    Answer,
    Request,
    Requests,
    factor_in,
    listed,
)
from hil_mock_robot.ur.connections import Link
from hil_mock_robot.ur.dashboard import pressed
from hil_mock_robot.ur.faults import UrFaults
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.pacing import LockStep, RealTime

MOST_WAITING = 1_000_000
"""Maximum size of the requests that wait for the end of a step [bytes]; beyond this size the
client is disconnected."""
LINE_BYTES = 100
AXES = 6
MOST_TICKS = 10_000_000


class UrRequests(Requests):
    """Requests of one client to the mock controller.

    Args:
        machine: Simulated controller.
        faults: Fault schedule of the mock.
        pacer: Pacer of the device time.

    Attributes:
        left: Number of remaining ticks of the client's present step.
    """

    def __init__(self, machine: Machine, faults: UrFaults, pacer: object) -> None:
        super().__init__(faults, AXES)
        self._machine, self._pacer = machine, pacer
        self.left = 0
        self.answers |= {"step": self._step, "speed": self._speed, "pendant": self._pendant}

    def push(self, torque: FloatArray) -> None:
        """See `Requests`."""
        self._machine.body.push(torque)

    def mount(self, payload: Payload | None) -> None:
        """See `Requests`."""
        self._machine.body.mount(payload)

    def truth(self) -> Answer:
        """Return the true state of arm and controller; None for values that do not exist."""
        machine, pacer = self._machine, self._pacer
        seen, modes = machine.reading, machine.modes
        motion, program = machine.motion, machine.program
        return {
            "ticks": machine.ticks,
            "device_time": machine.now_s,
            "q": listed(seen.true_q),
            "qd": listed(seen.true_qd),
            "q_target": listed(machine.setpoint[0]),
            "qd_target": listed(machine.setpoint[1]),
            "celsius": listed(seen.temperature),
            "robot_mode": modes.robot.name,
            "safety_mode": modes.safety.name,
            "runtime": machine.runtime.name,
            "remote": modes.remote,
            "stop_code": modes.stop_code,
            "braked": machine.body.braked,
            "program": None if program is None else program.name,
            "motion": None if motion is None else type(motion).__name__,
            "declared_kg": machine.body.declared.mass,
            "mounted_kg": machine.body.mounted.mass,
            "speed_fraction": machine.speed_fraction,
            "behind_s": round(pacer.behind_s, 6) if isinstance(pacer, RealTime) else None,
            "pace": round(pacer.pace, 3) if isinstance(pacer, RealTime) else None,
        }

    def _step(self, request: Request) -> None:
        if not isinstance(self._pacer, LockStep):
            hint = "start the mock with --speed lock-step"
            raise CommandRefused("step: the time of this mock advances by itself", hint=hint)
        ticks = request.get("ticks", 1)
        if not isinstance(ticks, int) or isinstance(ticks, bool) or not 1 <= ticks <= MOST_TICKS:
            raise SpecError(f"step: ticks is {ticks!r}", hint=f"use 1 to {MOST_TICKS}")
        self.left = ticks
        self._pacer.allow(ticks)

    def _speed(self, request: Request) -> Answer:
        if not isinstance(self._pacer, RealTime):
            raise CommandRefused(
                "speed: this mock does not follow the clock", hint="start it with --speed 1"
            )
        self._pacer.change(factor_in(request))
        return {}

    def _pendant(self, request: Request) -> Answer:
        if self.faults.mock.dark:
            raise CommandRefused(
                "pendant: the controller is booting", hint="wait until it has started"
            )
        return pressed(self._machine, request)


class SideService:
    """Service of the side channel for the operator of the mock.

    Args:
        port: TCP port.
        machine: Simulated controller.
        faults: Fault schedule of the mock.
        pacer: Pacer of the device time.
    """

    def __init__(self, port: int, machine: Machine, faults: UrFaults, pacer: object) -> None:
        self.port = port
        self.machine, self.faults, self.pacer = machine, faults, pacer
        self._sessions: list[SideSession] = []

    def accept(self, link: Link) -> SideSession:
        """Return the session of a new client; see `Service`."""
        requests = UrRequests(self.machine, self.faults, self.pacer)
        session = SideSession(self, link, requests)
        self._sessions.append(session)
        return session

    def forget(self, session: SideSession) -> None:
        """Remove a closed session and its remaining permitted ticks."""
        self._sessions.remove(session)
        if isinstance(self.pacer, LockStep):
            self.pacer.permitted -= session.requests.left

    def ticked(self) -> None:
        """Count a tick of the present step, after all sessions were served."""
        for session in self._sessions:
            if session.requests.left:
                try:
                    session.stepped()
                except Exception as error:
                    self.machine.mishaps.met(error, "the side channel")
                    session.close()
                return


class SideSession:
    """Session of one client of the side channel.

    Args:
        service: Service to which this session belongs.
        link: Connection of the mock to the client.
        requests: Handler of the client's requests.
    """

    lossless = False

    def __init__(self, service: SideService, link: Link, requests: UrRequests) -> None:
        self._service, self._link, self.requests = service, link, requests
        self._rest = b""
        self._waiting: deque[bytes] = deque()
        self._waits = 0

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
            self._answer(
                {"error": "too many requests are waiting", "hint": "read the answers first"}
            )
            self.close()

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def ticked(self) -> None:
        """Do nothing, because `stepped` runs after a tick, when all clients have been served."""

    def hung_up(self) -> None:
        """See `Session`."""
        self._service.forget(self)

    def stepped(self) -> None:
        """Count an executed tick of the present step; answer the request after the last tick."""
        self.requests.left -= 1
        if not self.requests.left:
            self._answer({"device_time": self._service.machine.now_s})
            self._go_on()

    def _go_on(self) -> None:
        while self._waiting and not self.requests.left and not self._link.closed:
            line = self._waiting.popleft()
            self._waits -= _size(line)
            answer = self.requests.line(line)
            if answer is not None:
                self._answer(answer)

    def _answer(self, answer: Answer) -> None:
        self._link.send(json.dumps(answer).encode() + b"\n")


def _size(line: bytes) -> int:
    """Return the size of a waiting request [bytes]."""
    return len(line) + LINE_BYTES
