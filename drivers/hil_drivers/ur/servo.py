"""The robot program of a UR arm, led tick by tick: the two threads of the process that moves it.

`MotionThread` owns the program (`control.Control`). For every row of the controller it does what
the row calls for: the next set-point of a segment that is led by `servoj`, a kick for the
controller's watchdog while a move of the controller's own (`movej`) runs, or a stop. Commands of
`ur-rtde` may block, for minutes where the network is gone. Therefore `SupervisionThread` sees every
row whatever the library waits for. It judges silence, the end of the program and whether a stop is
obeyed; when one of them goes wrong it stops the arm without the library and ends the process. Both
share a `MotionState`.

Of a segment that is led, `SetPointFeed` says which set-point is due, by the robot's clock, and
`LagWatch` whether the arm follows. `Ramp` is what is known of one stop.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from enum import Enum, auto
from typing import Protocol

import numpy as np

from hil.core import (
    CommandRefused,
    FloatArray,
    HilError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
    StaleState,
    StructArray,
)
from hil.robot import Segment
from hil_drivers.ur.control import Control
from hil_drivers.ur.dashboard import stop_directly, stop_program
from hil_drivers.ur.options import MOST_ACCELERATION, MOST_SPEED, RAMP_SLACK_S, Options
from hil_drivers.ur.state import PLAYING, STILL_RAD_S, STOPPED, still

OBEY_WITHIN_S = 0.05
"""How soon the controller must be seen to obey a stop; the caller has other ways [s]."""

LOOK_S = 0.02

SEEN_HZ = 100.0
"""With fewer rows per second than this nothing shows soon enough whether the arm obeys."""

FRESH_S = 0.1
"""A state younger than this is taken for the present one where the arm is to be stopped [s]."""

AT_GOAL_RAD, LED_TO_RAD = 5e-4, 0.01
"""Where a move has to end, and where leading has to begin and end at the latest [rad]."""

SETTLE_S, ENDING_S = 2.0, 0.2
"""Device time to get to the last set-point, to be seen where a move ends [s]."""

KICKS_PER_PERIOD = 4.0


class MotionThread(threading.Thread):
    """Moves one arm by one robot program.

    Args:
        control: The program.
        ticks: Rows of the controller's state, none left out.
        options: Of the arm.
        rate_hz: Of rows and set-points.
        leave: Ends this process when the connection or the program is gone.

    Attributes:
        state: Of the motion.
        alone: The client has died: no other process stops the arm if this thread does not.
    """

    def __init__(
        self,
        control: Control,
        ticks: Ticks,
        options: Options,
        rate_hz: float,
        leave: Callable[[int], object] = os._exit,
    ) -> None:
        super().__init__(name="hil-ur-motion", daemon=True)
        self._control, self._options, self._rate_hz = control, options, rate_hz
        self._using = threading.Lock()
        self.state = MotionState(ticks.take(1.0)[-1], options)
        self._supervision = SupervisionThread(
            ticks, self.state, options, leave, lambda: control.connected
        )
        self._kicked = -np.inf
        self._until = np.inf
        self._goal: FloatArray = np.zeros(6)
        self._before = 0
        self._feed, self._lag = SetPointFeed(np.zeros((1, 6)), rate_hz, 0.0), LagWatch(0.0, 0.0)
        self.alone = False

    def run(self) -> None:
        """Answer every row until the end."""
        self._supervision.start()
        news = self.state.news
        while not self._supervision.ending.is_set():
            if news.wait(LOOK_S):
                news.clear()
                self._tick(self.state.newest)

    def start_move(self, segment: Segment) -> None:
        """Let the controller move to a segment's end on a path of its own.

        Raises:
            CommandRefused: It would never get there, or has not accepted that.
        """
        with self._starting():
            row = self.state.newest
            self._goal = segment.q[-1]
            self._before, _ = self._control.operation
            if _off(row, self._goal) < AT_GOAL_RAD:
                self.state.rest()
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
            self.state.turn(Phase.MOVE, out_of=(Phase.STARTING,))

    def start_led(self, segment: Segment) -> None:
        """Lead the arm along a segment's set-points, beginning with the next row.

        Raises:
            CommandRefused: The arm is not where the segment begins.
        """
        with self._starting():
            if (far := _off(self.state.newest, segment.q[0])) > LED_TO_RAD:
                raise CommandRefused(
                    f"segment {segment.index} begins {far:.4f} rad from where the arm stands",
                    hint="the arm was moved since the plan was made: plan again from here",
                )
            self._goal = segment.q[-1]
            self._feed = SetPointFeed(segment.q, self._rate_hz, self.state.begun)
            self._lag = LagWatch(self._options.lag_s, self._options.lag_rad)
            self.state.turn(Phase.LED, out_of=(Phase.STARTING,))

    def use(self, what: Callable[[Control], object]) -> None:
        """Do something with the program while the arm stands.

        Raises:
            CommandRefused: It moves.
        """
        if self.state.phase is not Phase.IDLE:
            raise CommandRefused("the arm is moving", hint="wait until the motion is over")
        with self._using:
            what(self._control)

    def stop(self) -> None:
        """Bring the arm to rest; from any thread.

        Raises:
            RobotTimeout: The arm was not seen to obey in time; tell the controller directly.
        """
        state = self.state
        state.stop_asked.set()
        state.news.set()
        if state.phase is Phase.IDLE or state.stop_obeyed.wait(OBEY_WITHIN_S):
            return
        if self.alone:
            self._supervision.leave(
                RobotFault(
                    "nobody is there, and the program does not stop the arm",
                    hint="press the emergency stop if the arm moves, then connect again",
                )
            )
            return
        raise RobotTimeout("the program does not stop the arm in time", hint="stop it directly")

    def end(self) -> None:
        """Bring both threads to their end."""
        self._supervision.ending.set()
        for thread in (self, self._supervision):
            if thread.is_alive() and thread is not threading.current_thread():
                thread.join(1.0)

    @contextlib.contextmanager
    def _starting(self) -> Iterator[None]:
        state = self.state
        if not state.turn(Phase.STARTING, out_of=(Phase.IDLE,)):
            raise CommandRefused("a segment is still running", hint="read until it is over")
        try:
            # After the phase was set: a stop that comes now either is seen here, or sees that.
            if state.stop_asked.is_set():
                raise CommandRefused("stopped before it was started", hint="prepare it again")
            with self._using:
                state.begun = float(state.newest["timestamp"])
                yield
        except BaseException as error:
            if isinstance(error, RobotConnectionError):
                self._supervision.leave(error)
            state.rest()
            raise

    def _tick(self, row: np.void) -> None:
        if not self._using.acquire(blocking=False):
            return  # another thread is commanding something, which is as good as a kick
        try:
            self._act(row)
        except HilError as error:
            self._fail(error)
        except Exception as error:
            self._fail(RobotFault(f"{type(error).__name__}: {error}", hint="connect again"))
        finally:
            self._using.release()

    def _act(self, row: np.void) -> None:
        """React to a row."""
        state = self.state
        if state.stop_asked.is_set() and state.under_way:
            self._brake(row)
        elif state.phase is Phase.LED:
            self._lead(row)
        else:
            now = float(row["timestamp"])
            if now - self._kicked >= 1.0 / (KICKS_PER_PERIOD * self._options.watchdog_hz):
                self._kicked = now
                self._control.kick()
            if state.phase is Phase.MOVE:
                self._watch_move(row)
            elif state.phase is Phase.SETTLING:
                self._settle(row)

    def _lead(self, row: np.void) -> None:
        """Command the set-point that is due in answer to a row.

        Raises:
            RobotFault: We are too late, or the arm does not follow.
        """
        now, options = float(row["timestamp"]), self._options
        q = self._feed.due(now)
        if self._feed.late_s > options.late_s:
            raise RobotFault(
                f"set-points were {self._feed.late_s:.3f} s late at device time {now:.3f} s, "
                f"{options.late_s:g} s are allowed",
                hint="give the computer less to do, or the arm's station a larger late_s",
            )
        self._lag.note(now, q)
        if self._lag.lost(row["target_q"]):
            off = self._lag.off(row["target_q"])
            joint = int(off.argmax())
            raise RobotFault(
                f"joint {joint + 1} is led {off[joint]:.4f} rad beside the path at device "
                f"time {now:.3f} s, {options.lag_rad:g} rad are allowed",
                hint="is the speed slider at 100 %? else raise gain, or lag_s and lag_rad",
            )
        self._control.servo_j(q.tolist(), options.lookahead_s, options.gain)
        if self._feed.over:
            self._until = now + SETTLE_S
            self.state.turn(Phase.SETTLING, out_of=(Phase.LED,))

    def _settle(self, row: np.void) -> None:
        far = _off(row, self._goal)
        if (far < AT_GOAL_RAD and still(row)) or float(row["timestamp"]) > self._until:
            self._control.servo_stop(self._options.stop_m_s2)
            self.state.turn(Phase.IDLE, out_of=(Phase.SETTLING,))
            self.state.stop_obeyed.set()
            if far > LED_TO_RAD:
                raise _ended_elsewhere(far)

    def _watch_move(self, row: np.void) -> None:
        number, running = self._control.operation
        if running or number == self._before or not still(row):
            self._until = np.inf
            return
        far, now = _off(row, self._goal), float(row["timestamp"])
        if far < AT_GOAL_RAD:
            self.state.rest()
            return
        # Operation and row come by two connections: the row may be from before the move.
        self._until = min(self._until, now + ENDING_S)
        if now > self._until:
            self.state.rest()
            raise _ended_elsewhere(far)

    def _brake(self, row: np.void) -> None:
        """End a motion and return once the arm is at rest, which supervision decides."""
        if time.monotonic() - self.state.heard > FRESH_S:
            return  # the line is silent: supervision takes another way
        begun = self.state.brake(row)
        if begun is None:
            return
        ramp, led = begun
        if self._rate_hz < SEEN_HZ:
            self.state.stop_obeyed.set()
        if led:
            self._control.servo_stop(ramp.deceleration)
        else:
            self._control.stop_j(ramp.deceleration)
        ramp.answered = True

    def _fail(self, error: HilError) -> None:
        """End a motion that does not go as it should; where the library does not, the session."""
        state = self.state
        if not isinstance(error, RobotFault):
            self._supervision.leave(error)
            return
        state.fail(error)
        try:
            self._brake(state.newest)
        except HilError as worse:
            self._supervision.leave(worse)


def _off(row: np.void, goal: FloatArray) -> float:
    """Return how far the controller's set-point is from `goal` (n,), by the furthest joint."""
    return float(np.abs(row["target_q"] - goal).max())


