"""Threads that execute motions of a UR arm, one step per controller row.

`MotionThread` owns the robot program (`control.Control`). For every row of the controller,
`MotionThread` takes one action: send the next `servoj` set-point of a segment, reset the
controller's watchdog during a controller-planned move (`movej`), or stop the arm. Calls of
`ur-rtde` can block for minutes if the network is down. Therefore `SupervisionThread` receives every
row independently of the library. `SupervisionThread` checks for silence of the controller, for the
end of the program, and whether the arm obeys a stop. If a check fails, `SupervisionThread` stops
the arm without the library and ends the process. `MotionThread` and `SupervisionThread` share a
`MotionState`.

For a segment executed by `servoj`, `SetPointFeed` computes the set-point that is due by the robot's
clock, and `LagWatch` checks whether the arm follows. `Ramp` contains the deceleration and the time
limit of one stop.
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
"""Time limit for the first sign that the controller obeys a stop [s]; if the limit is exceeded,
the caller stops the arm by a different method."""

LOOK_S = 0.02

SEEN_HZ = 100.0
"""Minimum rate of rows [Hz] at which the rows show early enough whether the arm obeys a stop."""

FRESH_S = 0.1
"""Maximum age of a row that is used as the present state in a stop [s]."""

AT_GOAL_RAD, LED_TO_RAD = 5e-4, 0.01
"""Tolerances of the largest joint error [rad]: at the end of a move (`AT_GOAL_RAD`), and at the
start and end of a `servoj` segment (`LED_TO_RAD`)."""

SETTLE_S, ENDING_S = 2.0, 0.2
"""Device times [s]: for the arm to settle at the last set-point (`SETTLE_S`), and to confirm the
end of a move (`ENDING_S`)."""

KICKS_PER_PERIOD = 4.0


class MotionThread(threading.Thread):
    """Thread that moves one arm through one robot program.

    Args:
        control: Connection to the robot program.
        ticks: Source of all rows of the controller's state, without gaps.
        options: Options of the arm.
        rate_hz: Rate of rows and of set-points [Hz].
        leave: Function that ends this process with an exit code, called when the connection or the
            program is lost.

    Attributes:
        state: State of the motion.
        alone: Whether the client process has died, so that only this thread can stop the arm.
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
        """Process every new row until the supervision ends."""
        self._supervision.start()
        news = self.state.news
        while not self._supervision.ending.is_set():
            if news.wait(LOOK_S):
                news.clear()
                self._tick(self.state.newest)

    def start_move(self, segment: Segment) -> None:
        """Start a controller-planned move to the end of a segment.

        No move is sent if the arm is already within `AT_GOAL_RAD` of that end.

        Raises:
            CommandRefused: The speed or acceleration of the segment is zero, a segment is running,
                a stop was requested, or the controller does not accept the move.
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
                    f"segment {segment.index} is a motion with zero speed or zero acceleration",
                    hint="plan it again",
                )
            speed = min(segment.speed, MOST_SPEED)
            acceleration = min(segment.acceleration, MOST_ACCELERATION)
            self._control.move_j(self._goal.tolist(), speed, acceleration)
            self._until = np.inf
            self.state.turn(Phase.MOVE, out_of=(Phase.STARTING,))

    def start_led(self, segment: Segment) -> None:
        """Start sending the set-points of a segment by `servoj`, beginning with the next row.

        Raises:
            CommandRefused: The arm is more than `LED_TO_RAD` from the start of the segment, a
                segment is running, or a stop was requested.
        """
        with self._starting():
            if (far := _off(self.state.newest, segment.q[0])) > LED_TO_RAD:
                raise CommandRefused(
                    f"segment {segment.index} begins {far:.4f} rad from the position of the arm",
                    hint="the arm was moved since the plan was made: plan again from here",
                )
            self._goal = segment.q[-1]
            self._feed = SetPointFeed(segment.q, self._rate_hz, self.state.begun)
            self._lag = LagWatch(self._options.lag_s, self._options.lag_rad)
            self.state.turn(Phase.LED, out_of=(Phase.STARTING,))

    def use(self, what: Callable[[Control], object]) -> None:
        """Call a function with the robot program as its argument while the arm is not moving.

        Raises:
            CommandRefused: The arm is moving.
        """
        if self.state.phase is not Phase.IDLE:
            raise CommandRefused("the arm is moving", hint="wait until the motion is over")
        with self._using:
            what(self._control)

    def stop(self) -> None:
        """Stop the arm; callable from any thread.

        Raises:
            RobotTimeout: The rows did not show within `OBEY_WITHIN_S` that the arm obeys; the
                caller must stop the arm through the controller directly.
        """
        state = self.state
        state.stop_asked.set()
        state.news.set()
        if state.phase is Phase.IDLE or state.stop_obeyed.wait(OBEY_WITHIN_S):
            return
        if self.alone:
            self._supervision.leave(
                RobotFault(
                    "the client process has died, and the program does not stop the arm",
                    hint="press the emergency stop if the arm moves, then connect again",
                )
            )
            return
        raise RobotTimeout(
            "the program does not stop the arm in time", hint="stop the arm directly"
        )

    def end(self) -> None:
        """End the motion thread and the supervision thread."""
        self._supervision.ending.set()
        for thread in (self, self._supervision):
            if thread.is_alive() and thread is not threading.current_thread():
                thread.join(1.0)

    @contextlib.contextmanager
    def _starting(self) -> Iterator[None]:
        state = self.state
        if not state.turn(Phase.STARTING, out_of=(Phase.IDLE,)):
            raise CommandRefused("a segment is still running", hint="read until the segment ends")
        try:
            # Check after setting the phase: a concurrent stop is either detected here or sees the
            # phase.
            if state.stop_asked.is_set():
                raise CommandRefused(
                    "the segment was stopped before its start", hint="prepare it again"
                )
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
            return  # another thread sends a command, which also resets the watchdog
        try:
            self._act(row)
        except HilError as error:
            self._fail(error)
        except Exception as error:
            self._fail(RobotFault(f"{type(error).__name__}: {error}", hint="connect again"))
        finally:
            self._using.release()

    def _act(self, row: np.void) -> None:
        """Take the action that a row requires in the present phase."""
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
        """Send the set-point that is due at the time of a row.

        Raises:
            RobotFault: The set-points are later than allowed, or the arm does not follow them.
        """
        now, options = float(row["timestamp"]), self._options
        q = self._feed.due(now)
        if self._feed.late_s > options.late_s:
            raise RobotFault(
                f"set-points were {self._feed.late_s:.3f} s late at device time {now:.3f} s, "
                f"{options.late_s:g} s are allowed",
                hint="end other programs on this computer, or set a larger late_s in the station",
            )
        self._lag.note(now, q)
        if self._lag.lost(row["target_q"]):
            off = self._lag.off(row["target_q"])
            joint = int(off.argmax())
            raise RobotFault(
                f"joint {joint + 1} is {off[joint]:.4f} rad off the path at device "
                f"time {now:.3f} s, {options.lag_rad:g} rad are allowed",
                hint="set the speed slider to 100 %, or raise gain, or lag_s and lag_rad",
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
        # Operation and row use two connections: the row is possibly older than the move.
        self._until = min(self._until, now + ENDING_S)
        if now > self._until:
            self.state.rest()
            raise _ended_elsewhere(far)

    def _brake(self, row: np.void) -> None:
        """Command a stop; the call returns when the arm is at rest.

        The supervision thread decides whether the arm is at rest.
        """
        if time.monotonic() - self.state.heard > FRESH_S:
            return  # the controller is silent: supervision stops the arm directly
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
        """Handle an error: stop the motion after a `RobotFault`, else end the session.

        The session also ends if the library fails to stop the motion.
        """
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
    """Return the largest distance of a joint set-point of the controller from `goal` (n,) [rad]."""
    return float(np.abs(row["target_q"] - goal).max())


def _ended_elsewhere(far: float) -> RobotFault:
    return RobotFault(
        f"the motion ended {far:.4f} rad from its goal",
        hint="see the teach pendant for a stop, then connect again and resume",
    )


JUMP_S = 0.04
"""Delay [s] up to which the set-point feed catches up in one step, because `servoj` smooths a
step of this size."""

CATCH_UP = 1.25
"""Maximum number of set-points per tick if the delay of the feed exceeds `JUMP_S`; a larger step
would make the arm jump."""

TINY = 1e-6
"""Tolerance of the index of a set-point, for rounding errors of the time stamps."""


class SetPointFeed:
    """Set-points of one segment, paced by the robot's time stamps.

    While ticks are missed, the arm remains at its last set-point. If the delay is at most `JUMP_S`,
    the next set-point is again on schedule. After a longer delay the feed continues from its
    present position, at most 25 % faster than planned. This limit also applies if the feed is
    called only every few ticks. The path is therefore the same in a simulation at ten times real
    time and on a slow host.

    Args:
        q: (N, n) set-points [rad].
        rate_hz: Set-points per second of device time.
        begun: Device time of the first set-point [s].

    Attributes:
        place: Index of the last commanded set-point; fractional between two set-points.
        late_s: Delay of `place` behind the schedule [s].
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
        """Return the set-point (n,) for the present device time [rad]."""
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
    """Comparison of the controller's target with recently commanded set-points.

    `servoj` smooths and delays the motion, so the plain difference between target and set-point
    grows with speed. `LagWatch` uses a criterion that is independent of speed: the target of every
    joint must lie between the minimum and maximum of its set-points in the last `lag_s`, with a
    tolerance of `lag_rad`.

    Args:
        lag_s: Maximum delay of the target behind the set-points [s of device time].
        lag_rad: Maximum distance of the target from the commanded range [rad].
    """

    def __init__(self, lag_s: float, lag_rad: float) -> None:
        self._lag_s, self._lag_rad = lag_s, lag_rad
        self._commanded: deque[tuple[float, FloatArray]] = deque()

    def note(self, device_time: float, q: FloatArray) -> None:
        """Record a set-point (n,) that was commanded."""
        self._commanded.append((device_time, q))
        # Keep one older set-point: it was the commanded position at the start of the window.
        while len(self._commanded) > 1 and self._commanded[1][0] < device_time - self._lag_s:
            self._commanded.popleft()

    def off(self, target: FloatArray) -> FloatArray:
        """Return the distance (n,) of the controller's target from the commanded range [rad]."""
        commanded = np.array([q for _, q in self._commanded])
        if not len(commanded):
            return np.zeros_like(target)
        under, over = commanded.min(axis=0) - target, target - commanded.max(axis=0)
        return np.asarray(np.maximum(np.maximum(under, over), 0.0))

    def lost(self, target: FloatArray) -> bool:
        """Return whether the controller's target is outside the tolerance of the set-points."""
        return bool(self.off(target).max() > self._lag_rad)


