"""The engine: executes a plan on a robot, and is the only thing that moves it.

One loop on one thread: hand over a segment, read blocks until it is over. Whatever happens, the
robot is stopped on the way out, is watched until it is at rest, and the run ends with an outcome.
Every call on the way out may take only so long.
"""

from __future__ import annotations

import contextlib
import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hil.core import (
    HilError,
    InterlockTripped,
    RobotConnectionError,
    RobotError,
    RobotFault,
    RobotTimeout,
    StaleState,
    Stopped,
    StructArray,
    bounded,
    supervised,
)
from hil.engine.interlocks import Interlock
from hil.engine.observers import Observers
from hil.engine.pausing import GoOn, Pausing, nobody_goes_on
from hil.engine.prompt import Prompt, Reply, nobody
from hil.engine.reading import REST_WITHIN_S, STOP_WITHIN_S, Reading, Sink
from hil.engine.requests import Requests
from hil.engine.result import RunResult, result_of
from hil.engine.states import RunState, StateMachine
from hil.engine.steps import Measured, Steps
from hil.engine.telling import Health, Telling, under_way
from hil.engine.watchdog import HUNG_AFTER_S, Watchdog
from hil.planning import Plan, Step
from hil.robot import Robot

READ_WITHIN_S = 3.0
"""What a driver may take for the last `read`, beside the time the arm needs to come to rest."""


SILENCE = (RobotTimeout, RobotConnectionError, StaleState)
"""What a robot looks like to a process that did not run, however short that was."""

HANGS = "look at the robot; own_process: true in the station gives the driver its own process"


