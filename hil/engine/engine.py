"""The engine: executes a plan on a robot, and is the only thing that moves it.

One loop on one thread: hand over a segment, read blocks until it is over, judge every sample by
the interlocks, pass every block to the recorder. Whatever happens, the robot is stopped on the way
out and the run ends with an outcome.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np

from hil.engine.dwell import DwellWatch
from hil.engine.interlocks import Interlock
from hil.engine.observers import Observers
from hil.engine.states import Outcome, RunState, StateMachine
from hil.errors import CommandRefused, HilError, InterlockTripped, RobotTimeout, Stopped
from hil.excite.motion import Motion
from hil.payload import Payload
from hil.plan.plan import Plan, Step, StepKind
from hil.robot import Robot, Segment, Status
from hil.typing import StructArray

PAYLOAD_TOLERANCE_KG = 0.01

SEGMENT_KINDS: dict[StepKind, Literal["move", "trajectory", "hold"]] = {
    "warmup": "move",
    "move": "move",
    "dwell": "hold",
    "reference": "hold",
    "trajectory": "trajectory",
}


class Sink(Protocol):
    """Where samples and events go: the recorder, or a list in tests."""

    def put(self, rows: StructArray) -> None:
        """Take over a block; raises `RecordingError` when it can no longer be kept."""

    def event(self, kind: str, **details: Any) -> None:
        """Take over one event."""


Prompt = Callable[[str], bool]
"""Shows a text to the operator; returns True when it was confirmed."""


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


@dataclass(slots=True)
class _Progress:
    samples: int = 0
    first: float = float("nan")
    last: float = float("nan")
    unsettled: list[int] = field(default_factory=list)
    steps_done: int = 0

    def count(self, block: StructArray) -> None:
        if self.samples == 0:
            self.first = float(block["device_time"][0])
        self.samples += len(block)
        self.last = float(block["device_time"][-1])


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
        prompt: Prompt = lambda text: False,
    ) -> None:
        self._plan = plan
        self._robot = robot
        self._sink = sink
        self._interlocks = tuple(interlocks)
        self._observers = observers or Observers()
        self._prompt = prompt
        self._machine = StateMachine()
        self._progress = _Progress()
        self._stop_reason = ""
        self._stop_by_signal = False
        self._notes: list[str] = []
        self._clock = time.monotonic()

    @property
    def state(self) -> RunState:
        """Where the run is."""
        return self._machine.state

    def request_stop(self, reason: str, *, by_signal: bool = False) -> None:
        """Ask for a controlled stop; safe from any thread and from a signal handler."""
        self._stop_by_signal = by_signal
        self._stop_reason = reason

    def run(self, preflight: Callable[[], None] = lambda: None) -> RunResult:
        """Execute the plan to one of its ends.

        Args:
            preflight: Raises when the robot must not move.

        Returns:
            The result; errors end up in it and are not raised.
        """
        self._clock = time.monotonic()
        error: HilError | None = None
        try:
            self._enter(RunState.PREFLIGHT)
            preflight()
            self._enter(RunState.ARMED)
            self._arm()
            self._enter(RunState.RUNNING)
            for step in self._plan:
                self._execute(step)
        except HilError as caught:
            error = caught
        except KeyboardInterrupt:
            error = Stopped("stopped by the keyboard", by_signal=True)
        finally:
            self._halt()
        return self._result(error)

    def _enter(self, state: RunState) -> None:
        self._obey_stop_request()
        self._machine.to(state)
        self._sink.event("state", state=str(state))

    def _halt(self) -> None:
        """Stop the robot first, then tell others; nothing here may prevent the stop."""
        try:
            self._robot.stop()
        except HilError as error:  # the cause of the end is already known: keep both
            self._notes.append(f"stopping the robot: {error.message}")
        self._machine.to(RunState.STOPPING)
        with contextlib.suppress(HilError):
            self._sink.event("state", state=str(RunState.STOPPING))

    def _arm(self) -> None:
        """Judge the first block before anything moves: a condition already violated trips."""
        self._read_block()

    def _execute(self, step: Step) -> None:
        self._obey_stop_request()
        if step.checkpoint:
            self._sink.event("checkpoint", step=step.index)
        if step.kind == "payload":
            self._change_load(step)
        elif step.motion is not None:
            self._move(step, step.motion)
        self._progress.steps_done += 1
        self._publish(step)

    def _change_load(self, step: Step) -> None:
        load = self._plan.loads[step.load]
        if load.prompt:
            confirmed = self._prompt(load.prompt)
            self._sink.event("prompt", text=load.prompt, confirmed=confirmed)
            if not confirmed:
                raise Stopped(f"the operator did not confirm: {load.prompt!r}")
        read_back = self._robot.set_payload(load.payload)
        self._sink.event("payload", load=step.load, mass_kg=read_back.mass)
        _require_same(load.payload, read_back)

    def _move(self, step: Step, motion: Motion) -> None:
        self._robot.prepare(segment_of(step, motion, self._plan.rate_hz))
        self._robot.start()
        if step.kind in ("dwell", "reference"):
            self._dwell(step)
        else:
            self._follow(step, motion)

    def _follow(self, step: Step, motion: Motion) -> None:
        deadline = 2.0 + 1.5 * motion.duration_s
        begin = self._progress.last
        while True:
            block = self._read_block()
            last = block[-1]
            if last["segment"] == step.index and not last["status"] & Status.MOVING:
                return
            if last["device_time"] - begin > deadline:
                raise RobotTimeout(
                    f"step {step.index} ({step.kind}) should take {motion.duration_s:.1f} s "
                    f"and was not over after {deadline:.1f} s"
                )

    def _dwell(self, step: Step) -> None:
        watch = DwellWatch(self._plan.dwell)
        while True:
            block = self._read_block()
            mine = block[block["segment"] == step.index]
            if len(mine) and watch.feed(mine):
                break
        if not watch.settled:
            self._progress.unsettled.append(step.index)
        self._sink.event(
            "dwell", step=step.index, settled=watch.settled, elapsed_s=round(watch.elapsed_s, 6)
        )

    def _read_block(self) -> StructArray:
        self._obey_stop_request()
        block = self._robot.read()
        self._sink.put(block)
        self._progress.count(block)
        for interlock in self._interlocks:
            if trip := interlock.check(block):
                self._robot.stop()
                self._sink.event("trip", interlock=trip.interlock, value=trip.value)
                raise trip.error(self._plan.joint_names)
        return block

    def _obey_stop_request(self) -> None:
        if self._stop_reason:
            raise Stopped(self._stop_reason, by_signal=self._stop_by_signal)

    def _publish(self, step: Step) -> None:
        progress = self._progress
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
        progress = self._progress
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


def segment_of(step: Step, motion: Motion, rate_hz: float) -> Segment:
    """The samples of a step as a robot wants them."""
    samples = motion.sample(rate_hz)
    return Segment(
        index=step.index,
        kind=SEGMENT_KINDS[step.kind],
        q=samples.q,
        qd=samples.qd,
        qdd=samples.qdd,
        speed=float(np.abs(samples.qd).max(initial=0.0)),
        acceleration=float(np.abs(samples.qdd).max(initial=0.0)),
    )


def _outcome_of(error: HilError | None) -> Outcome:
    if error is None:
        return Outcome.COMPLETED
    if isinstance(error, InterlockTripped):
        return Outcome.TRIPPED
    return Outcome.STOPPED if isinstance(error, Stopped) else Outcome.FAILED


def _require_same(declared: Payload, read_back: Payload) -> None:
    if abs(declared.mass - read_back.mass) > PAYLOAD_TOLERANCE_KG:
        raise CommandRefused(
            f"payload {declared.mass:.3f} kg was declared, "
            f"the robot reads back {read_back.mass:.3f} kg",
            hint="check the payload settings of the controller",
        )