class Phase(Enum):
    """Phase of a motion."""

    IDLE = auto()
    STARTING = auto()
    MOVE = auto()
    """Phase in which the controller executes a move that the controller has planned."""
    LED = auto()
    """Phase in which the thread sends one set-point per tick."""
    SETTLING = auto()
    """Phase after the last set-point, until the arm has settled at this set-point."""
    BRAKING = auto()


UNDER_WAY = (Phase.MOVE, Phase.LED, Phase.SETTLING)
"""Phases that a stop request ends."""


class MotionState:
    """State of the motion, shared by both threads; a lock protects changes of the phase.

    Args:
        newest: Newest row of the controller.
        options: Options of the arm from the station file.

    Attributes:
        newest, heard: Newest row and its time of arrival [s, monotonic].
        phase: Present phase of the motion.
        begun: Device time at which the newest motion began [s].
        failure: Error that ended the motion; only one call reports the error to the client.
        ramp: Ramp of the newest stop.
        stop_asked: Event that is set if a stop was requested since the newest segment was prepared.
        stop_obeyed: Event that is set if the rows have shown that the controller obeys the stop.
        news: Event that is set if there is a new row or a new stop request.
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
        """Clear earlier stop requests before a new segment is started."""
        self.stop_asked.clear()
        self.stop_obeyed.clear()

    def turn(self, to: Phase, *, out_of: tuple[Phase, ...]) -> bool:
        """Change to phase `to` if the present phase is in `out_of`; return whether it changed."""
        with self._turning:
            if self.phase not in out_of:
                return False
            self.phase = to
            return True

    def rest(self) -> None:
        """Set the phase to idle because the arm is at rest, and mark a stop as obeyed."""
        with self._turning:
            self.phase = Phase.IDLE
        self.stop_obeyed.set()

    def brake(self, row: np.void) -> tuple[Ramp, bool] | None:
        """Begin a stop; return its ramp and whether `servoj` moves the arm, or None at rest."""
        with self._turning:
            if self.phase not in UNDER_WAY:
                return None
            led = self.phase is not Phase.MOVE
            self.ramp = Ramp(row, self._options, led=led)
            self.phase = Phase.BRAKING
            return self.ramp, led

    def fail(self, error: HilError) -> None:
        """Record an error; only the first error is retained."""
        self.failure = self.failure or error


RAMP_GRACE_S = 0.3
"""Device time [s] allowed after the end of a ramp until the rows show the arm at rest."""

HARDEST_M_S2 = 150.0
"""Maximum tool deceleration that UR allows [m/s²]."""


class Ramp:
    """Deceleration and time limit of one stop, from the request until the arm is at rest.

    The watchdog cannot be reset while the controller executes a stop. `ur-rtde` stores the stop
    command in the register that also resets the watchdog, and writing this register would cancel
    the stop. A ramp must therefore end before the watchdog expires. `options_of` checks the
    duration of the ramp for `movej`. For `servoj` the tool speed is not known in advance, so the
    deceleration is increased if a stop with the configured value would take too long.

    Args:
        row: Newest row.
        options: Options of the arm.
        led: Whether the arm is moved by `servoj`, which decelerates the tool instead of the joints.

    Attributes:
        deceleration: Requested deceleration [rad/s² of the fastest joint; m/s² of the tool if
            `led`].
        answered: Whether the program has confirmed the stop.
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
        """Return whether the commanded speed has decreased: the controller has begun to stop."""
        fastest = _fastest(row)
        self._most = max(self._most, fastest)
        return fastest < self._most - STILL_RAD_S

    def stands(self, row: np.void) -> bool:
        """Return whether the arm is at rest after the program has confirmed the stop.

        Without the confirmation, an arm that has not begun to move would also count as at rest.
        """
        return self.answered and still(row)

    def overdue(self, row: np.void) -> bool:
        """Return whether the arm is not at rest after the time limit.

        The method returns true at most once per stop.
        """
        if float(row["timestamp"]) <= self._until:
            return False
        self._until = np.inf
        return not self.stands(row)


