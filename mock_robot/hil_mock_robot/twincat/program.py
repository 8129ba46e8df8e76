"""The PLC's program: plays, obeys a stop, watches the PC's beat, fills the ring."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from hil.core import FloatArray
from hil_mock_robot.arm import FAULTS
from hil_mock_robot.twincat.arm import PlcArm
from hil_mock_robot.twincat.commands import Commands
from hil_mock_robot.twincat.memory import Memory
from hil_mock_robot.twincat.phases import Phase
from hil_mock_robot.twincat.playing import Course, Hold, Ramp, Trajectory
from hil_mock_robot.twincat.ring_writing import RingWriter

Listener = Callable[[str, dict[str, Any]], None]


class PlcProgram:
    """What runs in every cycle of the PLC's task.

    Args:
        memory: Its variables; `stInfo` is filled in by somebody else.
        arm: What it moves.

    Attributes:
        listeners: Called with what happens: journal, faults that wait for a motion.
        commands: What it is told.
        phase: What the arm is doing.
    """

    def __init__(self, memory: Memory, arm: PlcArm) -> None:
        self._memory, self._arm = memory, arm
        self.listeners: list[Listener] = []
        self._info, self._state = memory.view("stInfo")[0], memory.view("stState")[0]
        self._course: Course = Hold(arm.setpoint[0])
        self._beat, self._stop = memory.view("stBeat")[0], memory.view("nStop")
        self.commands = Commands(memory, arm, self)
        self.restart()

    def restart(self) -> None:
        """Begin anew, as after a reset: nobody has the arm, the ring is empty."""
        self.phase, self._segment = Phase.HOLDING, -1
        self._silent_s, self._count = 0.0, int(self._beat["nCount"])
        self._ring = RingWriter(self._memory)
        self._memory.clear("stState")
        self._state["nStop"] = self._stop[0]
        self.commands.restart()
        self._hold()
        self._tell()

    def cycles(self, count: int) -> FloatArray:
        """Let cycles pass; commands are looked at before the first.

        Returns:
            (N, n) true joint speeds [rad/s].
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
        """Look for the beat of who has the arm; wall time has passed [s]."""
        state, beat = self._state, self._beat
        alive = beat["nSession"] == state["nSession"] and beat["nCount"] != self._count
        self._silent_s = 0.0 if alive else self._silent_s + passed_s
        self._count = int(beat["nCount"])
        if state["nSession"] and self._silent_s > self._info["fWatchdogS"]:
            state["nSession"] = 0
            self.told("watchdog", {"silent_s": round(self._silent_s, 3)})
            self.halt()

    def heard(self) -> None:
        """Somebody has just taken the arm: the silence before that does not count."""
        self._silent_s = 0.0

    def begin(self, segment: int, path: FloatArray | None) -> None:
        """Rows carry another segment from now on.

        Args:
            segment: Its number.
            path: (N, 3, n) to be played, one a cycle; None to go on holding.
        """
        self._segment = segment
        if path is not None:
            self._course, self.phase = Trajectory(path), Phase.PLAYING
        self.told("start", {"by": "hold" if path is None else "start", "segment": segment})

    def halt(self) -> None:
        """Come to rest, and play nothing that was loaded."""
        self.commands.forget()
        if self.phase == Phase.PLAYING:
            self._ramp()
            self.phase = Phase.STOPPING

    def fail(self, code: int, text: str) -> None:
        """A fault: ramp to rest, then the brakes."""
        if self.phase == Phase.FAULT:
            return
        self._state["nFault"], self._state["sFault"] = code, text.encode()[:79]
        self.told("fault", {"code": code, "text": text})
        self._ramp()
        self.commands.forget()
        self.phase = Phase.FAULT

    def hold_where_it_stands(self) -> None:
        """A fault is over: the set-point becomes where the joints are."""
        self._arm.release()
        self._hold()
        self.phase = Phase.HOLDING
        self._state["nFault"], self._state["sFault"] = 0, b""

    def told(self, event: str, details: dict[str, Any]) -> None:
        """Tell the listeners."""
        for listener in self.listeners:
            listener(event, details)

    def _look_for_stop(self) -> None:
        if self._stop[0] != self._state["nStop"]:
            self._state["nStop"] = self._stop[0]
            self.told("stop", {"moving": self.phase == Phase.PLAYING})
            self.halt()

    def _pass(self, setpoints: FloatArray) -> FloatArray:
        measured = self._arm.advance(setpoints)
        self._ring.write(setpoints[: len(measured.q)], measured, self._segment, self.phase)
        if measured.fault:
            self.fail(measured.fault, FAULTS.get(measured.fault, "fault"))
            self._arm.brake()
            self._hold()
        return measured.true_qd

    def _come_to_rest(self) -> None:
        """What was commanded is over."""
        if self.phase == Phase.FAULT:
            self._arm.brake()
        else:
            self.phase = Phase.HOLDING
        self._hold()

    def _hold(self) -> None:
        self._course = Hold(self._arm.setpoint[0])

    def _ramp(self) -> None:
        deceleration, cycle_s = float(self._info["fStopRadS2"]), float(self._info["fCycleS"])
        self._course = Ramp(self._arm.setpoint, deceleration, cycle_s)

    def _tell(self) -> None:
        self._state["nPhase"], self._state["nHead"] = self.phase, self._ring.head
