"""The engine: executes a plan on a robot, and is the only thing that moves it.

One loop on one thread: hand over a segment, read blocks until it is over. Whatever happens, the
robot is stopped on the way out, is watched until it is at rest, and the run ends with an outcome.
"""

from __future__ import annotations

import contextlib
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from hil.engine.interlocks import Interlock
from hil.engine.observers import Observers
from hil.engine.reading import Reading, Sink, StopRequest
from hil.engine.states import Outcome, RunState, StateMachine
from hil.engine.steps import Prompt, Steps, nobody
from hil.errors import HilError, InterlockTripped, RobotError, RobotFault, Stopped
from hil.plan.plan import Plan, Step
from hil.robot import Robot


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


class Engine:
    """Runs one plan once.

    Args:
        plan: What to do; it must start where the robot stands (preflight checks that).
        robot: Connected.
        sink: Receives every sample and event.
        interlocks: Judged on every sample.
        observers: Told about progress; they stay open, the caller closes them.
        prompt: Asks the operator to change the load.
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
    ) -> None:
        self._plan = plan
        self._robot = robot
        self._sink = sink
        self._stop_request = StopRequest()
        self._reading = Reading(robot, sink, interlocks, plan.joint_names, self._stop_request)
        self._steps = Steps(plan, robot, self._reading, sink, prompt)
        self._observers = observers or Observers()
        self._machine = StateMachine()
        self._notes: list[str] = []
        self._clock = time.monotonic()

    @property
    def state(self) -> RunState:
        """Where the run is."""
        return self._machine.state

    def request_stop(self, reason: str, *, by_signal: bool = False) -> None:
        """Ask for a controlled stop; safe from any thread and from a signal handler."""
        self._stop_request.by_signal = by_signal
        self._stop_request.reason = reason

    def run(self, preflight: Callable[[], object] = lambda: None) -> RunResult:
        """Execute the plan to one of its ends.

        Args:
            preflight: Raises when the robot must not move.

        Returns:
            The result; errors of every kind end up in it and are not raised.
        """
        self._clock = time.monotonic()
        error: HilError | None = None
        try:
            self._execute_plan(preflight)
        except HilError as caught:
            error = caught
        except KeyboardInterrupt:
            error = Stopped("stopped by the keyboard", by_signal=True)
        except Exception as caught:  # a bug in hil or in a driver must not lose the run's end
            error = self._unexpected(caught)
        return self._result(self._halt(error))

    def _execute_plan(self, preflight: Callable[[], object]) -> None:
        self._enter(RunState.PREFLIGHT)
        preflight()
        self._enter(RunState.ARMED)
        # The first block is judged before anything moves: what is violated already trips.
        self._reading.block()
        self._enter(RunState.RUNNING)
        for step in self._plan:
            self._steps.execute(step)
            self._publish(step)

    def _enter(self, state: RunState) -> None:
        self._stop_request.obey()
        self._machine.to(state)
        self._sink.event("state", state=str(state))

    def _halt(self, error: HilError | None) -> HilError | None:
        """Stop the robot first, then tell others; nothing here may prevent the stop."""
        failure: HilError | None = None
        try:
            self._robot.stop()
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
        if isinstance(error, InterlockTripped):
            self._sink.event("trip", reason=error.message)
        self._sink.event("state", state=str(RunState.STOPPING))

    def _come_to_rest(self) -> str:
        try:
            return self._reading.to_rest()
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

    def _publish(self, step: Step) -> None:
        progress = self._reading.progress
        self._observers.publish(
            {
                "kind": "progress",
                "step": step.index,
                "steps": len(self._plan),
                "doing": step.kind,
                "pose": step.pose,
                "trajectory": step.trajectory,
                "device_s": progress.last - progress.first,
                "wall_s": time.monotonic() - self._clock,
                "duration_s": self._plan.duration_s,
                "samples": progress.samples,
            }
        )

    def _result(self, error: HilError | None) -> RunResult:
        self._machine.to(RunState.DONE)
        progress = self._reading.progress
        return RunResult(
            outcome=_outcome_of(error),
            reason=error.message if error else "",
            error=error,
            steps_done=progress.steps_done,
            unsettled=tuple(progress.unsettled),
            samples=progress.samples,
            device_s=progress.last - progress.first if progress.samples else 0.0,
            wall_s=time.monotonic() - self._clock,
            notes=tuple(self._notes),
        )


def _outcome_of(error: HilError | None) -> Outcome:
    if error is None:
        return Outcome.COMPLETED
    if isinstance(error, InterlockTripped):
        return Outcome.TRIPPED
    return Outcome.STOPPED if isinstance(error, Stopped) else Outcome.FAILED