def _ended_elsewhere(far: float) -> RobotFault:
    return RobotFault(
        f"the motion ended {far:.4f} rad from its goal",
        hint="was it stopped at the teach pendant? connect again, and resume",
    )


JUMP_S = 0.04
"""Lateness that is made up for at once: `servoj` smooths over more than that [s]."""

CATCH_UP = 1.25
"""Set-points per tick at most where we are later than that: gently, not by a jump."""

TINY = 1e-6
"""Of a set-point: what time stamps lose by rounding."""


class SetPointFeed:
    """The set-points of one segment, paced by the robot's own time stamps.

    Ticks that were missed let the arm stand still on its last set-point. After a few it is where
    it ought to be with the next one; after more it goes on from where it stands, at most a quarter
    faster than planned, also where only every few ticks are answered. A robot that lives ten times
    as fast, or a host that is late, thus gets the same path.

    Args:
        q: (N, n) set-points [rad].
        rate_hz: Set-points per second of device time.
        begun: Device time at which the first one is commanded [s].

    Attributes:
        place: Index, also between two set-points, of what was commanded last.
        late_s: How far `place` is behind the schedule [s].
    """

    def __init__(self, q: FloatArray, rate_hz: float, begun: float) -> None:
        self._q = q
        self._rate_hz = rate_hz
        self._last_tick = begun
        self._begun = begun
        self.place = 0.0
        self.late_s = 0.0

    @property
    def over(self) -> bool:
        """Whether the last set-point was commanded."""
        return self.place >= len(self._q) - 1 - TINY

    def due(self, device_time: float) -> FloatArray:
        """Return (n,) the set-point for the robot's present time [rad]."""
        schedule = min((device_time - self._begun) * self._rate_hz, len(self._q) - 1.0)
        behind = max(schedule - self.place, 0.0)
        ticks = (device_time - self._last_tick) * self._rate_hz
        self._last_tick = device_time
        few = JUMP_S * self._rate_hz
        gently = CATCH_UP * (ticks if ticks <= few else 1.0)
        self.place += behind if behind <= few else min(behind, gently)
        self.late_s = (schedule - self.place) / self._rate_hz
        before = min(int(self.place), len(self._q) - 1)
        after = min(before + 1, len(self._q) - 1)
        part = self.place - before
        return np.asarray(self._q[before] * (1.0 - part) + self._q[after] * part)


