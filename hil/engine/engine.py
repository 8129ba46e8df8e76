"""Engine that executes a plan on a robot.

No module other than `hil.engine.engine` commands motion during a run.

A single loop on one thread sends one segment of the plan to the robot and then reads blocks of
state rows until the segment is over. A run is always in one of the states of `RunState`.
`Engine.run` always returns a `RunResult` and raises no exception.

| state     | event                                                           | next state |
|-----------|-----------------------------------------------------------------|------------|
| IDLE      | `Engine.run` is called                                          | PREFLIGHT  |
| PREFLIGHT | the preflight passes                                            | ARMED      |
| ARMED     | the first block of state rows trips no interlock                | RUNNING    |
| RUNNING   | a checkpoint, with a pause requested or an interlock that holds | PAUSED     |
| PAUSED    | a requested pause was ended, interlocks that hold are clear     | RUNNING    |
| RUNNING   | the last step of the plan is done                               | STOPPING   |
| all above | a stop, a trip, a fault or any other error                      | STOPPING   |
| STOPPING  | the arm is at rest, or the time for that is over                | DONE       |

**Pauses** of a run happen only at checkpoints of the plan. Operators and signals request pauses of
a run; interlocks with the action `pause` also pause the run. During a pause the arm holds its last
set-point, and the engine continues to read the robot state and to check the interlocks.

**Stops** of a run have four causes, and every stop ends in `Engine._halt`:

- An operator or a signal requests a stop through the object `Requests`. The control thread checks
  for a stop request before it reads the next block, sends the next command or changes to the next
  state; it raises `Stopped` within one block.
- `Reading.block` raises an error for a tripped interlock, a robot fault, a stale robot state or a
  failed recorder. If an interlock with the action `stop` trips, `Reading.block` stops the robot
  before it raises the error.
- Any other exception, from a driver, a prompt or a bug, propagates to `Engine.run`.
- A control thread that hangs in a call cannot react to stop requests. The watchdog detects a
  hanging control thread, stops the robot from the watchdog thread and abandons the control thread
  (`Engine._hung`). If the operating system suspended the process, the watchdog stops the robot
  before the control thread continues (`Engine._was_suspended`).

`Engine._halt` always stops the robot first, then notifies the observers and then monitors the arm
until the arm is at rest. Every call in `Engine._halt` has a time limit, and no failure of a call
prevents the stop. (The third signal stops the robot without `Engine._halt`: see
`hil.engine.signals`.)

The file contains, in this order: the states, the prompt and the result of a run; the class `Engine`
(run, stop, pause, steps); the helper classes of the engine.
"""

from __future__ import annotations

import contextlib
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal, NamedTuple

import numpy as np