def _tool_speed(row: np.void) -> float:
    """Return the commanded tool speed: maximum of translation [m/s] and rotation [rad/s]."""
    if "target_TCP_speed" in (row.dtype.names or ()):
        twist = row["target_TCP_speed"]
        return float(max(np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])))
    # The rotation speed of the tool is at most the sum of all joint speeds.
    return float(np.abs(row["target_qd"]).sum())


def _fastest(row: np.void) -> float:
    """Return the largest commanded joint speed [rad/s]."""
    return float(np.abs(row["target_qd"]).max())


SILENT_S = 1.5
"""Silence of the controller after which the session ends [s].

After 2.5 s `ur-rtde` would reconnect by itself and upload its program, regardless of the motion of
the arm.
"""

DOZE_S = 0.05
"""Duration of a wait for rows [s] above which this computer itself was delayed, so that the
silence does not prove a failure of the controller."""

LOST_EXIT, STALE_EXIT = 3, 4
"""Exit codes of the motion process: the first for a lost controller or robot program, the second
for a stop of the arm because the controller was silent."""

SILENCE_HINT = "check the network between this computer and the controller, then connect again"


class Ticks(Protocol):
    """Source of the controller's rows, with RTDE variable names as field names."""

    @property
    def age_s(self) -> float:
        """Time since the controller's clock last advanced [s]."""

    def take(self, timeout_s: float) -> StructArray:
        """Return all rows since the last call; raise `RobotTimeout` if there is no row."""