class LagWatch:
    """Compares the controller's target with the set-points commanded lately.

    `servoj` smooths and follows late, so a plain difference grows with speed. What has to hold at
    any speed: every joint's target lies between the least and the most it was commanded within the
    last `lag_s`, give or take `lag_rad`.

    Args:
        lag_s: How late the target may be [s of device time].
        lag_rad: How far beside the commanded range it may be [rad].
    """

    def __init__(self, lag_s: float, lag_rad: float) -> None:
        self._lag_s, self._lag_rad = lag_s, lag_rad
        self._commanded: deque[tuple[float, FloatArray]] = deque()

    def note(self, device_time: float, q: FloatArray) -> None:
        """Note a set-point (n,) that was commanded."""
        self._commanded.append((device_time, q))
        # One older than the window stays: it is what was held when the window began.
        while len(self._commanded) > 1 and self._commanded[1][0] < device_time - self._lag_s:
            self._commanded.popleft()

    def off(self, target: FloatArray) -> FloatArray:
        """(n,) how far the controller's target is outside the range it was commanded [rad]."""
        commanded = np.array([q for _, q in self._commanded])
        if not len(commanded):
            return np.zeros_like(target)
        under, over = commanded.min(axis=0) - target, target - commanded.max(axis=0)
        return np.asarray(np.maximum(np.maximum(under, over), 0.0))

    def lost(self, target: FloatArray) -> bool:
        """Whether the arm does not follow."""
        return bool(self.off(target).max() > self._lag_rad)


