"""What the PLC does when it is told to: takes, loads, starts, declares, releases; and answers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hil.arms import Payload
from hil_mock_robot.twincat.arm import PlcArm
from hil_mock_robot.twincat.loading import Result, refusal_of, sums_of
from hil_mock_robot.twincat.memory import Memory
from hil_mock_robot.twincat.phases import Command, Phase

if TYPE_CHECKING:
    from hil_mock_robot.twincat.program import PlcProgram


class Commands:
    """Looks for a new command in every cycle.

    Args:
        memory: Of the PLC.
        arm: What it moves.
        program: Does it.

    Attributes:
        refuse: A result to refuse the next command with; 0 to look at it.
        cause_lasts: Whether the cause of a fault is still there: then nobody can take the arm.
        loaded: (N,) set-points that passed LOAD: the PLC's own copy. What is written to
            `aSetPoints` after they were checked is never played.
    """

    def __init__(self, memory: Memory, arm: PlcArm, program: PlcProgram) -> None:
        self._memory, self._arm, self._program = memory, arm, program
        self._info, self._state = memory.view("stInfo")[0], memory.view("stState")[0]
        self._command, self._answer = memory.view("stCommand")[0], memory.view("stAnswer")[0]
        self._set_points = memory.view("aSetPoints")
        self.refuse, self.cause_lasts = 0, False
        self.restart()

    def restart(self) -> None:
        """Begin anew: what was asked for before is not done."""
        self.loaded: np.ndarray[Any, Any] = self._set_points[:0]
        self._memory.clear("stAnswer")
        self._done = int(self._command["nCounter"])
        self._tell_load()

    def forget(self) -> None:
        """Nothing is loaded any more."""
        self.loaded = self._set_points[:0]

    def look(self) -> None:
        """Do what is asked for, once, and answer."""
        command, answer = self._command, self._answer
        counter = int(command["nCounter"])
        if counter == self._done or counter != command["nCounterEnd"]:
            return
        self._done, result, where = counter, self.refuse, -1
        self.refuse = 0
        if not result:
            result, where = self._do(command)
        answer["nCounterEnd"] = counter  # first; the counter in front last
        answer["nResult"], answer["nWhere"] = result, where
        answer["nSession"], answer["nCommand"] = command["nSession"], command["nCommand"]
        self._tell_load()
        answer["nCounter"] = counter
        named = Command(command["nCommand"]).name.lower() if 1 <= command["nCommand"] <= 6 else "?"
        self._program.told("command", {"by": named, "result": int(result)})

    def _do(self, command: np.void) -> tuple[int, int]:
        """Result, and the axis that it is about."""
        number, holder = int(command["nCommand"]), int(self._state["nSession"])
        if number == Command.TAKE:
            return self._take(int(command["nSession"])), -1
        if holder == 0 or command["nSession"] != holder:
            return Result.NOT_YOURS, -1
        if number == Command.RELEASE:
            self._state["nSession"] = 0
            self._program.halt()
            return Result.DONE, -1
        if self._program.phase == Phase.FAULT:
            return Result.FAULT, -1
        if self._program.phase != Phase.HOLDING:
            return Result.BUSY, -1
        if number == Command.LOAD:
            return self._load(command)
        if number == Command.PAYLOAD:
            return self._declare(command), -1
        if number in (Command.START, Command.HOLD):
            return self._begin(command, plays=number == Command.START), -1
        return Result.UNKNOWN, -1

    def _take(self, session: int) -> int:
        program, holder = self._program, int(self._state["nSession"])
        if session == 0 or holder not in (0, session):
            return Result.HELD
        if program.phase in (Phase.PLAYING, Phase.STOPPING):
            return Result.BUSY
        if program.phase == Phase.FAULT:
            if self.cause_lasts or not self._arm.braked:
                return Result.FAULT
            program.hold_where_it_stands()
        self._state["nSession"] = session
        program.heard()
        self.forget()
        return Result.DONE

    def _load(self, command: np.void) -> tuple[int, int]:
        self.forget()
        count = int(command["nRows"])
        if not 1 <= count <= len(self._set_points):
            return Result.TOO_MANY, -1
        rows = self._set_points[:count].copy()
        sums = sums_of(rows)
        self._answer["nSumA"], self._answer["nSumB"] = sums
        if sums != (command["nSumA"], command["nSumB"]):
            return Result.CHECKSUM, -1
        cycle_s = float(self._info["fCycleS"])
        result, where = refusal_of(rows, self._info, self._arm.setpoint[0], cycle_s)
        if result == Result.DONE:
            self.loaded = rows
        return result, where

    def _declare(self, command: np.void) -> int:
        mass = float(command["fMass"])
        if not 0 <= mass <= self._info["fPayloadMax"]:
            return Result.TOO_HEAVY
        x, y, z = command["aCom"].tolist()
        self._arm.declare(Payload(mass, (x, y, z), tuple(command["aInertia"].tolist())))
        return Result.DONE

    def _begin(self, command: np.void, *, plays: bool) -> int:
        if command["nStop"] != self._memory.view("nStop")[0]:
            return Result.STOPPED
        if plays and not len(self.loaded):
            return Result.NOT_LOADED
        path = None
        if plays:
            path = np.stack([self.loaded[name] for name in ("aQ", "aQd", "aQdd")], axis=1)
            self.forget()
        self._program.begin(int(command["nSegment"]), path)
        return Result.DONE

    def _tell_load(self) -> None:
        payload, answer = self._arm.declared, self._answer
        answer["fMass"], answer["aCom"] = payload.mass, payload.com
        answer["aInertia"] = payload.inertia
