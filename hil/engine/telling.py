"""What observers are told: states, steps, progress now and then, and blocks for who wants them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from hil.core import StructArray
from hil.engine.observers import Observers
from hil.engine.prompt import Reply
from hil.engine.reading import Progress
from hil.engine.states import RunState
from hil.planning import AT_REST, Plan, Step

EVERY_S = 0.2
"""Wall time between two progress events [s]."""

WAYS = ("move", "warmup")
"""Kinds of steps that only get somewhere."""

Health = Callable[[], Mapping[str, Any]]
"""Gaps, duplicates, … of the recording so far, and how far it is behind; cheap."""


def under_way(plan: Plan, step: Step) -> str:
    """What was being done, such as `in step 37 (move to pose 18)`, counted as people are told."""
    which = f"step {step.index + 1}" if step.index >= 0 else "a step of the way back"
    return f"in {which} ({step.kind}{_of_what(plan, step)})"


def _of_what(plan: Plan, step: Step) -> str:
    """A way leads to the pose that is measured next; it has no pose of its own."""
    if step.trajectory >= 0:
        return f" {step.trajectory}"
    if step.kind in AT_REST:
        return f" at pose {step.pose}" if step.pose >= 0 else ""
    after = plan.steps[plan.steps.index(step) + 1 :]
    goal = next((s for s in after if s.kind not in WAYS), step)
    if step.kind not in WAYS or goal.kind not in AT_REST:
        return ""
    return f" to pose {goal.pose}" if goal.pose >= 0 else f" to the {goal.kind}"


class Telling:
    """Publishes what a run does.

    Args:
        plan: What is executed.
        observers: Who is told.
        health: How the recording is doing.
        steps: Of how many steps to speak; those of the plan by default, which is then all of it.
    """

    def __init__(
        self, plan: Plan, observers: Observers, health: Health, steps: int | None = None
    ) -> None:
        self._plan = plan
        self._observers = observers
        self._health = health
        self._steps = steps or len(plan)
        self._resumed = int(steps is not None)
        self._step: Step | None = None
        self._progress = Progress()
        self._next = 0.0
        self._begin = time.monotonic()
        self._state = RunState.IDLE
        self._asked = 0

    def begin(self, progress: Progress) -> None:
        """The run begins; `progress` is looked at whenever it is told about."""
        self._progress = progress
        self._begin = time.monotonic()

    @property
    def wall_s(self) -> float:
        """Wall time since the beginning [s]."""
        return time.monotonic() - self._begin

    def state(self, state: RunState, reason: str = "") -> None:
        """The run is in another state now."""
        self._state = state
        self._observers.publish({"kind": "state", "state": str(state), "reason": reason})

    def step(self, step: Step) -> None:
        """A step begins."""
        self._step = step
        self._observers.publish({"kind": "step", **self._where(step), "load": step.load})

    def block(self, rows: StructArray) -> None:
        """A block was recorded and judged."""
        self._observers.publish_rows(rows)
        if self._step is not None and time.monotonic() >= self._next:
            self.progress()

    def asking(self, text: str) -> None:
        """The operator is asked something."""
        self._asked += 1  # two questions may have the same text
        self._observers.publish(
            {"kind": "prompt", "text": text, "asked": self._asked, "answered_by": ""}
        )

    def answered(self, text: str, reply: Reply) -> None:
        """The operator has answered, or nobody could."""
        said = {"answered_by": reply.who or "nobody", "answer": reply.word}
        self._observers.publish({"kind": "prompt", "text": text, **said})

    def progress(self) -> None:
        """How far the run is."""
        if self._step is None:
            return
        self._next = time.monotonic() + EVERY_S
        done = self._progress
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