class Phase(Enum):
    """Phase of a motion."""

    IDLE = auto()
    STARTING = auto()
    MOVE = auto()
    """The controller executes a move of its own."""
    LED = auto()
    """It is given a set-point per tick."""
    SETTLING = auto()
    """The last set-point was given; it is still on its way there."""
    BRAKING = auto()


UNDER_WAY = (Phase.MOVE, Phase.LED, Phase.SETTLING)
"""Phases that a stop ends."""


class MotionState:
    """Phase of the arm, shared by both threads; one of them at a time may change it.

    Args:
        newest: The newest row.
        options: Of the arm.

    Attributes:
        newest, heard: The newest row, and when it came [s, monotonic].
        phase: What the arm is doing.
        begun: Device time at which the newest motion began [s].
        failure: What ended it, reported once.
        ramp: The newest stop.
        stop_asked: Whether a stop was asked for since the newest segment was prepared.
        stop_obeyed: Whether the controller was seen to obey it.
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
        self.stop_asked, self.stop_obeyed, self.news = (threading.Event() for _ in range(3))

    @property
    def under_way(self) -> bool:
        """Whether a stop would end the present phase."""
        return self.phase in UNDER_WAY

    def clear(self) -> None:
        """A new segment is about to be started: stops that came before are done with."""
        self.stop_asked.clear()
        self.stop_obeyed.clear()

    def turn(self, to: Phase, *, out_of: tuple[Phase, ...]) -> bool:
        """Go over to another phase, unless another thread was faster."""
        with self._turning:
            if self.phase not in out_of:
                return False
            self.phase = to
            return True

    def rest(self) -> None:
        """Note that the arm is at rest, which ends a stop."""
        with self._turning:
            self.phase = Phase.IDLE
        self.stop_obeyed.set()

    def brake(self, row: np.void) -> tuple[Ramp, bool] | None:
        """Begin a stop; returns its ramp and whether the arm was led, None where nothing moves."""
        with self._turning:
            if self.phase not in UNDER_WAY:
                return None
            led = self.phase is not Phase.MOVE
            self.ramp = Ramp(row, self._options, led=led)
            self.phase = Phase.BRAKING
            return self.ramp, led

    def fail(self, error: HilError) -> None:
        """Note an error; the first one counts."""
        self.failure = self.failure or error


RAMP_GRACE_S = 0.3
"""Device time to be seen standing after the time of a ramp [s]."""

HARDEST_M_S2 = 150.0
"""UR's own limit of a deceleration at the tool [m/s²]."""


