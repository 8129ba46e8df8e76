"""Program of the mock PLC, executed cycle by cycle.

`PlcProgram` plays trajectories, executes stops, monitors the beat of the PC and fills the ring
buffer. `Commands` reads, checks (`refusal_of`) and answers commands. `Trajectory`, `Ramp` and
`Hold` compute the set-points of the arm in closed form. `RingWriter` writes one row per cycle.

| phase         | event                                                  | next phase |
|---------------|--------------------------------------------------------|------------|
| any           | the PLC restarts                                       | HOLDING    |
| HOLDING       | START of a loaded path                                 | PLAYING    |
| PLAYING       | the path is over                                       | HOLDING    |
| PLAYING       | stop, RELEASE, or no beat of the PC for `fWatchdogS`   | STOPPING   |
| STOPPING      | the ramp is over                                       | HOLDING    |
| any but FAULT | a fault of the arm or an injected one                  | FAULT      |
| FAULT         | TAKE, when its cause is gone and the brakes are closed | HOLDING    |

In the phase NOT_READY, the drives are not switched on; the mock never enters this phase.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, Protocol

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray, StructArray
from hil_mock_robot.plant.records import FAULTS
from hil_mock_robot.twincat.arm import Measured, PlcArm
from hil_mock_robot.twincat.memory import Memory

MOVING, HOLDING, FAULT, MASKED = 1, 2, 4, 8
"""Bits of a row's `nStatus`."""


class Phase(IntEnum):
    """Values of `nPhase`."""

    NOT_READY = 0
    HOLDING = 1
    PLAYING = 2
    STOPPING = 3
    FAULT = 4


class Command(IntEnum):
    """Values of `nCommand`."""

    TAKE = 1
    LOAD = 2
    START = 3
    HOLD = 4
    PAYLOAD = 5
    RELEASE = 6


Listener = Callable[[str, dict[str, Any]], None]


