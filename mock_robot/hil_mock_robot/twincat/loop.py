"""The mock PLC's own loop: serves ADS, lets device time pass, does what goes wrong."""

from __future__ import annotations

import time

from hil_mock_robot.server.faults import Faults
from hil_mock_robot.twincat.ads import Links
from hil_mock_robot.twincat.faults import Target
from hil_mock_robot.twincat.program import PlcProgram
from hil_mock_robot.twincat.side import SideFile
from hil_mock_robot.twincat.witness import Witness

ROUND_S = 0.004
"""Wall time between two looks at the clock; cycles pass in blocks of so much [s]."""

LATEST_S = 0.05
"""Wall time the mock may be late before that is given up, not caught up; and the most that counts
as silence of the PC in one round: a mock without processor must not blame its client [s]."""


class Loop:
    """Until `end`.

    Args:
        program: The PLC's.
        links: Who talks to it.
        faults: What goes wrong.
        witness: Writes down what happens.
        cycle_s: Device time of a cycle [s].
        factor: Device seconds per second of wall time.
        side: Requests of those who test.
    """

    def __init__(
        self,
        program: PlcProgram,
        links: Links,
        faults: Faults[Target],
        witness: Witness,
        *,
        cycle_s: float,
        factor: float,
        side: SideFile | None = None,
    ) -> None:
        self._program, self._links, self._faults = program, links, faults
        self._witness, self._side = witness, side
        self._cycles_per_s = factor / cycle_s
        self._cycle_s = cycle_s
        self._ending = False

    def run(self) -> None:
        """Until `end`."""
        began = last = time.monotonic()
        passed = 0.0
        try:
            while not self._ending:
                self._links.serve(last + ROUND_S - time.monotonic())
                now = time.monotonic()
                late = now - began - passed / self._cycles_per_s
                if late > LATEST_S:
                    began += late - ROUND_S
                due = int((now - began) * self._cycles_per_s - passed)
                if now - last >= ROUND_S and due > 0:
                    self._pass(due, min(now - last, LATEST_S))
                    passed, last = passed + due, now
                    if self._changed_speed():
                        began, passed = now, 0.0
        finally:
            self._links.cut()
            self._witness.close()

    def end(self) -> None:
        """Let `run` return; may be called by a signal handler."""
        self._ending = True

    def _changed_speed(self) -> bool:
        asked = None if self._side is None else self._side.speed
        if self._side is None or asked is None:
            return False
        self._cycles_per_s, self._side.speed = asked / self._cycle_s, None
        return True

    def _pass(self, cycles: int, wall_s: float) -> None:
        self._faults.passed(cycles)
        if self._side is not None:
            self._side.look(self._faults)
        if not self._faults.mock.stopped:
            self._program.watch(wall_s)
            self._witness.passed(self._program.cycles(cycles))