class Ramp:
    """One stop, from the request until the arm is at rest.

    The watchdog cannot be fed while the controller executes a stop: `ur-rtde` keeps the command
    in the register that counts as food, and writing there would take it back. So a ramp has to
    be over before the watchdog bites. `options_of` sees to that for moves; how fast the tool goes
    is not known before, so leading is stopped harder where the time would not do.

    Args:
        row: The newest one.
        options: Of the arm.
        led: Whether the arm was led along, which ends by decelerating the tool, not the joints.

    Attributes:
        deceleration: To be asked for [rad/s² of the fastest joint; where led, m/s² of the tool].
        answered: Whether the program has answered that the stop was made.
    """

    def __init__(self, row: np.void, options: Options, *, led: bool) -> None:
        fastest, tool = _fastest(row), _tool_speed(row)
        self.deceleration = options.stop_rad_s2
        ramp_s = fastest / options.stop_rad_s2
        if led:
            within_s = max(1.0 / options.watchdog_hz - RAMP_SLACK_S, RAMP_SLACK_S)
            self.deceleration = min(max(options.stop_m_s2, tool / within_s), HARDEST_M_S2)
            ramp_s = max(ramp_s, tool / self.deceleration)
        self._until = float(row["timestamp"]) + ramp_s + RAMP_GRACE_S
        self._most = fastest
        self.answered = False

    def falls(self, row: np.void) -> bool:
        """Whether the controller commands less speed than before: it has begun to stop."""
        fastest = _fastest(row)
        self._most = max(self._most, fastest)
        return fastest < self._most - STILL_RAD_S

    def stands(self, row: np.void) -> bool:
        """Return whether the arm has come to rest, and has not merely not begun to move."""
        return self.answered and still(row)

    def overdue(self, row: np.void) -> bool:
        """Return, once, whether the arm should be at rest by now and is not."""
        if float(row["timestamp"]) <= self._until:
            return False
        self._until = np.inf
        return not self.stands(row)


def _tool_speed(row: np.void) -> float:
    """As commanded; the larger of its translation [m/s] and its turning [rad/s]."""
    if "target_TCP_speed" in (row.dtype.names or ()):
        twist = row["target_TCP_speed"]
        return float(max(np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])))
    # No tool turns faster than all joints together.
    return float(np.abs(row["target_qd"]).sum())


def _fastest(row: np.void) -> float:
    """Of the joints, as commanded [rad/s]."""
    return float(np.abs(row["target_qd"]).max())


SILENT_S = 1.5
"""Without a word for so long the session is over. After 2.5 s `ur-rtde` would connect again by
itself, and upload its program, whatever the arm was doing [s]."""

DOZE_S = 0.05
"""A look that takes longer was held up by this computer: nothing is known of the controller [s]."""

LOST_EXIT, STALE_EXIT = 3, 4
"""Exit codes of a process that has lost its controller, or its program there; and of one that has
stopped the arm because nothing was heard of the controller."""

SILENCE_HINT = "check the network between this computer and the controller, then connect again"


class Ticks(Protocol):
    """Where the controller's samples come from: RTDE rows with the names of RTDE's variables."""

    @property
    def age_s(self) -> float:
        """Time since the controller's clock last advanced [s]."""

    def take(self, timeout_s: float) -> StructArray:
        """All rows since the last call, at least one; raises `RobotTimeout`."""