class PlcProgram:
    """Program of the PLC task.

    Args:
        memory: Memory of the PLC; the mock fills in `stInfo`.
        arm: Arm of this controller.

    Attributes:
        listeners: Functions called with events, for the journal and for faults that wait for a
            motion.
        arm: Arm of this controller.
        commands: Handler of the commands of clients.
        phase: Present phase of the program.
    """

    def __init__(self, memory: Memory, arm: PlcArm) -> None:
        self._memory, self.arm = memory, arm
        self.listeners: list[Listener] = []
        self._info, self._state = memory.view("stInfo")[0], memory.view("stState")[0]
        self._course: Course = Hold(arm.setpoint[0])
        self._beat, self._stop = memory.view("stBeat")[0], memory.view("nStop")
        self.commands = Commands(memory, arm, self)
        self.restart()

    def restart(self) -> None:
        """Restart as after a reset: no client controls the arm, and the ring is empty."""
        self.phase, self._segment = Phase.HOLDING, -1
        self._silent_s, self._count = 0.0, int(self._beat["nCount"])
        self._ring = RingWriter(self._memory)
        self._memory.clear("stState")
        self._state["nStop"] = self._stop[0]
        self.commands.restart()
        self._hold()
        self._tell()

    @property
    def device_time(self) -> float:
        """Device time of the next row [s]."""
        return float(self._info["fCycleS"]) * self._ring.head

    def cycles(self, count: int) -> FloatArray:
        """Execute `count` cycles; commands are read before the first cycle.

        Returns:
            True joint speeds at the ends of the executed cycles, (N, n) [rad/s].
        """
        self._look_for_stop()
        self.commands.look()
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
        """Check the beat of the controlling client after `passed_s` of wall time [s]."""
        state, beat = self._state, self._beat
        alive = beat["nSession"] == state["nSession"] and beat["nCount"] != self._count
        self._silent_s = 0.0 if alive else self._silent_s + passed_s
        self._count = int(beat["nCount"])
        if state["nSession"] and self._silent_s > self._info["fWatchdogS"]:
            state["nSession"] = 0
            self.tell("watchdog", {"silent_s": round(self._silent_s, 3)})
            self.halt()

    def heard(self) -> None:
        """Restart the watchdog, because a client has taken control of the arm."""
        self._silent_s = 0.0

    def begin(self, segment: int, path: FloatArray | None) -> None:
        """Begin a segment; from now on, the rows contain its number.

        Args:
            segment: Number of the segment.
            path: Set-points to play, (N, 3, n), one per cycle; None to keep the present position.
        """
        self._segment = segment
        if path is not None:
            self._course, self.phase = Trajectory(path), Phase.PLAYING
        self.tell("start", {"by": "hold" if path is None else "start", "segment": segment})

    def halt(self) -> None:
        """Bring the arm to rest, and discard the loaded set-points."""
        self.commands.forget()
        if self.phase == Phase.PLAYING:
            self._ramp()
            self.phase = Phase.STOPPING

    def fail(self, code: int, text: str) -> None:
        """Enter the phase FAULT: ramp to rest, then close the brakes."""
        if self.phase == Phase.FAULT:
            return
        self._state["nFault"], self._state["sFault"] = code, text.encode()[:79]
        self.tell("fault", {"code": code, "text": text})
        self._ramp()
        self.commands.forget()
        self.phase = Phase.FAULT

    def hold_where_it_stands(self) -> None:
        """Leave the phase FAULT: release the brakes with the present position as set-point."""
        self.arm.release()
        self._hold()
        self.phase = Phase.HOLDING
        self._state["nFault"], self._state["sFault"] = 0, b""

    def tell(self, event: str, details: dict[str, Any]) -> None:
        """Send an event to all listeners."""
        for listener in self.listeners:
            listener(event, details)

    def _look_for_stop(self) -> None:
        if self._stop[0] != self._state["nStop"]:
            self._state["nStop"] = self._stop[0]
            self.tell("stop", {"moving": self.phase == Phase.PLAYING})
            self.halt()

    def _pass(self, setpoints: FloatArray) -> FloatArray:
        measured = self.arm.advance(setpoints)
        self._ring.write(setpoints[: len(measured.q)], measured, self._segment, self.phase)
        if measured.fault:
            self.fail(measured.fault, FAULTS.get(measured.fault, "fault"))
            self.arm.brake()
            self._hold()
        return measured.true_qd

    def _come_to_rest(self) -> None:
        """End the present course and keep the position."""
        if self.phase == Phase.FAULT:
            self.arm.brake()
        else:
            self.phase = Phase.HOLDING
        self._hold()

    def _hold(self) -> None:
        self._course = Hold(self.arm.setpoint[0])

    def _ramp(self) -> None:
        deceleration, cycle_s = float(self._info["fStopRadS2"]), float(self._info["fCycleS"])
        self._course = Ramp(self.arm.setpoint, deceleration, cycle_s)

    def _tell(self) -> None:
        self._state["nPhase"], self._state["nHead"] = self.phase, self._ring.head


class Commands:
    """Handler of commands, which looks for a new command before each block of cycles.

    Args:
        memory: Memory of the PLC.
        arm: Arm that the PLC controls.
        program: Program that executes the commands.

    Attributes:
        refuse: Result with which the next command is refused; 0 to process it normally.
        causes: Number of present causes of a fault; while it is not 0, no client can take the arm.
        loaded: Copy of the set-points that passed LOAD, (N,). A later write to `aSetPoints` is
            therefore never played without a check.
    """

    def __init__(self, memory: Memory, arm: PlcArm, program: PlcProgram) -> None:
        self._memory, self._arm, self._program = memory, arm, program
        self._info, self._state = memory.view("stInfo")[0], memory.view("stState")[0]
        self._command, self._answer = memory.view("stCommand")[0], memory.view("stAnswer")[0]
        self._set_points = memory.view("aSetPoints")
        self.refuse = self.causes = 0
        self.restart()

    def restart(self) -> None:
        """Reset after a restart: an earlier command is not executed."""
        self.loaded: np.ndarray[Any, Any] = self._set_points[:0]
        self._memory.clear("stAnswer")
        self._done = int(self._command["nCounter"])
        self._tell_load()

    def forget(self) -> None:
        """Discard the loaded set-points."""
        self.loaded = self._set_points[:0]

    def look(self) -> None:
        """Execute a new command once, and answer it."""
        command, answer = self._command, self._answer
        counter = int(command["nCounter"])
        if counter == self._done or counter != command["nCounterEnd"]:
            return
        self._done, result, where = counter, self.refuse, -1
        self.refuse = 0
        if not result:
            result, where = self._do(command)
        answer["nCounterEnd"] = counter  # written first; `nCounter` is written last
        answer["nResult"], answer["nWhere"] = result, where
        answer["nSession"], answer["nCommand"] = command["nSession"], command["nCommand"]
        self._tell_load()
        answer["nCounter"] = counter
        named = Command(command["nCommand"]).name.lower() if 1 <= command["nCommand"] <= 6 else "?"
        self._program.tell("command", {"by": named, "result": int(result)})

    def _do(self, command: np.void) -> tuple[int, int]:
        """Execute a command; return the result, and the axis that caused a refusal."""
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
            if self.causes or not self._arm.braked:
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


