"""The engine: executes a plan on a robot, and is the only thing that moves it.

One loop on one thread: hand over a segment, read blocks until it is over. A run is in one of the
states of `RunState`, and `Engine.run` always ends it with a `RunResult`: nothing is raised from
there.

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

**Pauses** happen at checkpoints of the plan only. Operators and signals request them, interlocks
with the action `pause` hold the run; the arm holds its set-point, reading and judging go on.

**Stops** come in four ways, and all of them end in `Engine._halt`:

- A request (operator, signal) is left in `Requests` and obeyed by the control thread before the
  next block, the next command and the next state: within one block, as `Stopped`.
- A trip, a fault, stale state or a recorder that fails is raised from `Reading.block`. For a trip
  the robot has been stopped by then.
- Any other error, from a driver, a prompt or a bug, comes up to `Engine.run` by itself.
- A control thread that does not come round any more obeys nothing. The watchdog notices, stops the
  robot from its own thread and gives the control thread up (`Engine._hung`); a process that was
  suspended is stopped before the control thread goes on (`Engine._was_suspended`).

`_halt` stops the robot, whatever has happened before, then tells others, then watches the arm come
to rest. Every call on that way may take only so long, and nothing there may prevent the stop. (The
third signal does not wait for any of this: see `hil.engine.signals`.)

The file goes from the states, the prompt and the result over `Engine` (run, stop, pause, steps) to
the parts it is made of.
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
    """Where a run is."""

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
"""Every state but the last two has an edge to STOPPING: a stop is possible from everywhere."""


class IllegalTransition(RuntimeError):
    """A bug in the engine: it tried to go where the table has no edge."""


class StateMachine:
    """Holds the current state and refuses transitions the table does not have."""

    def __init__(self) -> None:
        self.state = RunState.IDLE

    def to(self, new: RunState) -> None:
        """Go to `new`.

        Raises:
            IllegalTransition: There is no such edge.
        """
        if new not in TRANSITIONS[self.state]:
            raise IllegalTransition(f"no transition from {self.state} to {new}")
        self.state = new


class Outcome(StrEnum):
    """How a run ended. One without stop document is `interrupted`: nobody could say."""

    COMPLETED = "completed"
    STOPPED = "stopped"
    TRIPPED = "tripped"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class RunResult:
    """How a run ended.

    Attributes:
        outcome: `completed`, `stopped`, `tripped` or `failed`.
        reason: In words, empty when completed.
        error: What ended it early, None when completed.
        steps_done: Plan steps that were executed to their end.
        unsettled: Steps whose dwell ran into its time-out.
        samples: State rows read.
        device_s: Device time from the first to the last sample [s].
        wall_s: Wall time of the run [s].
        notes: What else went wrong on the way out.
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
    """The answer to a question.

    Attributes:
        yes: Whether it is done; a no stops the run.
        who: Who answered; empty when nobody did, which is no yes either.
    """

    yes: bool
    who: str

    @property
    def word(self) -> str:
        """`yes` or `no`; nothing when nobody answered."""
        return ("yes" if self.yes else "no") if self.who else ""

    @property
    def words(self) -> str:
        """`anna answered no`, for people."""
        return f"{self.who} answered {self.word}" if self.who else "nobody answered"


NOBODY = Reply(yes=False, who="")
"""Nobody could answer."""

Prompt = Callable[[str, Callable[[], object]], Reply]
"""Asks the operator; returns who answered what.

While it waits it calls its second argument again and again: that keeps reading the robot, raises
`Stopped` when a stop is requested, and returns why the run will pause once the question is
answered, nothing while it will not.
"""


def nobody(text: str, meanwhile: Callable[[], object]) -> Reply:
    """Answer for an unattended run: nobody confirms."""
    return NOBODY


GoOn = Callable[[], str]
"""Looks, without waiting, whether somebody at the robot lets the run go on: who, or nothing."""


def nobody_goes_on() -> str:
    """Answer for a run without a console: only a request lets it go on."""
    return ""


Measured = Callable[[Step, StructArray], object]
"""Is given the settled rows of every dwell; may raise when they say that something is wrong."""

