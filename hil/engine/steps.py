"""Executing the steps of a plan, one after the other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from hil.core import CommandRefused, RobotTimeout, Stopped, StructArray
from hil.engine.dwell import DwellWatch
from hil.engine.prompt import Prompt
from hil.engine.reading import Reading, Sink
from hil.excitation import Motion
from hil.planning import AT_REST, Plan, Step, StepKind
from hil.robot import Robot, Segment, Status

SEGMENT_KINDS: dict[StepKind, Literal["move", "trajectory", "hold"]] = {
    "warmup": "move",
    "move": "move",
    "dwell": "hold",
    "reference": "hold",
    "weigh": "hold",
    "trajectory": "trajectory",
}
PARKED = -1
"""Segment of samples that belong to no step: before the first one, while paused or asked."""

COMMAND_WITHIN_S = 30.0
"""What a driver may take to take over a motion or a load; the arm stands still meanwhile [s]."""

PARK_WITHIN_S = 2.0
"""How soon a standing arm has taken over a new set-point to hold [s]."""

DWELL_GRACE_S = 2.0
"""How much longer than its own time-out a dwell may take before the robot counts as hung [s]."""

LEAST_SHARE = 0.02
"""Smallest speed share used to extend a move's time-out; lower shares count as this one."""

Measured = Callable[[Step, StructArray], object]
"""Is given the settled rows of every dwell; may raise when they say that something is wrong."""


class Steps:
    """Knows how each kind of step is done.

    Args:
        plan: Where the steps come from.
        robot: Connected.
        reading: Reads, records and judges while a step is executed.
        sink: Receives events.
        prompt: Asks the operator to change the load.
        measured: Is given what every dwell measured.
    """

    def __init__(
        self,
        plan: Plan,
        robot: Robot,
        reading: Reading,
        sink: Sink,
        prompt: Prompt,
        measured: Measured,
    ) -> None:
        self._plan = plan
        self._robot = robot
        self._reading = reading
        self._sink = sink
        self._prompt = prompt
        self._measured = measured

    def execute(self, step: Step) -> None:
        """Do one step to its end, or raise what ended it."""
        self._reading.requests.obey_stop()
        if step.kind == "payload":
            self._change_load(step)
        elif step.motion is not None:
            self._move(step, step.motion)
        self._reading.progress.steps_done += 1

    def park(self) -> None:
        """Hold the set-point where it is; the samples from now on belong to no step."""
        row = self._reading.newest
        if row is None or int(row["segment"]) == PARKED:
            return
        q = np.where(np.isfinite(row["q_target"]), row["q_target"], row["q"])[None]
        zeros = np.zeros_like(q)
        self._command(Segment(PARKED, "hold", q, zeros, zeros, 0.0, 0.0))
        self._until_over(PARKED, PARK_WITHIN_S, "parking")

    def _change_load(self, step: Step) -> None:
        load = self._plan.loads[step.load]
        self.park()
        if load.prompt:
            self._confirm(load.prompt)
        self._reading.patience(COMMAND_WITHIN_S)
        read_back = self._robot.set_payload(load.payload)
        self._reading.patience(0.0)
        self._sink.event("payload", load=step.load, mass_kg=read_back.mass, com_m=read_back.com)
        if not load.payload.agrees_with(read_back):
            raise CommandRefused(
                f"payload {load.payload} was declared, the robot reads back {read_back}",
                hint="check the payload settings of the controller",
            )

    def _confirm(self, text: str) -> None:
        reply = self._prompt(text, self._while_asked)
        self._sink.event("prompt", text=text, answered_by=reply.who, answer=reply.word)
        if not reply.yes:
            said = reply.words if reply.who else "nobody confirmed"
            raise Stopped(f"{said}: {text!r}")

    def _while_asked(self) -> str:
        self._reading.block()
        return self._reading.requests.why_paused

    def _move(self, step: Step, motion: Motion) -> None:
        self._command(segment_of(step, motion, self._plan.rate_hz))
        if step.kind in AT_REST:
            self._dwell(step)
        else:
            self._follow(step, motion)

    def _follow(self, step: Step, motion: Motion) -> None:
        within_s = 2.0 + 1.5 * motion.duration_s
        what = f"step {step.index} ({step.kind}), planned to take {motion.duration_s:.1f} s,"
        self._until_over(step.index, within_s, what)

    def _command(self, segment: Segment) -> None:
        self._reading.patience(COMMAND_WITHIN_S)
        self._robot.prepare(segment)
        # An upload may have taken its time, or have been given up by the watchdog.
        self._reading.requests.obey_stop()
        self._robot.start()
        self._reading.patience(0.0)

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
                deadline.extend((1.0 - max(share, LEAST_SHARE)) * (now - before))
            before = now
            if deadline.over(now):
                raise RobotTimeout(
                    f"{what} was not over after {deadline.seconds:.1f} s",
                    hint="check whether the controller still runs its program",
                )

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
