"""What the controller's rows say of an arm that was told something: segment, faults, stops."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.core import HilError, StaleState, StructArray
from hil.robot import Status
from hil_drivers.ur.faults import complaints, first_fault
from hil_drivers.ur.options import Options
from hil_drivers.ur.phases import still
from hil_drivers.ur.rows import PAUSED, PAUSING, program_running, program_state
from hil_drivers.ur.standing import Standing

RAMP_GRACE_S = 0.5
"""How much longer than its ramp an arm may take to be seen standing still after a stop [s]."""

EXPLAINED_S = 0.5
"""How long it waits for rows that explain it when the process that moves the arm has stopped the
arm and left: it sees them by a connection of its own [s]."""

OURS_FOR_S = 3.0
"""How long after the end of our program a fault is still ours to deal with [s]; whoever stands at
the pendant may start another one then."""


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
        gone_at: Device time at which our program was seen to have ended; None while it was not [s].
        problem: What was found wrong and is to be told, once.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        self._standing = Standing()
        self._stopped_by: float | None = None
        self._left: tuple[float, HilError] | None = None
        self.faulty = self.halted = self.replaced = self.severed = False
        self.gone_at: float | None = None
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
        self._stopped_by = None

    def stopping(self, row: Any) -> None:
        """The arm is told to stop, this being its newest raw row; None when there is none."""
        self.halted = True
        if row is not None:
            speed = float(np.abs(row["target_qd"]).max())
            ramp_s = speed / self._options.stop_rad_s2 + RAMP_GRACE_S
            self._stopped_by = float(row["timestamp"]) + ramp_s

    def look(
        self,
        raw: StructArray,
        told: np.void | None,
        error: HilError | None,
        *,
        left: bool = False,
    ) -> bool:
        """Judge a block of raw rows, every one of them.

        Args:
            raw: (N,), N ≥ 1.
            told: How the motion stands, by the process that moves the arm.
            error: What that process said instead.
            left: Whether it has stopped the arm and ended by itself.

        Returns:
            Whether a motion has just been seen to end.
        """
        moved = self.moving
        if moved and told is not None and not int(told["status"]) & Status.MOVING:
            self._standing.end(float(told["device_time"]))
        ended = ~program_running(raw)
        if self.gone_at is None and ended.any():
            self.gone_at = float(raw["timestamp"][int(ended.argmax())])
        if error is not None:
            self._left = self._left or (float(raw["timestamp"][-1]), error)
        # Who has stopped the arm for silence has ended the program, too: that explains nothing.
        stale = self._left is not None and isinstance(self._left[1], StaleState)
        fault = first_fault(raw, program=not (self.replaced or stale))
        if fault is None and error is not None and self._left is not None:
            since, error = self._left
            waits = left and float(raw["timestamp"][-1]) - since < EXPLAINED_S
            error = None if waits else error
        self.found(fault or error)
        if self.moving and self.halted and told is None and still(raw[-1]):
            # Who moved it is not there any more to say so. While it is, the arm may stand before
            # the program has answered the stop, and nothing can be started before that.
            self._standing.end(float(raw["timestamp"][-1]))
        return moved and not self.moving

    def found(self, problem: HilError | None) -> None:
        """Note what is wrong; the first one explains."""
        if problem is not None and not self.faulty:
            self.problem, self.faulty, self.halted = problem, True, True

    def must_not_go_on(self, row: Any) -> bool:
        """Whether that raw row shows our program held by a stop that somebody may lift."""
        if row is None or not self.faulty or self.gone_at is not None:
            return False
        # For some ticks after a protective stop the program may still be said to play.
        held = int(program_state(row.reshape(1))[0]) in (PAUSING, PAUSED) or complaints(row)
        return bool(held)

    def is_for_others(self, row: Any) -> bool:
        """Whether what moves the arm, if anything does, is not ours to stop any more.

        Shortly after our program has ended it may be that `ur-rtde` has uploaded it again.
        """
        if row is None or not self.faulty or self.gone_at is None:
            return False
        return float(row["timestamp"]) - self.gone_at > OURS_FOR_S

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
