"""Is the load mounted the load declared? Judged after each weighing, before anything is measured.

The engine hands over what every dwell measured (`Engine(..., measured=weighing.measured)`). What a
load adds to the torques of the first one at the same poses is compared with what the declared
loads would make of them, so that friction and what is not known of the arm cancel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from hil.campaign.scales import LoadReading, Reading, compare, load_reading, reading_of
from hil.campaign.weighing_verdict import Verdict, differs, friction_of
from hil.errors import DataError, PreflightFailed
from hil.plan.plan import Plan, Step
from hil.plan.weighing import is_sweep, why_plan_not_weighed
from hil.robot import Capabilities
from hil.spec.weigh import Weigh
from hil.typing import FloatArray, StructArray

CHECK = "weighing"
"""Name of the check in preflight and of its waiver, and kind of its events."""

HINT = (
    "mount the load that is declared, the way round it is declared; correct `loads` in the spec; "
    f'or run all the same: --waive "{CHECK}=REASON"'
)


class Tell(Protocol):
    """Where results go; a sink's `event`."""

    def __call__(self, kind: str, **details: Any) -> object:
        """Record an event."""


class Weighing:
    """Weighs the loads of one run; says at once when it is not going to.

    Args:
        plan: Of the whole run.
        gravity: (3,) in the base frame [m/s²].
        robot: What its efforts are, and its drive gains.
        tolerance: Of the spec; None when it switches weighing off.
        event: Called with every result.
        waived: Whether a load that is not as declared is recorded and nothing more.
    """

    def __init__(
        self,
        plan: Plan,
        gravity: Sequence[float],
        robot: Capabilities,
        tolerance: Weigh | None,
        *,
        event: Tell,
        waived: bool = False,
    ) -> None:
        self._plan = plan
        self._tolerance = tolerance or Weigh()
        self._event = event
        self._waived = waived
        self._gains: FloatArray | float = 1.0
        if robot.effort_kind == "current":
            self._gains = np.array(robot.drive_gains)
        self._readings: dict[int, Reading | str] = {}
        self._steps: dict[int, list[Step]] = {}
        for step in plan:
            if step.kind == "weigh":
                self._steps.setdefault(step.load, []).append(step)
        self._not_weighed = why_plan_not_weighed(plan, robot)
        if not self._not_weighed:
            # Here and not when it is needed: the arm is about to be watched all the time.
            from hil.dynamics import load_model

            self._model = load_model(plan.robot_model, gravity=gravity)
        elif is_sweep(plan):
            self._event(CHECK, result="skipped", reason=self._not_weighed)

    def measured(self, step: Step, rows: StructArray) -> None:
        """Take note of a dwell's settled rows; after the last one of a load, judge the load.

        Raises:
            PreflightFailed: The load is not the one declared, or nobody can say; not if waived.
        """
        if self._not_weighed or step.kind != "weigh":
            return
        self._read(step, rows)
        if step.index == self._steps[step.load][-1].index:
            self._judge(step.load)

    def restore(self, rows_of_step: Callable[[int], StructArray | None]) -> None:
        """Take the first load's weighing from what was recorded, for a run that is resumed.

        Args:
            rows_of_step: The rows of a plan step, as far as there are any.
        """
        for step in [] if self._not_weighed else self._steps[0]:
            rows = rows_of_step(step.index)
            if rows is not None:
                self._read(step, rows[-self._plan.dwell_rule(step).samples :])

    def _read(self, step: Step, rows: StructArray) -> None:
        try:
            settle_rad_s = self._plan.dwell_rule(step).settle_rad_s
            reading = reading_of(rows, self._gains, settle_rad_s)
        except DataError as error:
            self._readings[step.index] = error.message
        else:
            self._readings[step.index] = reading

    def _judge(self, load: int) -> None:
        first, this = self._together(0), self._together(load)
        if isinstance(first, str) or isinstance(this, str):
            problem = this if isinstance(this, str) else f"the first load is missing: {first}"
            self._refuse(load, f"load {load} could not be weighed: {problem}", {})
            return
        if load == 0:
            self._event(CHECK, load=0, result="first", **friction_of(first))
            return
        loads = self._plan.loads[0].payload, self._plan.loads[load].payload
        found = compare(self._model, self._steps[load], loads, (first, this))
        masses = [each.payload.mass for each in self._plan.loads]
        verdict = Verdict(found, self._tolerance, differs(masses, load))
        if verdict.passed:
            self._pass(load, verdict)
            return
        told = f"load {load}: {verdict.text(self._plan.joint_names)}"
        self._refuse(load, told, verdict.figures)

    def _pass(self, load: int, verdict: Verdict) -> None:
        """Nothing speaks against the load; whether anything would have is another matter."""
        if verdict.conclusive:
            self._event(CHECK, load=load, result="passed", **verdict.figures)
            return
        problem = f"load {load}: {verdict.doubt}"
        self._event(CHECK, load=load, result="inconclusive", problem=problem, **verdict.figures)

    def _together(self, load: int) -> LoadReading | str:
        """The readings of a load, or why there are none."""
        found: dict[tuple[int, int], Reading] = {}
        for step in self._steps[load]:
            reading = self._readings.get(step.index, "nothing was recorded")
            if isinstance(reading, str):
                side = "below" if step.approach > 0 else "above"
                return f"at weighing pose {step.pose + 1} from {side}, {reading}"
            found[step.pose, step.approach] = reading
        return load_reading(found)

    def _refuse(self, load: int, problem: str, figures: dict[str, Any]) -> None:
        result = "waived" if self._waived else "failed"
        self._event(CHECK, load=load, result=result, problem=problem, **figures)
        if not self._waived:
            raise PreflightFailed(f"{CHECK}: {problem}", hint=HINT)
