"""Is the load mounted the load declared? Judged after each weighing, before anything is measured.

The engine hands over what every dwell measured (`Engine(..., measured=weighing.measured)`). What a
load adds to the torques of the first one at the same poses is compared with what the declared
loads would make of them, so that friction and what is not known of the arm cancel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from hil.core import DataError, PreflightFailed, StructArray
from hil.dynamics import load_model
from hil.planning import Plan, Step, is_sweep, why_plan_not_weighed
from hil.robot import Capabilities
from hil.spec import Weigh
from hil.workflow.scales import LoadReading, Reading, compare, gains_of, load_reading, reading_of
from hil.workflow.weighing_verdict import Verdict, differs, friction_of

CHECK = "weighing"
"""Name of the check in preflight and of its waiver, and kind of its events."""

HINT = (
    "mount the load that is declared, the way round it is declared; correct `loads` in the spec; "
    f'or run all the same: --waive "{CHECK}=REASON"'
)

AGAIN_HINT = (
    "mount load 0 as it was when it was measured, and resume again; if it was another load then, "
    f'run the experiment anew; or go on all the same: --waive "{CHECK}=REASON"'
)
"""For a first load that is not what it was in an earlier attempt."""


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
        self._gains = gains_of(robot)
        self._readings: dict[int, Reading | str] = {}
        self._before: LoadReading | str | None = None
        self._steps: dict[int, list[Step]] = {}
        for step in plan:
            if step.kind == "weigh":
                self._steps.setdefault(step.load, []).append(step)
        self._not_weighed = why_plan_not_weighed(plan, robot)
        if not self._not_weighed:
            # Here and not when it is needed: the arm is about to be watched all the time.
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

    def restore(self, readings: Mapping[int, Reading | str]) -> None:
        """Take the first load's weighing from earlier attempts, for a run that is resumed.

        Other loads are compared with it, and so is the first load when it is weighed again.

        Args:
            readings: Of `weighed_before`.
        """
        if self._not_weighed or not readings:
            return
        self._readings.update(readings)
        self._before = self._together(0)

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
        elif load:
            self._compare(load, first, this)
        elif isinstance(self._before, LoadReading):
            self._compare(0, self._before, this)
        else:
            self._first(this)

    def _first(self, this: LoadReading) -> None:
        """The first load is taken on trust, and that is said if it should not have to be."""
        if self._before is None:
            self._event(CHECK, load=0, result="first", **friction_of(this))
            return
        problem = f"load 0: its weighing in an earlier attempt cannot be read ({self._before})"
        problem += ", so nobody knows whether it is the load that was measured then"
        self._event(CHECK, load=0, result="inconclusive", problem=problem, **friction_of(this))

    def _compare(self, load: int, first: LoadReading, this: LoadReading) -> None:
        """Judge what a load adds to the first one; to itself, that is nothing."""
        loads = self._plan.loads[0].payload, self._plan.loads[load].payload
        found = compare(self._model, self._steps[load], loads, (first, this))
        masses = [each.payload.mass for each in self._plan.loads]
        verdict = Verdict(found, self._tolerance, differs(masses, load), again=load == 0)
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
            compared = load == 0 and bool(figures)
            raise PreflightFailed(f"{CHECK}: {problem}", hint=AGAIN_HINT if compared else HINT)
