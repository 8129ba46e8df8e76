"""What is commanded in answer to one row of the controller: moves, set-points, kicks, stops."""

from __future__ import annotations

import time

import numpy as np

from hil.core import CommandRefused, FloatArray
from hil.robot import Segment
from hil_drivers.ur.control import Control
from hil_drivers.ur.course import Course
from hil_drivers.ur.leading import Leading
from hil_drivers.ur.lookout import FRESH_S
from hil_drivers.ur.options import MOST_ACCELERATION, MOST_SPEED, Options
from hil_drivers.ur.phases import AT_GOAL_RAD, LED_TO_RAD, Phase, elsewhere, off, still

SEEN_HZ = 100.0
"""With fewer rows per second than this nobody can see soon enough whether the arm obeys."""

SETTLE_S, ENDING_S = 2.0, 0.2
"""Device time to get to the last set-point, to be seen where a move ends [s]."""

KICKS_PER_PERIOD = 4.0


class Hands:
    """Has the program do things; for whoever has the right to use it, one thread at a time.

    Args:
        control: The program.
        course: What the arm is doing.
        options: Of the arm.
        rate_hz: Of rows and set-points.
    """

    def __init__(self, control: Control, course: Course, options: Options, rate_hz: float) -> None:
        self._control, self.course = control, course
        self._options, self._rate_hz = options, rate_hz
        self._kicked = -np.inf
        self._until = np.inf
        self._goal: FloatArray = np.zeros(6)
        self._before = 0
        self._leading: Leading | None = None

    def move(self, segment: Segment) -> None:
        """Begin a move of the controller's own to a segment's end.

        Raises:
            CommandRefused: It would never get there, or has not accepted that.
        """
        row = self.course.newest
        self._goal = segment.q[-1]
        self._before, _ = self._control.operation
        if off(row, self._goal) < AT_GOAL_RAD:
            self.course.rest()
            return
        if not min(segment.speed, segment.acceleration) > 0.0:
            raise CommandRefused(
                f"segment {segment.index} has a way to go with no speed or no acceleration",
                hint="plan it again",
            )
        speed = min(segment.speed, MOST_SPEED)
        acceleration = min(segment.acceleration, MOST_ACCELERATION)
        self._control.move_j(self._goal.tolist(), speed, acceleration)
        self._until = np.inf
        self.course.turn(Phase.MOVE, out_of=(Phase.STARTING,))

    def lead(self, segment: Segment) -> None:
        """Lead the arm along a segment's set-points, beginning with the next row.

        Raises:
            CommandRefused: The arm is not where the segment begins.
        """
        if (far := off(self.course.newest, segment.q[0])) > LED_TO_RAD:
            raise CommandRefused(
                f"segment {segment.index} begins {far:.4f} rad from where the arm stands",
                hint="the arm was moved since the plan was made: plan again from here",
            )
        self._goal = segment.q[-1]
        self._leading = Leading(segment, self._rate_hz, self.course.begun, self._options)
        self.course.turn(Phase.LED, out_of=(Phase.STARTING,))

    def act(self, row: np.void) -> None:
        """Do what a row calls for."""
        course = self.course
        if course.asked.is_set() and course.under_way:
            self.brake(row)
        elif course.phase is Phase.LED:
            self._go_on(row)
        else:
            self._kick(row)
            if course.phase is Phase.MOVE:
                self._watch_move(row)
            elif course.phase is Phase.SETTLING:
                self._settle(row)

    def brake(self, row: np.void) -> None:
        """End a motion; comes back when the arm stands. The lookout sees how it obeys."""
        if time.monotonic() - self.course.heard > FRESH_S:
            return  # the line is silent: the lookout takes another way
        begun = self.course.brake(row)
        if begun is None:
            return
        ramp, led = begun
        if self._rate_hz < SEEN_HZ:
            self.course.obeyed.set()
        if led:
            self._control.servo_stop(ramp.deceleration)
        else:
            self._control.stop_j(ramp.deceleration)
        ramp.told = True

    def _kick(self, row: np.void) -> None:
        now = float(row["timestamp"])
        if now - self._kicked >= 1.0 / (KICKS_PER_PERIOD * self._options.watchdog_hz):
            self._kicked = now
            self._control.kick()

    def _go_on(self, row: np.void) -> None:
        if self._leading is None:
            return
        q = self._leading.due(row)
        self._control.servo_j(q.tolist(), self._options.lookahead_s, self._options.gain)
        if self._leading.over:
            self._until = float(row["timestamp"]) + SETTLE_S
            self.course.turn(Phase.SETTLING, out_of=(Phase.LED,))

    def _settle(self, row: np.void) -> None:
        far = off(row, self._goal)
        if (far < AT_GOAL_RAD and still(row)) or float(row["timestamp"]) > self._until:
            self._control.servo_stop(self._options.stop_m_s2)
            self.course.turn(Phase.IDLE, out_of=(Phase.SETTLING,))
            self.course.obeyed.set()
            if far > LED_TO_RAD:
                raise elsewhere(far)

    def _watch_move(self, row: np.void) -> None:
        number, running = self._control.operation
        if running or number == self._before or not still(row):
            self._until = np.inf
            return
        far, now = off(row, self._goal), float(row["timestamp"])
        if far < AT_GOAL_RAD:
            self.course.rest()
            return
        # Operation and row come by two connections: the row may be from before the move.
        self._until = min(self._until, now + ENDING_S)
        if now > self._until:
            self.course.rest()
            raise elsewhere(far)
