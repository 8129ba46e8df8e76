"""What the controller's rows say of an arm that was told something: segment, faults, stops."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.errors import HilError
from hil.robot import Status
from hil.typing import StructArray
from hil_drivers.ur.faults import PAUSED, PAUSING, complaints, first_fault
from hil_drivers.ur.options import Options
from hil_drivers.ur.phases import still
from hil_drivers.ur.rows import program_running, program_state
from hil_drivers.ur.standing import Standing

RAMP_GRACE_S = 0.5
"""How much longer than its ramp an arm may take to be seen standing still after a stop [s]."""

UPLOAD_GRACE_S = 0.1
"""How much later than the beginning of a motion the program that makes it may be seen to play,
where it had to be uploaded again: two connections tell of it [s]."""


class Watch:
    """Knows how the arm stands, from when it was connected to the first fault.

    Args:
        options: Of the arm.

    Attributes:
        faulty: Whether it does not obey any more: it has to be connected again.
        halted: Whether the arm was stopped since the newest segment began.
        replaced: Whether our program was ended by ourselves, and is not to be missed.
        severed: Whether the process that moves the arm was passed over when the arm was stopped:
            its program is gone without its doing, and it ends.
        ours: Whether what the controller plays, or holds paused, is still our program.
        problem: What was found wrong and is to be told, once.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        self._standing = Standing()
        self._stopped_by: float | None = None
        self._plays_from = -np.inf
        self.faulty = self.halted = self.replaced = self.severed = False
        self.ours = True
        self.problem: HilError | None = None

    @property
    def moving(self) -> bool:
        """Whether the newest segment's motion has not been seen to end."""
        return self._standing.moving

    def begun(self, index: int, at: float, *, moves: bool) -> None:
        """A segment begins after that device time [s]."""
        self._standing.begin(index, at, moves=moves)
        self.halted = False
        if not moves:
            return
        if self.replaced:
            self._plays_from, self.ours = at + UPLOAD_GRACE_S, True
        self._stopped_by, self.replaced = None, False

    def stopping(self, row: Any) -> None:
        """The arm is told to stop, this being its newest raw row; None when there is none."""
        self.halted = True
        if row is not None:
            speed = float(np.abs(row["target_qd"]).max())
            ramp_s = speed / self._options.stop_rad_s2 + RAMP_GRACE_S
            self._stopped_by = float(row["timestamp"]) + ramp_s

    def look(self, raw: StructArray, told: np.void | None, error: HilError | None) -> bool:
        """Judge a block of raw rows, every one of them.

        Args:
            raw: (N,), N ≥ 1.
            told: How the motion stands, by the process that moves the arm.
            error: What that process said instead.

        Returns:
            Whether a motion has just been seen to end.
        """
        moved = self.moving
        if moved and told is not None and not int(told["status"]) & Status.MOVING:
            self._standing.end(float(told["device_time"]))
        if told is not None and told["replaced"]:
            self.replaced = True
        ought = np.asarray(raw["timestamp"] > self._plays_from)
        if (ought & ~program_running(raw)).any():
            self.ours = False
        self.found(first_fault(raw, ought & (not self.replaced)) or error)
        if self.moving and self.halted and still(raw[-1]):
            # Who moved it may not be there any more to say that the motion is over.
            self._standing.end(float(raw["timestamp"][-1]))
        return moved and not self.moving

    def seen(self, raw: StructArray | None) -> HilError | None:
        """What is wrong by the newest raw row (1,), which may not have been taken yet."""
        if raw is None:
            return None
        ought = np.asarray(raw["timestamp"] > self._plays_from) & (not self.replaced)
        return first_fault(raw, ought)

    def found(self, problem: HilError | None) -> None:
        """Note what is wrong; the first one explains."""
        if problem is not None and not self.faulty:
            self.problem, self.faulty, self.halted = problem, True, True

    def must_not_go_on(self, row: Any) -> bool:
        """Whether that raw row shows our program held by a stop that somebody may lift."""
        if row is None or not self.faulty or not self.ours:
            return False
        # For some ticks after a protective stop the program may still be said to play.
        held = int(program_state(row.reshape(1))[0]) in (PAUSING, PAUSED) or complaints(row)
        return bool(held)

    def stop_has_failed(self, raw: StructArray) -> bool:
        """Whether the arm still moved when it ought to have come to rest; said once.

        What it does later is another's doing.
        """
        if self._stopped_by is None:
            return False
        after = raw[raw["timestamp"] >= self._stopped_by]
        if not len(after):
            return False
        self._stopped_by = None
        return not still(after[0])

    def stamp(self, rows: StructArray) -> None:
        """Fill in segment and status of state rows, in place."""
        self._standing.stamp(rows)
        if self.faulty:
            rows["status"][-1] |= Status.FAULT