START_RAD = 1e-3
REST_RAD_S = 0.01

STEP_SHARE = 1.05
"""Maximum step between consecutive set-points, relative to the step at maximum velocity; a
larger step is a jump."""

SLACK_RAD, SLACK_SHARE = 1e-6, 1.001


class Result(IntEnum):
    """Values of `nResult` in an answer."""

    DONE = 0
    UNKNOWN = 1
    NOT_YOURS = 2
    HELD = 3
    BUSY = 4
    CHECKSUM = 5
    TOO_MANY = 6
    POSITION = 7
    VELOCITY = 8
    ACCELERATION = 9
    ELSEWHERE = 10
    NOT_LOADED = 11
    STOPPED = 12
    FAULT = 13
    TOO_HEAVY = 14
    NOT_AT_REST = 15
    NO_NUMBER = 16
    JUMP = 17


def sums_of(rows: StructArray) -> tuple[int, int]:
    """Return both checksums of a block, computed word by word modulo 2³² as in the PLC."""
    a = np.cumsum(rows.view(np.uint32), dtype=np.uint32)
    return int(a[-1]), int(np.sum(a, dtype=np.uint32))


def refusal_of(
    rows: StructArray, info: np.void, standing: FloatArray, cycle_s: float
) -> tuple[Result, int]:
    """Return the result of checking set-points, and the axis that fails the check (-1 for none).

    Args:
        rows: Set-points, (N,).
        info: Structure `stInfo` with the limits.
        standing: Present commanded position, (n,) [rad].
        cycle_s: Time between two set-points [s].
    """
    q, qd, qdd = rows["aQ"], rows["aQd"], rows["aQdd"]
    outside = np.maximum(info["aQMin"] - q, q - info["aQMax"])
    steps = np.abs(np.diff(q, axis=0)) - STEP_SHARE * cycle_s * info["aQdMax"]
    checks = (
        (Result.NO_NUMBER, ~(np.isfinite(q) & np.isfinite(qd) & np.isfinite(qdd))),
        (Result.ELSEWHERE, np.abs(q[:1] - standing) > START_RAD),
        (Result.NOT_AT_REST, np.abs(qd[[0, -1]]) > REST_RAD_S),
        (Result.POSITION, outside > SLACK_RAD),
        (Result.VELOCITY, np.abs(qd) > SLACK_SHARE * info["aQdMax"]),
        (Result.ACCELERATION, np.abs(qdd) > SLACK_SHARE * info["aQddMax"]),
        (Result.JUMP, steps > SLACK_RAD),
    )
    for result, wrong in checks:
        if wrong.any():
            return result, int(wrong.any(axis=0).argmax())
    return Result.DONE, -1


class Course(Protocol):
    """Set-points of the coming cycles."""

    def next(self, count: int) -> FloatArray:
        """Return the set-points (N, 3, n) of the next cycles, N ≤ count; fewer at the end."""


class Trajectory:
    """Course that plays loaded set-points, one per cycle.

    Args:
        rows: Positions [rad], velocities [rad/s] and accelerations [rad/s²], (N, 3, n).
    """

    def __init__(self, rows: FloatArray) -> None:
        self._rows, self._at = rows, 0

    def next(self, count: int) -> FloatArray:
        """Return the next set-points; see `Course`."""
        rows = self._rows[self._at : self._at + count]
        self._at += len(rows)
        return rows


