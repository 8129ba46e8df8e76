"""The PLC's ring: one row a cycle, whatever the arm does."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.core import FloatArray
from hil_mock_robot.twincat.arm import Measured
from hil_mock_robot.twincat.memory import Memory
from hil_mock_robot.twincat.phases import FAULT, HOLDING, MASKED, MOVING, Phase


class RingWriter:
    """Writes rows.

    Args:
        memory: Of the PLC.

    Attributes:
        head: Rows written since the program started.
    """

    def __init__(self, memory: Memory) -> None:
        self._ring, self._state = memory.view("aRing"), memory.view("stState")[0]
        self._cycle_ns = np.uint64(round(float(memory.view("stInfo")[0]["fCycleS"]) * 1e9))
        self.head = 0

    def write(self, setpoints: FloatArray, measured: Measured, segment: int, phase: Phase) -> None:
        """The rows of N cycles.

        Args:
            setpoints: (N, 3, n) commanded.
            measured: Of the same cycles.
            segment: Of all of them.
            phase: The same.
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
        """The end's number first, the beginning's last.

        Whoever reads from the front and finds both alike has read nothing that was being written.
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
