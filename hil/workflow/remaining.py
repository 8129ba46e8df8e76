"""What a resumed run still has to do, and how it gets there from where the arm stands.

A plan falls into legs: the motions that lead to one measurement, and the measurement. A leg that
is complete in the data is never repeated, one that is not is repeated whole, so that every dwell
is reached from the side it was planned to be reached from. Changing the load, and weighing it,
comes before the first leg under a load, because nobody knows what happened in between.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray
from hil.excitation import STANDSTILL_RAD, Line
from hil.planning import Plan, Step

FIRST_APPROACH = -2
"""Index of the first motion back to the plan; the next ones count down. −1 is `no step`."""

Way = Callable[[FloatArray, FloatArray], Sequence[Line]]
"""Clear lines from one joint position (n,) to another; raises `PlanError` when there are none."""


@dataclass(frozen=True, slots=True)
class Leg:
    """Steps that belong together, the last of which measures, weighs or changes the load.

    Attributes:
        steps: In order.
        closed: False for motions at the end of a load that lead to no measurement.
    """

    steps: tuple[Step, ...]
    closed: bool = True

    @property
    def last(self) -> Step:
        """The step it is about."""
        return self.steps[-1]


def legs_of(plan: Plan) -> list[Leg]:
    """The legs of a plan, in order; together they are all its steps."""
    legs: list[Leg] = []
    open_steps: list[Step] = []
    for step in plan:
        if step.kind == "payload" and open_steps:
            legs.append(Leg(tuple(open_steps), closed=False))
            open_steps = []
        open_steps.append(step)
        if step.measures or step.kind in ("payload", "weigh"):
            legs.append(Leg(tuple(open_steps)))
            open_steps = []
    return [*legs, Leg(tuple(open_steps), closed=False)] if open_steps else legs


def remaining_steps(
    plan: Plan, done: Collection[int], *, cold: bool, weigh_first: bool = False
) -> list[Step]:
    """The steps of a plan that are still to be executed, in order.

    Args:
        plan: All there was to do.
        done: Measuring steps that are complete.
        cold: Whether the arm has to be warmed up again.
        weigh_first: Whether the first load has to be weighed again even if nothing is left to
            measure with it: the others are weighed against it.

    Returns:
        Nothing when everything is done.
    """
    legs = legs_of(plan)
    needed = {step.load for step in plan if step.measures and step.index not in done}
    if needed and weigh_first:
        needed.add(0)
    warm_up = [step for step in plan if step.kind == "warmup"] if cold else []
    out: list[Step] = []
    for load in dict.fromkeys(step.load for step in plan):
        if load not in needed:
            continue
        own = [leg for leg in legs if leg.closed and leg.last.load == load]
        todo = [leg for leg in own if leg.last.measures and leg.last.index not in done]
        before = [leg for leg in own if leg.last.kind in ("payload", "weigh")]
        out += [step for leg in before for step in leg.steps]
        if todo and not any(step.kind == "warmup" for step in todo[0].steps):
            out += warm_up
        warm_up = [] if todo else warm_up
        out += [step for leg in todo for step in leg.steps]
    return out


def connected_steps(steps: Sequence[Step], here: FloatArray, way: Way) -> list[Step]:
    """The steps with the motions between them that the plan did not foresee.

    The first change of load happens where the arm stands; later ones where the plan has them.

    Args:
        steps: Of a plan, in order, some left out.
        here: (n,) set-point the robot holds [rad].
        way: Finds the way from one position to another.

    Raises:
        PlanError: There is no clear way.
    """
    return list(_connected(steps, here, way))


def _connected(steps: Sequence[Step], here: FloatArray, way: Way) -> Iterator[Step]:
    index = FIRST_APPROACH
    for i, step in enumerate(steps):
        target = _next_start(steps[i:]) if i or step.motion is not None else None
        if target is not None and np.abs(target - here).max() >= STANDSTILL_RAD:
            for k, line in enumerate(way(here, target)):
                yield Step(index, "move", line, load=step.load, checkpoint=k == 0)
                index -= 1
            here = target
        yield step
        if step.motion is not None:
            here = step.motion.q_end


def _next_start(steps: Sequence[Step]) -> FloatArray | None:
    return next((step.motion.q_start for step in steps if step.motion is not None), None)