class Ramp:
    """Course that brings all joints to rest together, the fastest with a given deceleration.

    Args:
        setpoint: Set-point at the start of the ramp, (3, n).
        deceleration: Deceleration of the fastest joint [rad/s²].
        cycle_s: Time between two set-points [s].
    """

    def __init__(self, setpoint: FloatArray, deceleration: float, cycle_s: float) -> None:
        self._q, self._v = setpoint[0].copy(), setpoint[1].copy()
        self._takes_s = float(np.abs(self._v).max()) / deceleration
        self._cycle_s, self._done = cycle_s, 0
        self._cycles = int(np.ceil(self._takes_s / cycle_s - 1e-9))

    def next(self, count: int) -> FloatArray:
        """Return the next set-points; the last set-point has zero velocity. See `Course`."""
        last = min(self._done + count, self._cycles)
        t = np.arange(self._done + 1, last + 1)[:, None] * self._cycle_s
        self._done = last
        t = np.minimum(t, self._takes_s)
        left = 1.0 - t / self._takes_s if self._takes_s else np.zeros_like(t)
        q = self._q + self._v * (t - t**2 / 2 / max(self._takes_s, 1e-12))
        slowing = np.where(left > 0, -self._v / max(self._takes_s, 1e-12), 0.0)
        return np.stack((q, self._v * left, slowing), axis=1)


class Hold:
    """Course that keeps one position forever.

    Args:
        q: Position, (n,) [rad].
    """

    def __init__(self, q: FloatArray) -> None:
        self._row = np.zeros((3, len(q)))
        self._row[0] = q

    def next(self, count: int) -> FloatArray:
        """Return the constant set-point for `count` cycles; see `Course`."""
        return np.repeat(self._row[None], count, axis=0)


class RingWriter:
    """Writer of the rows of the ring buffer.

    Args:
        memory: Memory of the PLC.

    Attributes:
        head: Number of rows written since the program started.
    """

    def __init__(self, memory: Memory) -> None:
        self._ring, self._state = memory.view("aRing"), memory.view("stState")[0]
        self._cycle_ns = np.uint64(round(float(memory.view("stInfo")[0]["fCycleS"]) * 1e9))
        self.head = 0

    def write(self, setpoints: FloatArray, measured: Measured, segment: int, phase: Phase) -> None:
        """Write the rows of N cycles.

        Args:
            setpoints: Commanded set-points, (N, 3, n).
            measured: Measurements of the same cycles.
            segment: Segment number of all rows.
            phase: Phase of all rows.
        """
        count = len(measured.q)
        number = np.arange(self.head, self.head + count, dtype=np.uint64)
        rows = np.zeros(count, self._ring.dtype)
        rows["nTimeNs"] = number * self._cycle_ns
        rows["aQ"], rows["aQd"], rows["aEffort"] = measured.q, measured.qd, measured.effort
        rows["aCelsius"], rows["aEffortTarget"] = measured.celsius, measured.effort_target
        rows["aQTarget"], rows["aQdTarget"], rows["aQddTarget"] = setpoints.swapaxes(0, 1)
        rows["nSegment"], rows["nPhase"] = segment, phase
        rows["nFault"], rows["nStatus"] = self._state["nFault"], _status(setpoints, phase)
        self._put(rows, number)
        self.head += count

    def _put(self, rows: np.ndarray[Any, Any], number: np.ndarray[Any, Any]) -> None:
        """Write the rows.

        The sequence number at the end of a row is written first, that at its start last.

        A reader that reads a row from the front and gets two equal sequence numbers has read a
        complete row.
        """
        at = number % np.uint64(len(self._ring))
        self._ring["nSequenceEnd"][at] = rows["nSequenceEnd"] = number
        rows["nSequence"] = self._ring["nSequence"][at]
        self._ring[at] = rows
        self._ring["nSequence"][at] = number


def _status(setpoints: FloatArray, phase: Phase) -> Any:
    if phase == Phase.FAULT:
        rests = (setpoints[:, 1] == 0).all(axis=1)
        return np.where(rests, HOLDING, MOVING) | FAULT | MASKED
    return MOVING if phase in (Phase.PLAYING, Phase.STOPPING) else HOLDING
