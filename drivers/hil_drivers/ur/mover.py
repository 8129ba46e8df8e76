"""The thread that owns the robot program: leads the arm, kicks the watchdog, stops it."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np

from hil.errors import (
    CommandRefused,
    HilError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
    StaleState,
)
from hil.robot import Segment
from hil.typing import FloatArray, StructArray
from hil_drivers.ur.checks import MOST_ACCELERATION, MOST_SPEED
from hil_drivers.ur.control import Control
from hil_drivers.ur.direct_stop import stop_directly
from hil_drivers.ur.leading import Leading
from hil_drivers.ur.options import Options
from hil_drivers.ur.phases import (
    AT_GOAL_RAD,
    LED_TO_RAD,
    PLAYING,
    UNDER_WAY,
    Phase,
    elsewhere,
    off,
    still,
)

LOOK_S = 0.02
FRESH_S = 0.1
"""A state younger than this is taken for the present one where the arm is to be stopped [s]."""

OBEY_WITHIN_S = 0.03
"""How soon a stop must have been handed to the controller; whoever asked has other ways [s]."""

SILENT_S = 1.5
"""Without a word for so long the session is over. After 2.5 s `ur-rtde` would connect again by
itself, and upload its program, whatever the arm was doing [s]."""

SETTLE_S, ENDING_S, RAMP_GRACE_S = 2.0, 0.2, 0.3
"""Device time to get to the last set-point, to be seen where a move ends, to be seen standing
after the time of a ramp [s]."""

KICKS_PER_PERIOD = 4.0
LOST_EXIT = 3
"""Exit code of a process that has lost its controller."""


class Ticks(Protocol):
    """Where the controller's samples come from: RTDE rows with the names of RTDE's variables."""

    @property
    def age_s(self) -> float:
        """How long ago the newest one came [s]."""

    def take(self, timeout_s: float) -> StructArray:
        """All rows since the last call, at least one; raises `RobotTimeout`."""


class Mover(threading.Thread):
    """Moves one arm by one robot program.

    Args:
        control: The program.
        ticks: Rows of the controller's state, none left out.
        options: Of the arm.
        frequency_hz: Of rows and set-points.
        leave: Ends this process when the connection is gone.

    Attributes:
        newest: The newest row.
        phase: What the arm is doing.
        begun: Device time at which the newest motion began [s].
        failure: What ended it, told once.
        alone: Nobody is there any more who could stop the arm if this thread does not.
    """

    def __init__(
        self,
        control: Control,
        ticks: Ticks,
        options: Options,
        frequency_hz: float,
        leave: Callable[[int], object] = os._exit,
    ) -> None:
        super().__init__(name="hil-ur-mover", daemon=True)
        self._control, self._ticks, self._options = control, ticks, options
        self._rate_hz, self._leave = frequency_hz, leave
        self._using = threading.Lock()
        self._halted, self._obeyed = threading.Event(), threading.Event()
        self._ending = threading.Event()
        self._begin_again = False
        self._kicked = -np.inf
        self._until = np.inf
        self._goal: FloatArray = np.zeros(6)
        self._before = 0
        self._leading: Leading | None = None
        self.newest: np.void = ticks.take(1.0)[-1]
        self._heard = time.monotonic()
        self.phase = Phase.IDLE
        self.begun = -np.inf
        self.failure: HilError | None = None
        self.alone = False

    def run(self) -> None:
        """Look at every row until the end."""
        threading.Thread(target=self._keep_watch, name="hil-ur-watch", daemon=True).start()
        while not self._ending.is_set():
            try:
                rows = self._ticks.take(LOOK_S)
            except RobotTimeout:
                for_s = time.monotonic() - self._heard
                if self._halted.is_set() and for_s < FRESH_S:
                    self._tick(self.newest)
                else:
                    self._silent(for_s)
            except HilError as error:
                self._lost(error.message)
            else:
                self.newest, self._heard = rows[-1], time.monotonic()
                self._tick(rows[-1])

    def clear(self) -> None:
        """A new segment is about to be started: stops that came before are done with."""
        self._halted.clear()
        self._obeyed.clear()

    def start_move(self, segment: Segment) -> None:
        """Let the controller move to a segment's end, by its own plan.

        Raises:
            CommandRefused: It has not accepted that.
        """
        with self._starting():
            self._goal = segment.q[-1]
            self._before, _ = self._control.operation
            self.begun = float(self.newest["timestamp"])
            if off(self.newest, self._goal) < AT_GOAL_RAD:
                self._rest()
                return
            speed = min(segment.speed, MOST_SPEED)
            acceleration = min(segment.acceleration, MOST_ACCELERATION)
            self._control.move_j(self._goal.tolist(), speed, acceleration)
            self._until = np.inf
            self.phase = Phase.MOVE

    def start_led(self, segment: Segment) -> None:
        """Lead the arm along a segment's set-points, beginning with the next tick.

        Raises:
            CommandRefused: The arm is not where the segment begins.
        """
        with self._starting():
            if (far := off(self.newest, segment.q[0])) > LED_TO_RAD:
                raise CommandRefused(
                    f"segment {segment.index} begins {far:.4f} rad from where the arm stands",
                    hint="the arm was moved since the plan was made: plan again from here",
                )
            self._goal = segment.q[-1]
            self.begun = float(self.newest["timestamp"])
            self._leading = Leading(segment, self._rate_hz, self.begun, self._options)
            self.phase = Phase.LED

    def use(self, what: Callable[[Control], object]) -> None:
        """Do something with the program while the arm stands.

        Raises:
            CommandRefused: It moves.
        """
        if self.phase is not Phase.IDLE:
            raise CommandRefused("the arm is moving", hint="wait until the motion is over")
        with self._using:
            self._ready()
            what(self._control)

    def stop(self) -> None:
        """Bring the arm to rest; from any thread.

        Raises:
            RobotTimeout: The program could not be told in time; tell the controller directly.
        """
        self._halted.set()
        if self.phase is Phase.IDLE or self._obeyed.wait(OBEY_WITHIN_S):
            return
        if self.alone:
            self._stop_directly()
            return
        raise RobotTimeout("ur-rtde is busy and cannot stop the arm", hint="stop it directly")

    def end(self) -> None:
        """Bring the thread to its end."""
        self._ending.set()
        if self is not threading.current_thread():
            self.join(1.0)

    @contextlib.contextmanager
    def _starting(self) -> Iterator[None]:
        if self.phase is not Phase.IDLE:
            raise CommandRefused("a segment is still running", hint="read until it is over")
        if self._halted.is_set():
            raise CommandRefused("stopped before it was started", hint="prepare it again")
        self.phase = Phase.STARTING
        try:
            with self._using:
                self._ready()
                yield
        except BaseException:
            self._rest()
            raise

    def _rest(self) -> None:
        """The arm stands; whoever waits for a stop to be obeyed need not wait any more."""
        self.phase = Phase.IDLE
        self._obeyed.set()

    def _ready(self) -> None:
        """Upload the program again if it was us who ended it; nobody else's stop is undone."""
        if self._begin_again:
            self._control.begin_again(self._options.watchdog_hz)
            self._begin_again = False

    def _tick(self, row: np.void) -> None:
        if not self._using.acquire(blocking=False):
            return  # whoever has it is just commanding something, which is as good as a kick
        try:
            self._act(row)
        except HilError as error:
            self._fail(error)
        finally:
            self._using.release()

    def _act(self, row: np.void) -> None:
        if int(row["runtime_state"]) != PLAYING:
            self._not_playing(row)
        elif self._halted.is_set() and self.phase in UNDER_WAY:
            self._brake(row)
        elif self.phase is Phase.LED:
            self._lead(row)
        else:
            self._kick(row)
            if self.phase is Phase.MOVE:
                self._watch_move(row)
            elif self.phase is Phase.SETTLING:
                self._settle(row)
            elif self.phase is Phase.BRAKING:
                self._watch_ramp(row)

    def _not_playing(self, row: np.void) -> None:
        if self.phase is Phase.BRAKING:
            self._watch_ramp(row)
        elif self.phase not in (Phase.IDLE, Phase.STARTING):
            self._rest()
            raise RobotFault(
                f"the robot program ended at device time {float(row['timestamp']):.3f} s while the "
                "arm was moving",
                hint="look for a stop or a message at the teach pendant; `hil resume` goes on at "
                "the last checkpoint",
            )

    def _kick(self, row: np.void) -> None:
        if self._begin_again:
            return  # that is not our program any more
        now = float(row["timestamp"])
        if now - self._kicked >= 1.0 / (KICKS_PER_PERIOD * self._options.watchdog_hz):
            self._kicked = now
            self._control.kick()

    def _lead(self, row: np.void) -> None:
        if self._leading is None:
            return
        q = self._leading.due(row)
        self._control.servo_j(q.tolist(), self._options.lookahead_s, self._options.gain)
        if self._leading.over:
            self.phase, self._until = Phase.SETTLING, float(row["timestamp"]) + SETTLE_S

    def _settle(self, row: np.void) -> None:
        far = off(row, self._goal)
        if (far < AT_GOAL_RAD and still(row)) or float(row["timestamp"]) > self._until:
            self._control.servo_stop(self._options.stop_m_s2)
            self._rest()
            if far > LED_TO_RAD:
                raise elsewhere(far)

    def _watch_move(self, row: np.void) -> None:
        number, running = self._control.operation
        if running or number == self._before or not still(row):
            self._until = np.inf
            return
        far, now = off(row, self._goal), float(row["timestamp"])
        if far < AT_GOAL_RAD:
            self._rest()
            return
        # Operation and row come by two connections: the row may be from before the move.
        self._until = min(self._until, now + ENDING_S)
        if now > self._until:
            self._rest()
            raise elsewhere(far)

    def _brake(self, row: np.void) -> None:
        phase, self.phase = self.phase, Phase.BRAKING
        speed = float(np.abs(row["target_qd"]).max())
        ramp_s = speed / self._options.stop_rad_s2 + RAMP_GRACE_S
        self._until = float(row["timestamp"]) + ramp_s
        self._obeyed.set()
        if phase is Phase.MOVE:
            self._control.stop_j(self._options.stop_rad_s2)
        else:
            self._control.servo_stop(self._options.stop_m_s2)

    def _watch_ramp(self, row: np.void) -> None:
        if still(row):
            self._rest()
        elif float(row["timestamp"]) > self._until:
            self._until = np.inf
            self._stop_directly()

    def _stop_directly(self) -> None:
        """By another program, which ends ours; the next segment uploads it again."""
        self._begin_again = True
        stop_directly(self._options.address, self._options.stop_rad_s2)

    def _fail(self, error: HilError) -> None:
        """Note why a motion ended, and end it."""
        self.failure = self.failure or error
        if self.phase in UNDER_WAY:
            try:
                self._brake(self.newest)
            except HilError:
                self._stop_directly()
        elif self.phase is Phase.BRAKING:
            self._stop_directly()

    def _silent(self, for_s: float) -> None:
        """Nothing comes: `ur-rtde` would wait for an answer, for minutes if need be."""
        moves = self.phase in UNDER_WAY
        if moves and for_s > self._options.late_s:
            self.failure = self.failure or StaleState(
                f"the controller has not said anything for {for_s:.2f} s while the arm was moving",
                hint="check the network between this computer and the controller",
            )
        if moves and (self.failure is not None or self._halted.is_set()):
            self.phase = Phase.BRAKING
            self._obeyed.set()
            self._until = np.inf
            self._stop_directly()

    def _keep_watch(self) -> None:
        """On a thread of its own: whatever `ur-rtde` waits for, silence ends the session."""
        while not self._ending.wait(LOOK_S):
            if self._ticks.age_s > SILENT_S:
                self._lost(f"the controller has not said anything for {self._ticks.age_s:.1f} s")

    def _lost(self, why: str) -> None:
        """Leave before `ur-rtde` connects again by itself."""
        if self._ending.is_set():
            return
        if self.phase is not Phase.IDLE:
            self._stop_directly()
        self.failure = RobotConnectionError(why, hint="check the network, then connect again")
        print(f"connection lost: {why}", file=sys.stderr, flush=True)  # noqa: T201
        self._ending.set()
        self._leave(LOST_EXIT)
