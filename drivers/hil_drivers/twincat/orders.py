"""Commands to the PLC and their answers, which say whose and which command they are to."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import CommandRefused, RobotFault, RobotTimeout
from hil_drivers.twincat.symbols import REASONS, Layout, Order, Result

ANSWER_S = 2.0
LOAD_S = 10.0
"""How long the PLC may take; LOAD looks at every set-point, a hundred a cycle [s]."""

POLL_S = 0.002


class Orders:
    """Sends one command at a time.

    Args:
        layout: Of the variables.
        read, write: `stAnswer` and `stCommand`, as bytes.
        session: Our number.
        names: Of the joints, for messages.
    """

    def __init__(
        self,
        layout: Layout,
        read: Callable[[], bytes],
        write: Callable[[bytes], None],
        session: int,
        names: tuple[str, ...],
    ) -> None:
        self._command, self._answer = layout.types["stCommand"], layout.types["stAnswer"]
        self._read, self._write = read, write
        self._session, self._names = session, names
        self._counter = secrets.randbelow(0xFFFFFFFF)

    def give(self, order: Order, what: str, within_s: float = ANSWER_S, **fields: Any) -> np.void:
        """Send a command and wait for its answer.

        Args:
            order: What to do.
            what: The same in words, for messages.
            within_s: How long the answer may take.
            fields: Of the command.

        Raises:
            CommandRefused: The PLC says no.
            RobotFault: It has a fault, or has taken the arm away from us.
            RobotTimeout: It has not answered.
            RobotError: The line fails.
        """
        counter = self._counter = self._counter % 0xFFFFFFFF + 1
        command = np.zeros(1, self._command)
        command["nCounter"] = command["nCounterEnd"] = counter
        command["nCommand"], command["nSession"] = order, self._session
        for name, value in fields.items():
            command[name] = value
        self._write(command.tobytes())
        until = time.monotonic() + within_s
        while True:
            answer: np.void = np.frombuffer(self._read(), self._answer)[0]
            if self._is_to(answer, counter, order):
                self._require_done(answer, what)
                return answer
            if time.monotonic() > until:
                raise RobotTimeout(
                    f"the PLC has not answered within {within_s:g} s: {what}",
                    hint="is its program running? TwinCAT shows whether its cycle is",
                )
            time.sleep(POLL_S)

    def _is_to(self, answer: np.void, counter: int, order: Order) -> bool:
        """Whether an answer is whole, and to this command of ours: others count, too."""
        return bool(
            answer["nCounter"] == counter == answer["nCounterEnd"]
            and answer["nSession"] == self._session
            and answer["nCommand"] == order
        )

    def _require_done(self, answer: np.void, what: str) -> None:
        result, where = int(answer["nResult"]), int(answer["nWhere"])
        if result == Result.DONE:
            return
        joint = f" ({self._names[where]})" if 0 <= where < len(self._names) else ""
        why = REASONS.get(result, f"result {result}")
        said = f"the PLC refuses to {what}: {why}{joint}"
        if result in (Result.FAULT, Result.NOT_YOURS):
            raise RobotFault(said, hint="remove the cause, then connect() again")
        hints: dict[int, str] = {
            Result.HELD: "end the other client, or wait until the PLC's watchdog has noticed",
            Result.CHECKSUM: "try again; if it stays so, see to the connection",
            Result.BUSY: "read until it rests",
            Result.STOPPED: "prepare it again; something else may write nStop as well",
        }
        raise CommandRefused(said, hint=hints.get(result, "plan again for this arm"))


def payload_fields(payload: Payload) -> dict[str, Any]:
    """A load as fields of a command."""
    return {"fMass": payload.mass, "aCom": payload.com, "aInertia": payload.inertia}


def payload_in(answer: np.void) -> Payload:
    """The load that an answer says the PLC computes with."""
    x, y, z = answer["aCom"].tolist()
    xx, yy, zz, xy, xz, yz = answer["aInertia"].tolist()
    return Payload(float(answer["fMass"]), (x, y, z), (xx, yy, zz, xy, xz, yz))
