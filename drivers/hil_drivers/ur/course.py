"""What the arm is doing: known to the thread that commands it and to the one that watches it."""

from __future__ import annotations

import threading
import time

import numpy as np

from hil.core import HilError
from hil_drivers.ur.braking import Ramp
from hil_drivers.ur.options import Options
from hil_drivers.ur.phases import UNDER_WAY, Phase


class Course:
    """The state that threads share. Only one of them may end or begin something at a time.

    Args:
        newest: The newest row.
        options: Of the arm.

    Attributes:
        newest, heard: The newest row, and when it came [s, monotonic].
        phase: What the arm is doing.
        begun: Device time at which the newest motion began [s].
        failure: What ended it, told once.
        ramp: The newest stop.
        asked: Whether a stop was asked for since the newest segment was prepared.
        obeyed: Whether the controller was seen to obey it.
        news: There is a new row, or a stop to be made.
    """

    def __init__(self, newest: np.void, options: Options) -> None:
        self._options = options
        self._turning = threading.Lock()
        self.newest, self.heard = newest, time.monotonic()
        self.phase = Phase.IDLE
        self.begun = -np.inf
        self.failure: HilError | None = None
        self.ramp: Ramp | None = None
        self.asked, self.obeyed, self.news = (threading.Event() for _ in range(3))

    @property
    def under_way(self) -> bool:
        """Whether it does what a stop ends."""
        return self.phase in UNDER_WAY

    def clear(self) -> None:
        """A new segment is about to be started: stops that came before are done with."""
        self.asked.clear()
        self.obeyed.clear()

    def turn(self, to: Phase, *, out_of: tuple[Phase, ...]) -> bool:
        """Go over to another phase, unless another thread was faster."""
        with self._turning:
            if self.phase not in out_of:
                return False
            self.phase = to
            return True

    def rest(self) -> None:
        """The arm stands; whoever waits for a stop to be obeyed need not wait any more."""
        with self._turning:
            self.phase = Phase.IDLE
        self.obeyed.set()

    def brake(self, row: np.void) -> tuple[Ramp, bool] | None:
        """Begin a stop; tells its ramp, and whether the arm was led, or None: it is no use."""
        with self._turning:
            if self.phase not in UNDER_WAY:
                return None
            led = self.phase is not Phase.MOVE
            self.ramp = Ramp(row, self._options, led=led)
            self.phase = Phase.BRAKING
            return self.ramp, led

    def fail(self, error: HilError) -> None:
        """Note what went wrong first."""
        self.failure = self.failure or error