Health = Callable[[], Mapping[str, Any]]
"""Gaps, duplicates, … of the recording so far, and how far it is behind; cheap."""


@dataclass(slots=True)
class Requests:
    """What operators, signals, interlocks and the watchdog ask of a run.

    Set from any thread or a signal handler; the control thread looks at them before every block.

    Attributes:
        ended_by: Error for which the watchdog ended the run; None if it did not.
        stop: Stop reason; empty if none.
        by_signal: Whether a signal requested the stop.
        pause: Pause reason; empty if none.
        held: The violation of an interlock that only pauses; empty if none.
        resumed_by: Who let it go on last.
    """

    ended_by: HilError | None = None
    stop: str = ""
    by_signal: bool = False
    pause: str = ""
    held: str = ""
    resumed_by: str = ""

    def obey_stop(self) -> None:
        """Raise `Stopped` if a stop was requested, or the error of the watchdog."""
        if self.ended_by is not None:
            raise self.ended_by
        if self.stop:
            raise Stopped(self.stop, by_signal=self.by_signal)

    @property
    def why_paused(self) -> str:
        """Every reason to pause, empty when there is none."""
        return "; ".join(reason for reason in (self.pause, self.held) if reason)


READ_WITHIN_S = 3.0
"""What a driver may take for the last `read`, beside the time the arm needs to come to rest."""

COMMAND_WITHIN_S = 30.0
"""What a driver may take to take over a motion or a load; the arm stands still meanwhile [s]."""

PARK_WITHIN_S = 2.0
"""How soon a standing arm has taken over a new set-point to hold [s]."""

DWELL_GRACE_S = 2.0
"""How much longer than its own time-out a dwell may take before the robot counts as hung [s]."""

LEAST_PACE = 0.02
"""Smallest speed share used to extend a move's time-out; lower shares count as this one."""

CLEAR_FOR_S = 5.0
"""Device time an interlock that pauses must be clear before the run goes on by itself [s]."""

UNATTENDED_S = 3600.0
"""Device time for which interlocks may pause a run that no operator attends [s]: a hot joint cools
down in less, whereas a speed slider or a full disk stays as it is until a person is notified."""

UNHURRIED_BLOCKS = 200
SLOWLY_S = 0.1
"""Wall time a block takes on a virtual clock once a pause has become a long one [s]."""

PARKED = -1
"""Segment of samples that belong to no step: before the first one, while paused or asked."""

SEGMENT_KINDS: dict[StepKind, Literal["move", "trajectory", "hold"]] = {
    "warmup": "move",
    "move": "move",
    "dwell": "hold",
    "reference": "hold",
    "weigh": "hold",
    "trajectory": "trajectory",
}

