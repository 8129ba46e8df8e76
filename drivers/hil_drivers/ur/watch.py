"""What the controller's rows say of an arm that was told something: segment, faults, stops."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.errors import HilError
from hil.robot import Status
from hil.typing import StructArray
from hil_drivers.ur.faults import fault_of
from hil_drivers.ur.options import Options
from hil_drivers.ur.phases import still
from hil_drivers.ur.standing import Standing

RAMP_GRACE_S = 0.5
"""How much longer than its ramp an arm may take to be seen standing still after a stop [s]."""


class Watch:
    """Knows how the arm stands, from when it was connected to the first fault.

    Args:
        options: Of the arm.

    Attributes:
        faulty: Whether it does not obey any more: it has to be connected again.
        halted: Whether the newest motion was stopped.
        replaced: Whether our program was ended by ourselves, and is not to be missed.
        problem: What was found wrong and is to be told, once.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        self._standing = Standing()
        self._stopped_by: float | None = None
        self.faulty = self.halted = self.replaced = False
        self.problem: HilError | None = None

    @property
    def moving(self) -> bool:
        """Whether the newest segment's motion has not been seen to end."""
        return self._standing.moving

    def begun(self, index: int, at: float, *, moves: bool) -> None:
        """A segment begins after that device time [s]."""
        self._standing.begin(index, at, moves=moves)
        if moves:
            self._stopped_by, self.halted, self.replaced = None, False, False

    def stopping(self, row: Any) -> None:
        """The arm is told to stop, this being its newest raw row; None when there is none."""
        self.halted = True
        if row is not None:
            speed = float(np.abs(row["target_qd"]).max())
            ramp_s = speed / self._options.stop_rad_s2 + RAMP_GRACE_S
            self._stopped_by = float(row["timestamp"]) + ramp_s

    def look(self, row: np.void, told: np.void | None, error: HilError | None) -> bool:
        """Judge the newest raw row of a block.

        Args:
            row: It.
            told: How the motion stands, by the process that moves the arm.
            error: What that process said instead.

        Returns:
            Whether a motion has just been seen to end.
        """
        moved = self.moving
        if moved and told is not None and not int(told["status"]) & Status.MOVING:
            self._standing.end(float(told["device_time"]))
        fault = fault_of(row, program=not self.replaced) or error
        if fault is not None and not self.faulty:
            self.problem, self.faulty, self.halted = fault, True, True
        if self.moving and self.halted and still(row):
            # Who moved it may not be there any more to say that the motion is over.
            self._standing.end(float(row["timestamp"]))
        return moved and not self.moving

    def stop_has_failed(self, row: np.void) -> bool:
        """Whether the arm still moves though it was told to stop; said once."""
        if self._stopped_by is None or float(row["timestamp"]) < self._stopped_by:
            return False
        self._stopped_by = None
        return not still(row)

    def stamp(self, rows: StructArray) -> None:
        """Fill in segment and status of state rows, in place."""
        self._standing.stamp(rows)
        if self.faulty:
            rows["status"][-1] |= Status.FAULT