class SupervisionThread(threading.Thread):
    """Supervises silence, the end of the program, and stops.

    `ur-rtde` connects again by itself as soon as its own connection ends: it stops the program,
    uploads it once more without a watchdog, and repeats the command it was about to give. From
    here that looks like a program that ends, a command that fails, or like nothing at all but a
    connection that is another one. Whatever it is, this process goes before anything more can be
    commanded; to go on, the client connects again.

    Args:
        ticks: Rows of the controller's state, none left out.
        state: What the arm is doing.
        options: Of the arm.
        exit_: Ends this process, with an exit code.
        connected: Whether `ur-rtde` has its first connection still.
    """

    def __init__(
        self,
        ticks: Ticks,
        state: MotionState,
        options: Options,
        exit_: Callable[[int], object],
        connected: Callable[[], bool] = lambda: True,
    ) -> None:
        super().__init__(name="hil-ur-supervision", daemon=True)
        self._connected = connected
        self._ticks, self._state, self._options = ticks, state, options
        self._exit = exit_
        self._leaving = threading.Lock()
        self._looked, self._dozed = time.monotonic(), False
        self.ending = threading.Event()

    def run(self) -> None:
        """Look at every row until the end."""
        while not self.ending.is_set():
            self._looked = time.monotonic()
            try:
                rows = self._ticks.take(LOOK_S)
            except RobotTimeout:
                self._silent()
            except HilError as error:
                self._lost(error.message)
            except Exception as error:
                self._lost(f"{type(error).__name__}: {error}")
            else:
                self._see(rows)

    def _see(self, rows: StructArray) -> None:
        state = self._state
        if not self._connected():
            return self._cut_off()
        # A repeated state is no news: a controller that hangs is silent, and gets no set-point that
        # might come in after the stop.
        news = rows[-1]["timestamp"] != state.newest["timestamp"]
        state.newest, state.heard = rows[-1], time.monotonic() - self._ticks.age_s
        ended = rows["runtime_state"] != PLAYING
        if ended.any():
            return self._program_ended(rows[ended][0])
        if state.phase is Phase.BRAKING:
            self._watch_ramp(rows)
        if news:
            state.news.set()
        if self._ticks.age_s > self._options.late_s:
            self._silent()
        else:
            self._dozed = False

    def _watch_ramp(self, rows: StructArray) -> None:
        ramp, newest = self._state.ramp, rows[-1]
        if ramp is None:
            return
        if any(ramp.falls(row) for row in rows):
            self._state.stop_obeyed.set()
        if ramp.stands(newest):
            self._state.rest()
        elif ramp.overdue(newest):
            self.leave(
                RobotFault(
                    "the arm has not come to rest in the time of its stop: it was stopped directly",
                    hint="see to the robot itself, then connect again",
                )
            )

    def _silent(self) -> None:
        """Nothing comes: `ur-rtde` would wait for an answer, for minutes if need be."""
        # After a look that was held up, rows may wait to be taken: that is not believed twice.
        held_up = time.monotonic() - self._looked > DOZE_S
        self._dozed = held_up and not self._dozed
        if self._dozed:
            return
        state = self._state
        for_s = time.monotonic() - state.heard
        if not self._connected():
            return self._cut_off()
        if self._ticks.age_s > SILENT_S:
            return self._lost(f"the controller has not said anything for {for_s:.1f} s")
        allowed_s = FRESH_S if state.stop_asked.is_set() else self._options.late_s
        if state.under_way and for_s > allowed_s:
            self.leave(
                StaleState(
                    f"the controller has not said anything for {for_s:.2f} s while the arm was "
                    "moving",
                    hint=SILENCE_HINT,
                )
            )

    def _program_ended(self, row: np.void) -> None:
        """Give up after the program has ended; a paused one would go on with its old move."""
        at = f"at device time {float(row['timestamp']):.3f} s"
        self.leave(
            RobotFault(
                f"the robot program ended {at}",
                hint="look for a stop or a message at the teach pendant, connect again; `hil "
                "resume` goes on at the last checkpoint",
            ),
            paused=int(row["runtime_state"]) != STOPPED,
        )

    def _cut_off(self) -> None:
        """The program is not led any more; one that was uploaded anew has no watchdog."""
        self.leave(
            RobotConnectionError(
                "connection lost: ur-rtde's own has ended",
                hint="check the network, then connect again",
            ),
            paused=True,
        )

    def _lost(self, why: str) -> None:
        self.leave(
            RobotConnectionError(
                f"connection lost: {why}", hint="check the network, then connect again"
            )
        )

    def leave(self, error: HilError, *, paused: bool = False) -> None:
        """Stop the arm without `ur-rtde`, and leave before that does anything more; once.

        Args:
            error: Why; the last word of this process.
            paused: Whether the program may go on without us, and must be ended.
        """
        with self._leaving:
            if self.ending.is_set():
                return
            self.ending.set()
        options, stopped = self._options, False
        if self._state.phase is not Phase.IDLE:
            stopped = stop_directly(options.address, options.stop_rad_s2)
        if paused:
            stopped = stop_program(options.address) or stopped
        if stopped:
            self._state.stop_obeyed.set()
        self._state.fail(error)
        print(error.message, file=sys.stderr, flush=True)  # noqa: T201
        self._exit(STALE_EXIT if isinstance(error, StaleState) else LOST_EXIT)