SILENCE = (RobotTimeout, RobotConnectionError, StaleState)
"""What a robot looks like to a process that did not run, however short that was."""


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
        """Where the run is."""
        return self._machine.state

    @property
    def pause_pending(self) -> bool:
        """Whether a pause is requested, be it still to come or there already."""
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
        self._notifier.begin()
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
        # The first violation is the reason; those that follow only go on with it.
        self._requests.held = self._requests.held or trip.text(self._plan.joint_names)

    def _health_now(self) -> Mapping[str, Any]:
        return {**self._health(), "pausing": self._requests.why_paused}

    def _explain(self, error: RobotError, step: Step) -> None:
        """Add the step of the plan and a lowered speed, which the driver does not know."""
        if isinstance(error, RobotFault | RobotConnectionError | StaleState):
            error.message += f", {under_way(self._plan, step)}"
        if slowed := self._reading.slowed:
            error.message += f"; {slowed}"
            error.hint = "; ".join(filter(None, (error.hint, "set the speed slider to 100 %")))

    # Stopping.

    def _halt(self, error: HilError | None) -> HilError | None:
        """Stop the robot first, then tell others; nothing here may prevent the stop.

        Returns:
            What ended the run; a `RobotFault` where only the stop itself went wrong.
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
        except Exception as caught:  # a broken driver or sink: the stop was commanded already
            moving = self._unexpected(caught).message
        problems = [f"stopping the robot: {failure.message}"] if failure else []
        problems += [moving] if moving else []
        self._notes += problems
        if error is None and problems:
            return RobotFault("; ".join(problems), hint="look at the robot before going near it")
        return error

    def _unexpected(self, caught: Exception) -> HilError:
        self._notes.append("".join(traceback.format_exception(caught)[-3:]).strip())
        error = RobotError(
            f"unexpected {type(caught).__name__}: {caught}",
            hint="this is a bug in hil or in the driver; stop.json holds where it happened",
        )
        error.__cause__ = caught
        return error

    def _hung(self) -> None:
        """On the watchdog's thread: the control thread has not come round for seconds."""
        who = "the driver did not return from a call for seconds"
        hint = (
            "look at the robot; own_process: true in the station gives the driver its own process"
        )
        # Whatever the thread does when the call returns after all, it is not a motion.
        self._requests.ended_by = RobotTimeout(who, hint=hint)
        try:
            with contextlib.suppress(Exception):  # it is stopped once more on the way out
                stop_robot(self._robot)
            if hanging := self._reading.judge.hanging:  # looks up whose it is, which takes a while
                who, self._requests.ended_by = hanging.message, hanging
            self._notes.append(f"{who}; the watchdog stopped the robot")
            self._sink.event("hung", reason=self._notes[-1])
        finally:
            self._given_up.set()

    def _was_suspended(self, seconds: float) -> None:
        """On the watchdog's thread: stop the robot before the control thread resumes."""
        self._requests.ended_by = self._suspension(seconds)
        with contextlib.suppress(HilError):
            stop_robot(self._robot)

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

    # Pausing.

    def _pause_if_asked(self) -> None:
        """Hold while a pause is requested or an interlock holds the run.

        Raises:
            InterlockTripped: No operator attends the run, and an interlock has held it for long.
            HilError: What ended the run while it was paused: a stop, a trip, a fault.
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
                # Nobody has to wait through a night of a virtual clock, nor to record it.
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
            # A pause that a person asked for is ended by a person, who can see the interlock too.
            if not requests.held or attended or requests.pause:
                waiting_since = None
            elif waiting_since is None:
                waiting_since = now
            elif now - waiting_since >= UNATTENDED_S:
                raise InterlockTripped(
                    f"{requests.held}; paused for {UNATTENDED_S / 60:g} min without it being "
                    "clear, and no operator attends the run",
                    hint="remove the cause at the robot, then resume the run",
                )
            if (why := requests.why_paused) and why != reported:
                self._sink.event("paused", reason=why)
                reported = why

    # Steps.

    def _execute(self, step: Step) -> None:
        """Execute one step to its end, or raise what ended it."""
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
        """Ask the operator, reading on meanwhile; raise `Stopped` unless the answer is yes."""

        def meanwhile() -> str:
            self._reading.block()
            return self._requests.why_paused

        self._sink.event("asked", text=text)
        self._notifier.asking(text)
        reply = self._ask(text, meanwhile)
        self._notifier.answered(text, reply)
        self._sink.event("prompt", text=text, answered_by=reply.who, answer=reply.word)
        if not reply.yes:
            refusal = reply.words if reply.who else "nobody confirmed"
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
        """Hold the set-point where it is; the samples from now on belong to no step."""
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
        # An upload may have taken its time, or have been given up by the watchdog.
        self._requests.obey_stop()
        self._robot.start()
        self._watchdog.be_patient(0.0)

    def _until_over(self, segment: int, within_s: float, what: str) -> None:
        """Read until a segment is over; a lowered speed slider makes its time-out later.

        Raises:
            RobotTimeout: It takes longer.
        """
        deadline = self._reading.deadline(within_s)
        before = self._reading.progress.last
        while True:
            last = self._reading.block()[-1]
            if last["segment"] == segment and not last["status"] & Status.MOVING:
                return
            now, share = float(last["device_time"]), self._reading.speed_share
            if share < 1.0 and now > before:
                # The motion has come as far as `share` of this time at its planned speed.
                deadline.extend((1.0 - max(share, LEAST_PACE)) * (now - before))
            before = now
            if deadline.over(now):
                raise RobotTimeout(
                    f"{what} was not over after {deadline.seconds:.1f} s",
                    hint="check whether the controller still runs its program",
                )


def _outcome_of(error: HilError | None) -> Outcome:
    if error is None:
        return Outcome.COMPLETED
    if isinstance(error, InterlockTripped):
        return Outcome.TRIPPED
    return Outcome.STOPPED if isinstance(error, Stopped) else Outcome.FAILED


WAYS = ("move", "warmup")
"""Kinds of steps that only get somewhere."""


def under_way(plan: Plan, step: Step) -> str:
    """Describe a step, such as `in step 37 (move to pose 18)`, counted as people count.

    A way leads to the pose that is measured next; it has no pose of its own.
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
    which = f"step {step.index + 1}" if step.index >= 0 else "a step of the way back"
    return f"in {which} ({step.kind}{of})"


