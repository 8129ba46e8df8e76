"""The PLC's program: takes commands, plays, watches the PC's beat, fills the ring."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any

import numpy as np

from hil.payload import Payload
from hil.typing import FloatArray
from hil_mock_robot.arm import FAULTS
from hil_mock_robot.twincat.arm import Measured, PlcArm
from hil_mock_robot.twincat.loading import Result, refusal_of, sums_of
from hil_mock_robot.twincat.memory import Memory
from hil_mock_robot.twincat.playing import Course, Hold, Ramp, Trajectory

MOVING, HOLDING, FAULT, MASKED = 1, 2, 4, 8
"""Bits of a row's `nStatus`."""

Listener = Callable[[str, dict[str, Any]], None]


class Phase(IntEnum):
    """`nPhase`."""

    NOT_READY = 0
    HOLDING = 1
    PLAYING = 2
    STOPPING = 3
    FAULT = 4


class Command(IntEnum):
    """`nCommand`."""

    TAKE = 1
    LOAD = 2
    START = 3
    HOLD = 4
    PAYLOAD = 5
    RELEASE = 6


class PlcProgram:
    """What runs in every cycle of the PLC's task.

    Args:
        memory: Its variables; `stInfo` is filled in by somebody else.
        arm: What it moves.

    Attributes:
        listeners: Called with what happens: journal, faults that wait for a motion.
        phase: What the arm is doing.
        head: Rows written since the program started.
        refuse: A result to refuse the next command with; 0 to look at it.
        cause_lasts: Whether the cause of a fault is still there: then nobody can take the arm.
    """

    def __init__(self, memory: Memory, arm: PlcArm) -> None:
        self._memory, self._arm = memory, arm
        self.listeners: list[Listener] = []
        self._info, self._state = memory.view("stInfo")[0], memory.view("stState")[0]
        self._command, self._answer = memory.view("stCommand")[0], memory.view("stAnswer")[0]
        self._beat, self._stop = memory.view("stBeat")[0], memory.view("nStop")
        self._ring, self._set_points = memory.view("aRing"), memory.view("aSetPoints")
        self._cycle_s = float(self._info["fCycleS"])
        self.refuse, self.cause_lasts = 0, False
        self.restart()

    def restart(self) -> None:
        """Begin anew, as after a download: nobody has the arm, the ring is empty."""
        self.phase, self.head, self._segment = Phase.HOLDING, 0, -1
        self._loaded, self._silent_s = 0, 0.0
        for name in ("stState", "stAnswer"):
            view = self._memory.view(name)
            view[:] = np.zeros((), view.dtype)
        self._state["nStop"] = self._stop[0]
        self._done = int(self._command["nCounter"])
        self._course: Course = Hold(self._arm.setpoint[0])
        self._tell_load()
        self._tell()

    def cycles(self, count: int) -> FloatArray:
        """Let cycles pass; commands are looked at before the first.

        Returns:
            (N, n) true joint speeds [rad/s].
        """
        self._take_stop()
        self._take_command()
        speeds: list[FloatArray] = []
        while count > 0:
            setpoints = self._course.next(count)
            if len(setpoints):
                count -= len(setpoints)
                speeds.append(self._pass(setpoints))
            else:
                self._come_to_rest()
        self._tell()
        return np.concatenate(speeds)

    def watch(self, passed_s: float) -> None:
        """Look for the beat of who has the arm; wall time has passed [s]."""
        state, beat = self._state, self._beat
        alive = beat["nSession"] == state["nSession"] and beat["nCount"] != state["nBeat"]
        self._silent_s = 0.0 if alive else self._silent_s + passed_s
        state["nBeat"] = beat["nCount"]
        if state["nSession"] and self._silent_s > self._info["fWatchdogS"]:
            state["nSession"] = 0
            self._told("watchdog", {"silent_s": round(self._silent_s, 3)})
            self._halt()

    def fail(self, code: int, text: str) -> None:
        """A fault: ramp to rest, then the brakes."""
        if self.phase == Phase.FAULT:
            return
        self._state["nFault"], self._state["sFault"] = code, text.encode()[:79]
        self._told("fault", {"code": code, "text": text})
        self._course = Ramp(self._arm.setpoint, float(self._info["fStopRadS2"]), self._cycle_s)
        self.phase, self._loaded = Phase.FAULT, 0

    def _take_stop(self) -> None:
        if self._stop[0] != self._state["nStop"]:
            self._state["nStop"] = self._stop[0]
            self._told("stop", {"moving": self.phase == Phase.PLAYING})
            self._halt()

    def _halt(self) -> None:
        self._loaded = 0
        if self.phase == Phase.PLAYING:
            self._course = Ramp(self._arm.setpoint, float(self._info["fStopRadS2"]), self._cycle_s)
            self.phase = Phase.STOPPING

    def _take_command(self) -> None:
        command = self._command
        counter = int(command["nCounter"])
        if counter == self._done or counter != command["nCounterEnd"]:
            return
        self._done, result, where = counter, self.refuse, -1
        self.refuse = 0
        if not result:
            result, where = self._do(command)
        answer = self._answer
        answer["nResult"], answer["nWhere"] = result, where
        self._tell_load()
        answer["nCounter"] = answer["nCounterEnd"] = counter
        named = Command(command["nCommand"]).name.lower() if 1 <= command["nCommand"] <= 6 else "?"
        self._told("command", {"by": named, "result": int(result)})

    def _do(self, command: np.void) -> tuple[int, int]:
        """Result, and the axis that it is about."""
        number, holder = int(command["nCommand"]), int(self._state["nSession"])
        if number == Command.TAKE:
            return self._take(int(command["nSession"])), -1
        if holder == 0 or command["nSession"] != holder:
            return Result.NOT_YOURS, -1
        if number == Command.RELEASE:
            self._state["nSession"] = 0
            self._halt()
            return Result.DONE, -1
        if self.phase == Phase.FAULT:
            return Result.FAULT, -1
        if self.phase != Phase.HOLDING:
            return Result.BUSY, -1
        if number == Command.LOAD:
            return self._load(command)
        if number == Command.PAYLOAD:
            return self._declare(command), -1
        if number in (Command.START, Command.HOLD):
            return self._begin(command, plays=number == Command.START), -1
        return Result.UNKNOWN, -1

    def _take(self, session: int) -> int:
        holder = int(self._state["nSession"])
        if session == 0 or holder not in (0, session):
            return Result.HELD
        if self.phase in (Phase.PLAYING, Phase.STOPPING):
            return Result.BUSY
        if self.phase == Phase.FAULT:
            if self.cause_lasts or not self._arm.braked:
                return Result.FAULT
            self._arm.release()
            self._course, self.phase = Hold(self._arm.setpoint[0]), Phase.HOLDING
            self._state["nFault"], self._state["sFault"] = 0, b""
        self._state["nSession"], self._silent_s, self._loaded = session, 0.0, 0
        return Result.DONE

    def _load(self, command: np.void) -> tuple[int, int]:
        self._loaded, count = 0, int(command["nRows"])
        if not 1 <= count <= len(self._set_points):
            return Result.TOO_MANY, -1
        rows = self._set_points[:count]
        sums = sums_of(rows)
        self._answer["nSumA"], self._answer["nSumB"] = sums
        if sums != (command["nSumA"], command["nSumB"]):
            return Result.CHECKSUM, -1
        result, where = refusal_of(rows, self._info, self._arm.setpoint[0], self._cycle_s)
        self._loaded = count if result == Result.DONE else 0
        return result, where

    def _declare(self, command: np.void) -> int:
        mass = float(command["fMass"])
        if not 0 <= mass <= self._info["fPayloadMax"]:
            return Result.TOO_HEAVY
        x, y, z = command["aCom"].tolist()
        self._arm.declare(Payload(mass, (x, y, z), tuple(command["aInertia"].tolist())))
        return Result.DONE

    def _begin(self, command: np.void, *, plays: bool) -> int:
        if command["nStop"] != self._stop[0]:
            return Result.STOPPED
        if plays and not self._loaded:
            return Result.NOT_LOADED
        self._segment = int(command["nSegment"])
        if plays:
            rows = self._set_points[: self._loaded]
            path = np.stack([rows[name] for name in ("aQ", "aQd", "aQdd")], axis=1)
            self._course, self.phase, self._loaded = Trajectory(path), Phase.PLAYING, 0
        self._told("start", {"by": "start" if plays else "hold", "segment": self._segment})
        return Result.DONE

    def _pass(self, setpoints: FloatArray) -> FloatArray:
        measured = self._arm.advance(setpoints)
        self._write(setpoints[: len(measured.q)], measured)
        if measured.fault:
            self.fail(measured.fault, FAULTS.get(measured.fault, "fault"))
            self._arm.brake()
            self._course = Hold(self._arm.setpoint[0])
        return measured.true_qd

    def _write(self, setpoints: FloatArray, measured: Measured) -> None:
        count = len(measured.q)
        number = np.arange(self.head, self.head + count, dtype=np.uint64)
        rows = np.zeros(count, self._ring.dtype)
        rows["nSequence"] = rows["nSequenceEnd"] = number
        rows["nTimeNs"] = number * np.uint64(round(self._cycle_s * 1e9))
        rows["aQ"], rows["aQd"], rows["aEffort"] = measured.q, measured.qd, measured.effort
        rows["aCelsius"], rows["aEffortTarget"] = measured.celsius, measured.effort_target
        rows["aQTarget"], rows["aQdTarget"], rows["aQddTarget"] = setpoints.swapaxes(0, 1)
        rows["nSegment"], rows["nPhase"] = self._segment, self.phase
        rows["nFault"], rows["nStatus"] = self._state["nFault"], self._status(setpoints)
        self._ring[number % np.uint64(len(self._ring))] = rows
        self.head += count

    def _status(self, setpoints: FloatArray) -> Any:
        if self.phase == Phase.FAULT:
            rests = (setpoints[:, 1] == 0).all(axis=1)
            return np.where(rests, HOLDING, MOVING) | FAULT | MASKED
        return MOVING if self.phase in (Phase.PLAYING, Phase.STOPPING) else HOLDING

    def _told(self, event: str, details: dict[str, Any]) -> None:
        for listener in self.listeners:
            listener(event, details)

    def _come_to_rest(self) -> None:
        """What was commanded is over."""
        if self.phase == Phase.FAULT:
            self._arm.brake()
        else:
            self.phase = Phase.HOLDING
        self._course = Hold(self._arm.setpoint[0])

    def _tell_load(self) -> None:
        payload, answer = self._arm.declared, self._answer
        answer["fMass"], answer["aCom"] = payload.mass, payload.com
        answer["aInertia"] = payload.inertia

    def _tell(self) -> None:
        state = self._state
        state["nPhase"], state["nLoaded"] = self.phase, self._loaded
        state["nHead"] = self.head