from hil.core import (
    CommandRefused,
    FloatArray,
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
from hil.engine.interlocks import Interlock, Trip
from hil.engine.observers import Observers
from hil.engine.reading import REST_WITHIN_S, Progress, Reading, Sink, stop_robot
from hil.engine.watchdog import HUNG_AFTER_S, Watchdog
from hil.excitation import Motion
from hil.planning import AT_REST, DwellRule, Plan, Step, StepKind
from hil.robot import Robot, Segment, Status


class RunState(StrEnum):
    """State of a run."""

    IDLE = "idle"
    PREFLIGHT = "preflight"
    ARMED = "armed"
    RUNNING = "running"
    PAUSED = "paused"
    STOPPING = "stopping"
    DONE = "done"


TRANSITIONS: dict[RunState, frozenset[RunState]] = {
    RunState.IDLE: frozenset({RunState.PREFLIGHT, RunState.STOPPING}),
    RunState.PREFLIGHT: frozenset({RunState.ARMED, RunState.STOPPING}),
    RunState.ARMED: frozenset({RunState.RUNNING, RunState.STOPPING}),
    RunState.RUNNING: frozenset({RunState.PAUSED, RunState.STOPPING}),
    RunState.PAUSED: frozenset({RunState.RUNNING, RunState.STOPPING}),
    RunState.STOPPING: frozenset({RunState.DONE}),
    RunState.DONE: frozenset(),
}
"""Allowed transitions between the states of a run; a stop is possible from every state except
the last two."""


class IllegalTransition(RuntimeError):
    """Error for a forbidden state transition of a run, which indicates a bug in the engine."""


class StateMachine:
    """State machine that stores the state of a run and rejects forbidden transitions."""

    def __init__(self) -> None:
        self.state = RunState.IDLE

    def to(self, new: RunState) -> None:
        """Change the current state to `new`.

        Raises:
            IllegalTransition: The table of allowed transitions has no transition from the current
                state to `new`.
        """
        if new not in TRANSITIONS[self.state]:
            raise IllegalTransition(f"no transition from {self.state} to {new}")
        self.state = new


class Outcome(StrEnum):
    """Outcome of a run, as stored in its stop document.

    A run directory without a stop document counts as `interrupted`.
    """

    COMPLETED = "completed"
    STOPPED = "stopped"
    TRIPPED = "tripped"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class RunResult:
    """Result of a run.

    Attributes:
        outcome: Outcome of the run: `completed`, `stopped`, `tripped` or `failed`.
        reason: Reason why the run ended early, as readable text; empty if the run is completed.
        error: Error that ended the run early; None if the run is completed.
        steps_done: Number of plan steps that were completed.
        unsettled: Indices of the plan steps whose dwell ended by its time-out.
        samples: Number of state rows that were read.
        device_s: Device time from the first to the last sample [s].
        wall_s: Wall time of the run [s].
        notes: Descriptions of further problems that occurred while the run ended.
    """

    outcome: Outcome
    reason: str
    error: HilError | None
    steps_done: int
    unsettled: tuple[int, ...]
    samples: int
    device_s: float
    wall_s: float
    notes: tuple[str, ...] = ()


class Reply(NamedTuple):
    """Answer to a question.

    Attributes:
        yes: Whether the answer is yes; any other answer ends the run.
        who: Name of the operator who answered; empty if no operator answered, which also counts as
            "no".
    """

    yes: bool
    who: str

    @property
    def word(self) -> str:
        """Answer `yes` or `no`; empty text if no operator answered."""
        return ("yes" if self.yes else "no") if self.who else ""

    @property
    def words(self) -> str:
        """Answer as readable text, such as `anna answered no`."""
        return f"{self.who} answered {self.word}" if self.who else "no operator answered"


NOBODY = Reply(yes=False, who="")
"""Reply to a prompt that no operator can answer."""

Prompt = Callable[[str, Callable[[], object]], Reply]
"""Callback that asks the operator a question and returns the reply.

While the callback waits for the answer, it calls its second argument repeatedly. The second
argument is a function that reads the robot, raises `Stopped` if a stop is requested, and returns
the reason for pausing the run after the question; an empty text means no pause.
"""


def nobody(text: str, meanwhile: Callable[[], object]) -> Reply:
    """Return the reply to a prompt in an unattended run, in which no operator can answer."""
    return NOBODY


GoOn = Callable[[], str]
"""Callback that checks without waiting whether an operator at the robot ends a pause.

The callback returns the name of the operator who ends the pause, or an empty string.
"""


def nobody_goes_on() -> str:
    """Return an empty string, because a run without a console has no operator to ask."""
    return ""


Measured = Callable[[Step, StructArray], object]
"""Callback that receives the settled rows of every dwell of a run.

The callback raises an error if the rows of the dwell are implausible.
"""

Health = Callable[[], Mapping[str, Any]]
"""Callback that returns the state of the recording: number of gaps, number of duplicates, …, and
delay of writing.

The callback must return quickly, because the control thread calls it.
"""


@dataclass(slots=True)
class Requests:
    """Requests of operators, signals, interlocks and the watchdog to a run.

    Any thread or signal handler can set the fields of `Requests`; the control thread reads the
    fields before every block.

    Attributes:
        ended_by: Error with which the watchdog ended the run; None if the watchdog did not end the
            run.
        stop: Reason for the requested stop; empty if no stop is requested.
        by_signal: Whether a signal, and not an operator, requested the stop.
        pause: Reason for the requested pause; empty if no pause is requested.
        held: Description of the violated interlock with the action `pause`; empty if no such
            interlock is violated.
        resumed_by: Name of the operator who ended the last pause.
    """

    ended_by: HilError | None = None
    stop: str = ""
    by_signal: bool = False
    pause: str = ""
    held: str = ""
    resumed_by: str = ""

    def obey_stop(self) -> None:
        """Raise the watchdog error, or `Stopped` if a stop was requested."""
        if self.ended_by is not None:
            raise self.ended_by
        if self.stop:
            raise Stopped(self.stop, by_signal=self.by_signal)

    @property
    def why_paused(self) -> str:
        """All current reasons for a pause as one text; empty if no pause is due."""
        return "; ".join(reason for reason in (self.pause, self.held) if reason)


READ_WITHIN_S = 3.0
"""Time limit of the last call of `read` of a driver during a stop [s], in addition to the time
that the arm needs to stop."""

COMMAND_WITHIN_S = 30.0
"""Time limit for a driver to accept a motion or a payload [s]; the arm is static during the
call."""

PARK_WITHIN_S = 2.0
"""Time limit for a driver to accept a new set-point at which a static arm is held [s]."""

DWELL_GRACE_S = 2.0
"""Additional time beyond the time-out of a dwell after which the robot is considered to hang
[s]."""

LEAST_PACE = 0.02
"""Minimum speed scaling, from 0 to 1, with which the time-out of a move is extended; lower
values are raised to this minimum."""

CLEAR_FOR_S = 5.0
"""Device time for which the interlock that paused a run must be clear before the run resumes
automatically [s]."""

UNATTENDED_S = 3600.0
"""Maximum device time for which interlocks can pause an unattended run [s].

A hot joint cools down in less than this time, whereas a reduced speed slider or a full disk does
not change until an operator acts.
"""

UNHURRIED_BLOCKS = 200
SLOWLY_S = 0.1
"""Wall time per block on a virtual clock after the first 200 blocks of a pause [s]."""

PARKED = -1
"""Segment number that is recorded for samples outside any step: before the first step, in a
pause or at a prompt."""

SEGMENT_KINDS: dict[StepKind, Literal["move", "trajectory", "hold"]] = {
    "warmup": "move",
    "move": "move",
    "dwell": "hold",
    "reference": "hold",
    "weigh": "hold",
    "trajectory": "trajectory",
}

SILENCE = (RobotTimeout, RobotConnectionError, StaleState)
"""Classes of robot errors that a suspension of this process can cause, even a short suspension."""


class Engine:
    """Engine that executes one plan a single time.

    Args:
        plan: Plan to execute; its start pose must be the present pose of the robot, which preflight
            checks.
        robot: Connected robot.
        sink: Receiver of every sample and every event.
        interlocks: Interlocks that the engine checks on every sample.
        observers: Receivers of progress events; the caller of the engine closes them.
        prompt: Callback that asks the operator to change the load.
        go_on: Callback that checks whether an operator at the robot ends a pause.
        measured: Callback that receives the settled rows of every dwell and can raise an error that
            ends the run.
        health: Callback that returns the state of the recording for progress events.
        stale_after_s: Maximum time without a new robot state [s]; None for the default of the
            interlock `stale`.
        steps: Total number of steps that is reported to observers if `plan` is only the remainder
            of a resumed plan; by default the number of steps of `plan`.
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
        self._go_on = go_on
        self._measured = measured
        self._health = health
        self._machine = StateMachine()
        self._requests = Requests()
        self._watchdog = Watchdog(
            self._hung, self._was_suspended, on=robot.capabilities.clock == "wall"
        )
        self._reading = Reading(
            robot,
            sink,
            interlocks,
            plan.joint_names,
            obey_stop=self._requests.obey_stop,
            hold=self._hold_for,
            on_block=self._after_block,
            stale_after_s=stale_after_s,
        )
        self._notifier = Notifier(
            plan, observers or Observers(), self._reading.progress, self._health_now, steps
        )
        self._given_up = threading.Event()
        self._suspended: InterlockTripped | None = None
        self._notes: list[str] = []

    @property
    def state(self) -> RunState:
        """Current state of the run."""
        return self._machine.state

    @property
    def pause_pending(self) -> bool:
        """Whether a pause is requested or has already begun."""
        return bool(self._requests.pause)

    def request_stop(self, reason: str, *, by_signal: bool = False) -> None:
        """Request a controlled stop; can be called from any thread and from a signal handler."""
        self._requests.by_signal = by_signal
        self._requests.stop = reason

    def request_pause(self, reason: str) -> None:
        """Request a pause of the run at the next checkpoint of the plan.

        The method can be called from any thread and from a signal handler.
        """
        self._requests.pause = reason

    def request_resume(self, by: str) -> None:
        """End a pause or cancel the request for a pause; can be called from any thread.

        An interlock that pauses the run keeps the run paused until the measured quantity is within
        its limit again.
        """
        self._requests.resumed_by = by
        self._requests.pause = ""

    def run(self, preflight: Callable[[], object] = lambda: None) -> RunResult:
        """Execute the plan until it is completed or ends early.

        Args:
            preflight: Callback that checks the robot before motion and raises an error if the robot
                must not move.

        Returns:
            Result of the run; errors of every kind are stored in the result and not raised.
        """
        self._notifier.begin()
        error: HilError | None = None
        try:
            self._attempt(preflight)
        except HilError as caught:
            error = caught
        except KeyboardInterrupt:
            error = Stopped("stopped by the keyboard", by_signal=True)
        # A bug in hil or in a driver must not prevent an orderly end of the run.
        except Exception as caught:
            error = self._unexpected(caught)
        error = self._halt(self._or_suspension(error))
        self._notes += [*self._reading.judge.notes, *self._reading.notes]
        self._machine.to(RunState.DONE)
        progress = self._reading.progress
        result = RunResult(
            outcome=_outcome_of(error),
            reason=error.message if error else "",
            error=error,
            steps_done=progress.steps_done,
            unsettled=tuple(progress.unsettled),
            samples=progress.samples,
            device_s=progress.last - progress.first if progress.samples else 0.0,
            wall_s=self._notifier.wall_s,
            notes=tuple(self._notes),
        )
        self._notifier.state(RunState.DONE, result.reason or result.outcome.value)
        return result

    def _attempt(self, preflight: Callable[[], object]) -> None:
        """Execute the plan on a robot that uses a wall clock or a virtual clock.

        With a wall clock, the plan is executed on a separate thread, which can be abandoned if a
        driver hangs.
        """
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
            # The interlocks check the first block before the arm moves, so that an existing
            # violation trips.
            self._reading.block()
            self._enter(RunState.RUNNING)
            for step in self._plan:
                if step.checkpoint:
                    self._pause_if_asked()
                    self._reading.begin_leg()
                    self._sink.event("checkpoint", step=step.index)
                self._notifier.step(step)
                try:
                    self._execute(step)
                except RobotError as error:
                    self._explain(error, step)
                    raise
        self._notifier.progress()

    def _enter(self, state: RunState, reason: str = "") -> None:
        self._requests.obey_stop()
        self._machine.to(state)
        self._sink.event("state", state=str(state), **({"reason": reason} if reason else {}))
        self._notifier.state(state, reason)

    def _after_block(self, rows: StructArray) -> None:
        if gap_s := self._watchdog.feed():
            raise self._suspension(gap_s)
        self._notifier.block(rows)

    def _hold_for(self, trip: Trip) -> None:
        # Only the first violation is stored as the reason.
        self._requests.held = self._requests.held or trip.text(self._plan.joint_names)

    def _health_now(self) -> Mapping[str, Any]:
        return {**self._health(), "pausing": self._requests.why_paused}

    def _explain(self, error: RobotError, step: Step) -> None:
        """Add the plan step and a reduced speed, unknown to the driver, to its error message."""
        if isinstance(error, RobotFault | RobotConnectionError | StaleState):
            error.message += f", {under_way(self._plan, step)}"
        if slowed := self._reading.slowed:
            error.message += f"; {slowed}"
            error.hint = "; ".join(filter(None, (error.hint, "set the speed slider to 100 %")))

    # Stop.

    def _halt(self, error: HilError | None) -> HilError | None:
        """Stop the robot, then notify the observers; no failure in this method prevents the stop.

        Returns:
            The error that ended the run; a `RobotFault` if only the stop itself failed.
        """
        failure: HilError | None = None
        try:
            stop_robot(self._robot)
        except HilError as caught:
            failure = caught
        except Exception as caught:
            failure = self._unexpected(caught)
        self._machine.to(RunState.STOPPING)
        reason = error.message if error else ""
        with contextlib.suppress(HilError):
            self._notifier.state(RunState.STOPPING, reason)
            if isinstance(error, InterlockTripped):
                self._sink.event("trip", reason=reason)
            signal = {"by_signal": True} if isinstance(error, Stopped) and error.by_signal else {}
            self._sink.event("state", state=str(RunState.STOPPING), reason=reason, **signal)
        try:
            within_s = REST_WITHIN_S + READ_WITHIN_S
            moving = bounded(self._reading.to_rest, within_s, "watching the arm come to rest")
        except HilError as caught:
            moving = caught.message
        except Exception as caught:  # a broken driver or sink; the stop has already been commanded
            moving = self._unexpected(caught).message
        problems = [f"stopping the robot: {failure.message}"] if failure else []
        problems += [moving] if moving else []
        self._notes += problems
        if error is None and problems:
            hint = "check the robot from a distance before you approach it"
            return RobotFault("; ".join(problems), hint=hint)
        return error

    def _unexpected(self, caught: Exception) -> HilError:
        self._notes.append("".join(traceback.format_exception(caught)[-3:]).strip())
        error = RobotError(
            f"unexpected {type(caught).__name__}: {caught}",
            hint="this is a bug in hil or in the driver; stop.json contains the traceback",
        )
        error.__cause__ = caught
        return error

    def _hung(self) -> None:
        """Stop the robot and abandon the control thread, which has hung for seconds.

        The watchdog calls this method on the watchdog thread.
        """
        who = "the driver did not return from a call for several seconds"
        hint = (
            "check the robot; own_process: true in the station starts the driver in its own process"
        )
        # If the call returns later, the control thread raises this error and commands no motion.
        self._requests.ended_by = RobotTimeout(who, hint=hint)
        try:
            with contextlib.suppress(Exception):  # `_halt` stops the robot again
                stop_robot(self._robot)
            if hanging := self._reading.judge.hanging:  # identifying the interlock takes time
                who, self._requests.ended_by = hanging.message, hanging
            self._notes.append(f"{who}; the watchdog stopped the robot")
            self._sink.event("hung", reason=self._notes[-1])
        finally:
            self._given_up.set()

    def _was_suspended(self, seconds: float) -> None:
        """Stop the robot after a suspension of the process, before the control thread resumes.

        The watchdog calls this method on the watchdog thread.
        """
        self._requests.ended_by = self._suspension(seconds)
        with contextlib.suppress(HilError):
            stop_robot(self._robot)

    def _suspension(self, seconds: float) -> InterlockTripped:
        """Return the error for a suspension of the process; all threads share one instance."""
        if self._suspended is None:
            self._suspended = InterlockTripped(
                f"interlock suspended: this process did not run for {seconds:.1f} s (suspended, or "
                "its computer asleep or overloaded); the arm was not monitored",
                hint="check the robot, then resume the run; to hold a run, pause it (Ctrl-C, "
                "hil pause) instead of suspending its process",
            )
        return self._suspended

    def _or_suspension(self, error: HilError | None) -> HilError | None:
        """Return the error that is recorded as the cause of the end of the run.

        A robot time-out that a suspension of the process caused is replaced by the suspension
        error.

        After a suspension of the process, several threads detect different problems in an arbitrary
        order. The recorded cause must not depend on the order in which the threads detect these
        problems. A requested stop remains the recorded cause even if other problems follow.
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

    # Pause.

    def _pause_if_asked(self) -> None:
        """Hold the arm while a pause is requested or an interlock pauses the run.

        Raises:
            InterlockTripped: An interlock has paused an unattended run for longer than
                `UNATTENDED_S`.
            HilError: A stop request, a tripped interlock or a robot fault ended the run during the
                pause.
        """
        requests = self._requests
        if not requests.why_paused:
            return
        self._park()
        requests.resumed_by = ""
        self._enter(RunState.PAUSED, requests.why_paused)
        self._hold()
        who = requests.resumed_by or "interlocks clear"
        self._sink.event("resumed", by=who)
        self._enter(RunState.RUNNING, f"resumed by {who}")

    def _hold(self) -> None:
        requests, reading = self._requests, self._reading
        reported = requests.why_paused
        clear_since: float | None = None
        waiting_since: float | None = None
        attended = self._go_on is not nobody_goes_on
        blocks = 0
        while requests.why_paused:
            block = reading.block()
            now = reading.progress.last
            blocks += 1
            if not reading.wall and blocks > UNHURRIED_BLOCKS and waiting_since is None:
                # Slow down, so that a long pause on a virtual clock does not record hours of
                # samples.
                time.sleep(SLOWLY_S)
            if requests.pause and (who := self._go_on()):
                requests.pause, requests.resumed_by = "", who
            if requests.held:
                if not reading.judge.clear(block):
                    clear_since = None
                elif clear_since is None:
                    clear_since = now
                elif now - clear_since >= CLEAR_FOR_S:
                    requests.held = ""
            # A pause requested by an operator is ended by an operator, who also sees the interlock.
            if not requests.held or attended or requests.pause:
                waiting_since = None
            elif waiting_since is None:
                waiting_since = now
            elif now - waiting_since >= UNATTENDED_S:
                raise InterlockTripped(
                    f"{requests.held}; the condition did not clear within "
                    f"{UNATTENDED_S / 60:g} min of pause, and no operator attends the run",
                    hint="remove the cause at the robot, then resume the run",
                )
            if (why := requests.why_paused) and why != reported:
                self._sink.event("paused", reason=why)
                reported = why

    # Steps.

    def _execute(self, step: Step) -> None:
        """Execute one step of the plan completely, or raise the error that ended the step."""
        self._requests.obey_stop()
        if step.kind == "payload":
            self._change_load(step)
        elif step.motion is not None:
            self._move(step, step.motion)
        self._reading.progress.steps_done += 1

    def _change_load(self, step: Step) -> None:
        load = self._plan.loads[step.load]
        self._park()
        if load.prompt:
            self._confirm(load.prompt)
        self._watchdog.be_patient(COMMAND_WITHIN_S)
        read_back = self._robot.set_payload(load.payload)
        self._watchdog.be_patient(0.0)
        self._sink.event("payload", load=step.load, mass_kg=read_back.mass, com_m=read_back.com)
        if not load.payload.agrees_with(read_back):
            raise CommandRefused(
                f"payload {load.payload} was declared, the robot reads back {read_back}",
                hint="check the payload settings of the controller",
            )

    def _confirm(self, text: str) -> None:
        """Ask the operator a question; raise `Stopped` unless the answer is yes.

        The robot is read while the operator is asked.
        """

        def meanwhile() -> str:
            self._reading.block()
            return self._requests.why_paused

        self._sink.event("asked", text=text)
        self._notifier.asking(text)
        reply = self._ask(text, meanwhile)
        self._notifier.answered(text, reply)
        self._sink.event("prompt", text=text, answered_by=reply.who, answer=reply.word)
        if not reply.yes:
            refusal = reply.words if reply.who else "no operator confirmed"
            raise Stopped(f"{refusal}: {text!r}")

    def _move(self, step: Step, motion: Motion) -> None:
        samples = motion.sample(self._plan.rate_hz)
        self._command(
            Segment(
                index=step.index,
                kind=SEGMENT_KINDS[step.kind],
                q=samples.q,
                qd=samples.qd,
                qdd=samples.qdd,
                speed=float(np.abs(samples.qd).max(initial=0.0)),
                acceleration=float(np.abs(samples.qdd).max(initial=0.0)),
            )
        )
        if step.kind in AT_REST:
            self._dwell(step)
        else:
            within_s = 2.0 + 1.5 * motion.duration_s
            what = f"step {step.index} ({step.kind}), planned to take {motion.duration_s:.1f} s,"
            self._until_over(step.index, within_s, what)

    def _dwell(self, step: Step) -> None:
        rule = self._plan.dwell_rule(step)
        watch = DwellWatch(rule)
        deadline = self._reading.deadline(rule.timeout_s + DWELL_GRACE_S)
        while True:
            block = self._reading.block()
            mine = block[block["segment"] == step.index]
            if len(mine) and watch.feed(mine):
                break
            if deadline.over(float(block["device_time"][-1])):
                raise RobotTimeout(
                    f"step {step.index} ({step.kind}): no samples of this dwell "
                    f"within {deadline.seconds:.1f} s",
                    hint="check whether the controller accepted the hold",
                )
        if not watch.settled:
            self._reading.progress.unsettled.append(step.index)
        self._sink.event(
            "dwell", step=step.index, settled=watch.settled, elapsed_s=round(watch.elapsed_s, 6)
        )
        self._measured(step, watch.rows)

    def _park(self) -> None:
        """Hold the current set-point; later samples belong to no step of the plan."""
        row = self._reading.newest
        if row is None or int(row["segment"]) == PARKED:
            return
        q = np.where(np.isfinite(row["q_target"]), row["q_target"], row["q"])[None]
        zeros = np.zeros_like(q)
        self._command(Segment(PARKED, "hold", q, zeros, zeros, 0.0, 0.0))
        self._until_over(PARKED, PARK_WITHIN_S, "parking")

    def _command(self, segment: Segment) -> None:
        self._watchdog.be_patient(COMMAND_WITHIN_S)
        self._robot.prepare(segment)
        # The upload possibly took long, or the watchdog has ended the run in the meantime.
        self._requests.obey_stop()
        self._robot.start()
        self._watchdog.be_patient(0.0)

    def _until_over(self, segment: int, within_s: float, what: str) -> None:
        """Read the robot until a segment is over; a reduced robot speed extends the time-out.

        Raises:
            RobotTimeout: The segment takes longer than its time-out.
        """
        deadline = self._reading.deadline(within_s)
        before = self._reading.progress.last
        while True:
            last = self._reading.block()[-1]
            if last["segment"] == segment and not last["status"] & Status.MOVING:
                return
            now, share = float(last["device_time"]), self._reading.speed_share
            if share < 1.0 and now > before:
                # During this time, the motion progressed only by `share` of its planned speed.
                deadline.extend((1.0 - max(share, LEAST_PACE)) * (now - before))
            before = now
            if deadline.over(now):
                raise RobotTimeout(
                    f"{what} was not finished after {deadline.seconds:.1f} s",
                    hint="check whether the controller still runs its program",
                )


def _outcome_of(error: HilError | None) -> Outcome:
    if error is None:
        return Outcome.COMPLETED
    if isinstance(error, InterlockTripped):
        return Outcome.TRIPPED
    return Outcome.STOPPED if isinstance(error, Stopped) else Outcome.FAILED


WAYS = ("move", "warmup")
"""Kinds of plan steps that only move the arm to a pose, without a measurement."""


def under_way(plan: Plan, step: Step) -> str:
    """Return a plan step as text, such as `in step 37 (move to pose 18)`, counted from 1.

    A step that only moves the arm is described by the pose that is measured next, because the step
    itself has no pose.
    """
    of = ""
    if step.trajectory >= 0:
        of = f" {step.trajectory}"
    elif step.kind in AT_REST:
        of = f" at pose {step.pose}" if step.pose >= 0 else ""
    elif step.kind in WAYS:
        after = plan.steps[plan.steps.index(step) + 1 :]
        goal = next((s for s in after if s.kind not in WAYS), step)
        if goal.kind in AT_REST:
            of = f" to pose {goal.pose}" if goal.pose >= 0 else f" to the {goal.kind}"
    which = f"step {step.index + 1}" if step.index >= 0 else "a step of the return to the plan"
    return f"in {which} ({step.kind}{of})"


class DwellWatch:
    """Criterion that determines when a dwell ends.

    A dwell ends when its minimum duration is over and enough samples are settled, or at its
    time-out.

    Args:
        rule: Dwell rule of the plan: minimum duration, number of settled samples and time-out.
    """

    def __init__(self, rule: DwellRule) -> None:
        self._rule = rule
        self._since: float | None = None
        self._quiet: list[bool] = []
        self._last = 0.0
        self._newest: list[StructArray] = []

    def feed(self, block: StructArray) -> bool:
        """Add samples of this dwell; return whether the dwell is over, settled or not."""
        if self._since is None:
            self._since = float(block["device_time"][0])
        speed: FloatArray = np.abs(block["qd"]).max(axis=1)
        self._quiet.extend((speed < self._rule.settle_rad_s).tolist())
        self._last = float(block["device_time"][-1])
        self._newest = [*self._newest[-self._rule.samples :], block]
        return self.settled or self.elapsed_s >= self._rule.timeout_s

    @property
    def rows(self) -> StructArray:
        """Newest rows of the dwell, at most as many as the dwell rule requires."""
        return np.concatenate(self._newest)[-self._rule.samples :]

    @property
    def elapsed_s(self) -> float:
        """Device time since the dwell began [s]."""
        return 0.0 if self._since is None else self._last - self._since

    @property
    def settled(self) -> bool:
        """Whether the newest samples are static and the minimum dwell duration is over."""
        newest = self._quiet[-self._rule.samples :]
        enough = len(newest) == self._rule.samples and all(newest)
        return enough and self.elapsed_s >= self._rule.dwell_s


PROGRESS_EVERY_S = 0.2
"""Wall time between two progress events of a run [s]."""


class Notifier:
    """Publisher of the events of a run: states, steps, prompts, progress, and blocks of rows.

    Args:
        plan: Plan that the engine executes.
        observers: Receivers of the published events.
        done: Counters of read samples and completed steps; every progress event contains their
            values.
        health: Callback that returns the state of the recording.
        steps: Total number of steps that is reported; by default the number of steps of `plan`, if
            `plan` is the whole plan.
    """

    def __init__(
        self,
        plan: Plan,
        observers: Observers,
        done: Progress,
        health: Health,
        steps: int | None = None,
    ) -> None:
        self._plan = plan
        self._observers = observers
        self._done = done
        self._health = health
        self._steps = steps or len(plan)
        self._resumed = int(steps is not None)
        self._step: Step | None = None
        self._next = 0.0
        self._begin = time.monotonic()
        self._state = RunState.IDLE
        self._asked = 0

    def begin(self) -> None:
        """Start measuring the wall time of the run."""
        self._begin = time.monotonic()

    @property
    def wall_s(self) -> float:
        """Wall time since the call of `begin` [s]."""
        return time.monotonic() - self._begin

    def state(self, state: RunState, reason: str = "") -> None:
        """Publish the current state of the run."""
        self._state = state
        self._observers.publish({"kind": "state", "state": str(state), "reason": reason})

    def step(self, step: Step) -> None:
        """Publish an event for the step that begins now."""
        self._step = step
        self._observers.publish({"kind": "step", **self._where(step), "load": step.load})

    def block(self, rows: StructArray) -> None:
        """Publish a recorded and checked block of rows, and a progress event if one is due."""
        self._observers.publish_rows(rows)
        if self._step is not None and time.monotonic() >= self._next:
            self.progress()

    def asking(self, text: str) -> None:
        """Publish an event for a question to the operator."""
        self._asked += 1  # distinguishes questions with equal text
        self._observers.publish(
            {"kind": "prompt", "text": text, "asked": self._asked, "answered_by": ""}
        )

    def answered(self, text: str, reply: Reply) -> None:
        """Publish the answer of the operator, or that no operator could answer."""
        answer = {"answered_by": reply.who or "nobody", "answer": reply.word}
        self._observers.publish({"kind": "prompt", "text": text, **answer})

    def progress(self) -> None:
        """Publish an event with the progress of the run."""
        if self._step is None:
            return
        self._next = time.monotonic() + PROGRESS_EVERY_S
        done = self._done
        self._observers.publish(
            {
                "kind": "progress",
                **self._where(self._step),
                "device_s": done.last - done.first,
                "wall_s": self.wall_s,
                "duration_s": self._plan.duration_s,
                "resumed": self._resumed,
                "samples": done.samples,
                "state": str(self._state),
                **self._health(),
            }
        )

    def _where(self, step: Step) -> dict[str, object]:
        return {
            "step": step.index,
            "steps": self._steps,
            "doing": step.kind,
            "pose": step.pose,
            "trajectory": step.trajectory,
        }