class DwellWatch:
    """Decides when a dwell is over: enough settled samples, the shortest time, or the time-out.

    Args:
        rule: The plan's rule.
    """

    def __init__(self, rule: DwellRule) -> None:
        self._rule = rule
        self._since: float | None = None
        self._quiet: list[bool] = []
        self._last = 0.0
        self._newest: list[StructArray] = []

    def feed(self, block: StructArray) -> bool:
        """Add samples of this dwell; return whether it is over, settled or not."""
        if self._since is None:
            self._since = float(block["device_time"][0])
        speed: FloatArray = np.abs(block["qd"]).max(axis=1)
        self._quiet.extend((speed < self._rule.settle_rad_s).tolist())
        self._last = float(block["device_time"][-1])
        self._newest = [*self._newest[-self._rule.samples :], block]
        return self.settled or self.elapsed_s >= self._rule.timeout_s

    @property
    def rows(self) -> StructArray:
        """The newest rows, as many as the rule asks for (fewer when there are fewer)."""
        return np.concatenate(self._newest)[-self._rule.samples :]

    @property
    def elapsed_s(self) -> float:
        """Device time since the dwell began [s]."""
        return 0.0 if self._since is None else self._last - self._since

    @property
    def settled(self) -> bool:
        """True when the newest samples are all at rest and the shortest time is over."""
        newest = self._quiet[-self._rule.samples :]
        enough = len(newest) == self._rule.samples and all(newest)
        return enough and self.elapsed_s >= self._rule.dwell_s


PROGRESS_EVERY_S = 0.2
"""Wall time between two progress events [s]."""


class Notifier:
    """Publishes what a run does: states, steps, prompts, progress now and then, and blocks.

    Args:
        plan: What is executed.
        observers: Receive the events.
        done: What has been read and done; looked at whenever progress is published.
        health: How the recording is doing.
        steps: Of how many steps to speak; those of the plan by default, which is then all of it.
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
        """Start the wall clock of the run."""
        self._begin = time.monotonic()

    @property
    def wall_s(self) -> float:
        """Wall time since the beginning [s]."""
        return time.monotonic() - self._begin

    def state(self, state: RunState, reason: str = "") -> None:
        """Publish the state that the run is in now."""
        self._state = state
        self._observers.publish({"kind": "state", "state": str(state), "reason": reason})

    def step(self, step: Step) -> None:
        """Publish the step that begins."""
        self._step = step
        self._observers.publish({"kind": "step", **self._where(step), "load": step.load})

    def block(self, rows: StructArray) -> None:
        """Publish a block that was recorded and judged, and progress if it is due."""
        self._observers.publish_rows(rows)
        if self._step is not None and time.monotonic() >= self._next:
            self.progress()

    def asking(self, text: str) -> None:
        """Publish a question to the operator."""
        self._asked += 1  # two questions may have the same text
        self._observers.publish(
            {"kind": "prompt", "text": text, "asked": self._asked, "answered_by": ""}
        )

    def answered(self, text: str, reply: Reply) -> None:
        """Publish the operator's answer, or that nobody could answer."""
        answer = {"answered_by": reply.who or "nobody", "answer": reply.word}
        self._observers.publish({"kind": "prompt", "text": text, **answer})

    def progress(self) -> None:
        """Publish how far the run is."""
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