class SupervisionThread(threading.Thread):
    """Thread that checks for silence of the controller, for the end of the program, and for stops.

    `ur-rtde` reconnects by itself as soon as its connection ends: it stops the program, uploads the
    program again without a watchdog, and repeats the pending command. To the motion process, a
    reconnection looks like a program end, a failed command, or only a different connection. The
    motion process therefore exits before another command can be sent, and the client must connect
    again.

    Args:
        ticks: Source of all rows of the controller's state, without gaps.
        state: State of the motion.
        options: Options of the arm.
        exit_: Function that ends this process with an exit code.
        connected: Function that returns whether `ur-rtde` still has its first connection.
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
        """Check every row until the end of the session."""
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
        # A repeated state does not count as new: a hanging controller counts as silent and gets no
        # set-point that it might execute after the stop.
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
                    "the arm did not reach standstill in its stop time: it was stopped directly",
                    hint="check the robot, then connect again",
                )
            )

    def _silent(self) -> None:
        """End the session if the controller has been silent for too long.

        Without this check, `ur-rtde` would wait for an answer of the controller, possibly for
        minutes.
        """
        # After a delay of this computer, rows are possibly still queued: ignore one such silence.
        held_up = time.monotonic() - self._looked > DOZE_S
        self._dozed = held_up and not self._dozed
        if self._dozed:
            return
        state = self._state
        for_s = time.monotonic() - state.heard
        if not self._connected():
            return self._cut_off()
        if self._ticks.age_s > SILENT_S:
            return self._lost(f"the controller has sent nothing for {for_s:.1f} s")
        allowed_s = FRESH_S if state.stop_asked.is_set() else self._options.late_s
        if state.under_way and for_s > allowed_s:
            self.leave(
                StaleState(
                    f"the controller has sent nothing for {for_s:.2f} s while the arm was moving",
                    hint=SILENCE_HINT,
                )
            )

    def _program_ended(self, row: np.void) -> None:
        """End the session after the robot program has ended; a paused program is ended too.

        A paused program would otherwise resume its old move.
        """
        at = f"at device time {float(row['timestamp']):.3f} s"
        self.leave(
            RobotFault(
                f"the robot program ended {at}",
                hint="look for a stop or a message at the teach pendant, connect again; `hil "
                "resume` continues at the last checkpoint",
            ),
            paused=int(row["runtime_state"]) != STOPPED,
        )

    def _cut_off(self) -> None:
        """End the session because `ur-rtde` has lost its first connection.

        If `ur-rtde` has uploaded the program again, that program has no watchdog.
        """
        self.leave(
            RobotConnectionError(
                "connection lost: the connection of ur-rtde has ended",
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
        """Stop the arm without `ur-rtde`, print the error and end the process.

        Only the first call of this method has an effect.

        Args:
            error: Reason, which is printed to standard error.
            paused: Whether the robot program is possibly still active and must be stopped.
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
