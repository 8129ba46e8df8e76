"""Follows an arm by what its PLC tells: is it moving, does it obey, is anything wrong?"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from hil.core import HilError, RobotFault, RobotTimeout, StructArray
from hil.robot import Status
from hil_drivers.twincat.symbols import Phase


class Watch:
    """One session with a PLC.

    Args:
        session: Our number.
        late_s: Silence of the PLC that ends a motion [s].

    Attributes:
        problem: What the next read raises.
        faulty: Whether nothing is obeyed any more, until connected again.
        moving: Whether a segment was started and no row has shown its end.
        idle: Whether nothing was started since the connection was made, or the arm was stopped:
            rows that nobody reads for long may be left out then.
    """

    def __init__(self, session: int, late_s: float) -> None:
        self._session, self._late_s = session, late_s
        self._head, self._since = -1, time.monotonic()
        self._segment = -1
        self.problem: HilError | None = None
        self.faulty = self.moving = False
        self.idle = True

    def begun(self, segment: int) -> None:
        """A segment was started."""
        self._segment, self.moving, self.idle = segment, True, False
        self._since = time.monotonic()

    def advanced(self, head: int) -> bool:
        """Whether the PLC has written rows since it was last asked, or was not silent for long."""
        if head != self._head:
            self._head, self._since = head, time.monotonic()
        return not self.silent

    @property
    def silent(self) -> bool:
        """Whether it has not been seen to write rows for long."""
        return time.monotonic() - self._since > self._late_s

    def found(self, problem: HilError) -> None:
        """Something is wrong: it is told by the next read, the first one only."""
        self.faulty = True
        self.problem = self.problem or problem

    def see(self, rows: StructArray, state: np.void, why: Callable[[np.void], str]) -> None:
        """Look at what was read.

        Args:
            rows: (N,) state rows.
            state: `stState`, read before them.
            why: Words for the fault that it tells.
        """
        mine = rows[rows["segment"] == self._segment]
        if len(mine) and not mine[-1]["status"] & Status.MOVING:
            self.moving = False
        if self.faulty:
            return
        if (rows["status"] & Status.FAULT).any() or state["nPhase"] == Phase.FAULT:
            self.found(RobotFault(why(state), hint="remove its cause, then connect() again"))
        elif state["nSession"] != self._session:
            self.found(
                RobotFault(
                    "the PLC has taken the arm away: it had not heard from this computer in time, "
                    "or its program was started anew",
                    hint="was hil suspended, or the computer busy? connect() again",
                )
            )

    def stands_still(self, where: str) -> RobotTimeout:
        """The error for a PLC that answers, but whose program does not run."""
        return RobotTimeout(
            f"{where} has written no rows for more than {self._late_s:g} s: its task stands still",
            hint="see to TwinCAT: is the PLC in run mode, at a breakpoint, or over its cycle time?",
        )