class Engine:
    """Runs one plan once.

    Args:
        plan: What to do; it must start where the robot stands (preflight checks that).
        robot: Connected.
        sink: Receives every sample and event.
        interlocks: Judged on every sample.
        observers: Receive progress events; they stay open, the caller closes them.
        prompt: Asks the operator to change the load.
        go_on: Looks whether somebody at the robot ends a pause.
        measured: Is given the settled rows of every dwell; may raise.
        health: How the recording is doing, for progress events.
        stale_after_s: How long the state may stand still [s]; None for the default.
        steps: Of how many steps observers are told, where the plan is what was left of so many;
            those of the plan by default.
    """

    def __init__(
        self,
        plan: Plan,
        robot: Robot,
        sink: Sink,
        *,
        interlocks: Sequence[Interlock] = (),
        observers: Observers | None = None,
        prompt: Prompt = nobody,
        go_on: GoOn = nobody_goes_on,
        measured: Measured = lambda step, rows: None,
        health: Health = lambda: {},
        stale_after_s: float | None = None,
        steps: int | None = None,
    ) -> None:
        self._plan = plan
        self._robot = robot
        self._sink = sink
        self._ask = prompt
        self._machine = StateMachine()
        self._requests = Requests()
        self._health = health
        self._telling = Telling(plan, observers or Observers(), self._told_health, steps)
        self._given_up = threading.Event()
        self._suspended: InterlockTripped | None = None
        self._watchdog = Watchdog(
            self._hung, self._was_suspended, on=robot.capabilities.clock == "wall"
        )
        self._reading = Reading(
            robot,
            sink,
            interlocks,
            plan.joint_names,
            self._requests,
            stale_after_s=stale_after_s,
            told=self._block,
            patience=self._watchdog.be_patient,
        )
        self._steps = Steps(plan, robot, self._reading, sink, self._prompt, measured)
        self._pausing = Pausing(self._reading, self._steps, sink, self._enter, go_on)
        self._notes: list[str] = []

    @property
    def state(self) -> RunState:
        """Where the run is."""
        return self._machine.state

    @property
    def pause_pending(self) -> bool:
        """Whether somebody wants a pause, be it still to come or there already."""
        return bool(self._requests.pause)

    def request_stop(self, reason: str, *, by_signal: bool = False) -> None:
        """Ask for a controlled stop; safe from any thread and from a signal handler."""
        self._requests.by_signal = by_signal
        self._requests.stop = reason

    def request_pause(self, reason: str) -> None:
        """Ask for a pause at the next checkpoint; safe from any thread and a signal handler."""
        self._requests.pause = reason

    def request_resume(self, by: str) -> None:
        """End a pause that was requested, or take the request back; safe from any thread.

        An interlock that holds the run keeps holding it until it is clear.
        """
        self._requests.resumed_by = by
        self._requests.pause = ""

    def run(self, preflight: Callable[[], object] = lambda: None) -> RunResult:
        """Execute the plan to one of its ends.

        Args:
            preflight: Raises when the robot must not move.

        Returns:
            The result; errors of every kind end up in it and are not raised.
        """
        self._telling.begin(self._reading.progress)
        error: HilError | None = None
        try:
            self._attempt(preflight)
        except HilError as caught:
            error = caught
        except KeyboardInterrupt:
            error = Stopped("stopped by the keyboard", by_signal=True)
        except Exception as caught:  # a bug in hil or in a driver must not lose the run's end
            error = self._unexpected(caught)
        error = self._halt(self._or_suspension(error))
        self._notes += [*self._reading.judge.notes, *self._reading.notes]
        self._machine.to(RunState.DONE)
        result = result_of(error, self._reading.progress, self._telling.wall_s, tuple(self._notes))
        self._telling.state(RunState.DONE, result.reason or result.outcome.value)
        return result

    def _attempt(self, preflight: Callable[[], object]) -> None:
        """Execute the plan; where a driver can hang in wall time, on a thread that can be left."""
        if self._robot.capabilities.clock == "virtual":
            self._execute_plan(preflight)
            return
        try:
            supervised(
                lambda: self._execute_plan(preflight),
                self._given_up,
                "the control loop",
                lambda: self.request_stop("stopped by the keyboard", by_signal=True),
            )
        except RobotTimeout as error:
            raise (self._reading.judge.hanging or error) from error

    def _execute_plan(self, preflight: Callable[[], object]) -> None:
        self._enter(RunState.PREFLIGHT)
        preflight()
        self._enter(RunState.ARMED)
        with self._watchdog:
            # The first block is judged before anything moves: what is violated already trips.
            self._reading.block()
            self._enter(RunState.RUNNING)
            for step in self._plan:
                if step.checkpoint:
                    self._pausing.pause_if_asked()
                    self._reading.begin_leg()
                    self._sink.event("checkpoint", step=step.index)
                self._telling.step(step)
                try:
                    self._steps.execute(step)
                except RobotError as error:
                    self._explain(error, step)
                    raise
        self._telling.progress()

    def _explain(self, error: RobotError, step: Step) -> None:
        """Add the step of the plan and a lowered speed, which the driver does not know."""
        if isinstance(error, RobotFault | RobotConnectionError | StaleState):
            error.message += f", {under_way(self._plan, step)}"
        if slowed := self._reading.slowed:
            error.message += f"; {slowed}"
            error.hint = "; ".join(filter(None, (error.hint, "set the speed slider to 100 %")))

    def _enter(self, state: RunState, reason: str = "") -> None:
        self._requests.obey_stop()
        self._machine.to(state)
        self._sink.event("state", state=str(state), **({"reason": reason} if reason else {}))
        self._telling.state(state, reason)

    def _told_health(self) -> Mapping[str, Any]:
        return {**self._health(), "pausing": self._requests.why_paused}

    def _block(self, rows: StructArray) -> None:
        if gap_s := self._watchdog.feed():
            raise self._suspension(gap_s)
        self._telling.block(rows)

    def _prompt(self, text: str, meanwhile: Callable[[], object]) -> Reply:
        self._sink.event("asked", text=text)
        self._telling.asking(text)
        reply = self._ask(text, meanwhile)
        self._telling.answered(text, reply)
        return reply

    def _hung(self) -> None:
        """On the watchdog's thread: the control thread has not come round for seconds."""
        who = "the driver did not return from a call for seconds"
        # Whatever the thread does when the call returns after all, it is not a motion.
        self._requests.ended_by = RobotTimeout(who, hint=HANGS)
        try:
            with contextlib.suppress(Exception):  # it is stopped once more on the way out
                bounded(self._robot.stop, STOP_WITHIN_S, "stopping the robot")
            if hanging := self._reading.judge.hanging:  # looks up whose it is, which takes a while
                who, self._requests.ended_by = hanging.message, hanging
            self._notes.append(f"{who}; the watchdog stopped the robot")
            self._sink.event("hung", reason=self._notes[-1])
        finally:
            self._given_up.set()

    def _was_suspended(self, seconds: float) -> None:
        """Stop the robot from the watchdog thread, before the control thread resumes."""
        self._requests.ended_by = self._suspension(seconds)
        with contextlib.suppress(HilError):
            bounded(self._robot.stop, STOP_WITHIN_S, "stopping the robot")

    def _suspension(self, seconds: float) -> InterlockTripped:
        """Return the suspension error; all threads share one instance."""
        if self._suspended is None:
            self._suspended = InterlockTripped(
                f"interlock suspended: this process did not run for {seconds:.1f} s (suspended, or "
                "its computer asleep or overloaded); nothing watched the arm meanwhile",
                hint="look at the robot, then resume the run; to hold a run, pause it (Ctrl-C, "
                "hil pause) instead of suspending its process",
            )
        return self._suspended

    def _or_suspension(self, error: HilError | None) -> HilError | None:
        """Return the cause of the end; a timeout caused by a suspension becomes the suspension.

        After a suspension several threads detect different problems in any order, and the recorded
        cause must not depend on that order. A stop that was requested stays the cause.
        """
        gap_s = self._watchdog.absent_s()
        if error is None or not gap_s or error is self._suspended:
            return error
        long = gap_s > HUNG_AFTER_S and not self._watchdog.patient
        if isinstance(error, Stopped) or not (long or isinstance(error, SILENCE)):
            self._notes.append(f"this process did not run for {gap_s:.1f} s just before the end")
            return error
        self._notes.append(f"reported after the suspension: {error.message}")
        return self._suspension(gap_s)

    def _halt(self, error: HilError | None) -> HilError | None:
        """Stop the robot first, then tell others; nothing here may prevent the stop."""
        failure: HilError | None = None
        try:
            bounded(self._robot.stop, STOP_WITHIN_S, "stopping the robot")
        except HilError as caught:
            failure = caught
        except Exception as caught:
            failure = self._unexpected(caught)
        self._machine.to(RunState.STOPPING)
        with contextlib.suppress(HilError):
            self._note_end(error)
        problems = [f"stopping the robot: {failure.message}"] if failure else []
        problems += [problem] if (problem := self._come_to_rest()) else []
        self._notes += problems
        if error is None and problems:
            return RobotFault("; ".join(problems), hint="look at the robot before going near it")
        return error

    def _note_end(self, error: HilError | None) -> None:
        reason = error.message if error else ""
        self._telling.state(RunState.STOPPING, reason)
        if isinstance(error, InterlockTripped):
            self._sink.event("trip", reason=reason)
        chance = {"by_signal": True} if isinstance(error, Stopped) and error.by_signal else {}
        self._sink.event("state", state=str(RunState.STOPPING), reason=reason, **chance)

    def _come_to_rest(self) -> str:
        within_s = REST_WITHIN_S + READ_WITHIN_S
        try:
            return bounded(self._reading.to_rest, within_s, "watching the arm come to rest")
        except HilError as caught:
            return caught.message
        except Exception as caught:  # a broken driver or sink: the stop was commanded already
            return self._unexpected(caught).message

    def _unexpected(self, caught: Exception) -> HilError:
        self._notes.append("".join(traceback.format_exception(caught)[-3:]).strip())
        error = RobotError(
            f"unexpected {type(caught).__name__}: {caught}",
            hint="this is a bug in hil or in the driver; stop.json holds where it happened",
        )
        error.__cause__ = caught
        return error
