"""What is left of a plan, whatever was done of it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.arms.payload import Payload
from hil.core.typing import FloatArray
from hil.excitation.motion import Hold, Line
from hil.planning.plan import LoadStep, Plan, Step
from hil.workflow.resuming import connected_steps, legs_of, remaining_steps


def line(a: float, b: float) -> Line:
    return Line((a,) * 6, (b,) * 6, velocity=1.0, acceleration=1.4, jerk=14.0, rate_hz=125.0)


def sweep(poses: int, loads: int, *, weigh: bool = True) -> Plan:
    """Warm-up, then every pose once per load, from home and back, each load weighed first."""
    steps: list[Step] = []
    here = 0.0

    def add(kind: str, motion: object = None, **more: object) -> None:
        steps.append(Step(len(steps), kind, motion, load=load, **more))  # type: ignore[arg-type]

    def go(to: float, kind: str = "move", **more: object) -> None:
        nonlocal here
        add(kind, line(here, to), **more)
        here = to

    for load in range(loads):
        if load and here:
            load -= 1
            go(0.0)
            load += 1
        add("payload", checkpoint=True)
        if weigh:
            go(0.9, checkpoint=True)
            add("weigh", Hold((here,) * 6))
        if load == 0:
            go(0.5, "warmup", checkpoint=True)
            go(-0.5, "warmup")
        for pose in range(poses):
            go(0.1 + 0.1 * pose, checkpoint=True)
            add("dwell", Hold((here,) * 6), pose=pose, approach=1)
            go(0.4 + 0.1 * pose)
            add("dwell", Hold((here,) * 6), pose=pose, approach=-1)
    names = tuple(f"j{i + 1}" for i in range(6))
    bodies = tuple(LoadStep(Payload(float(i))) for i in range(loads))
    return Plan("sweep", "ur5", names, 125.0, tuple(steps), bodies)


def straight(here: FloatArray, target: FloatArray) -> Sequence[Line]:
    return [line(float(here[0]), float(target[0]))]


plans = st.builds(sweep, st.integers(1, 4), st.integers(1, 3), weigh=st.booleans())


@st.composite
def plans_partly_done(draw: st.DrawFn) -> tuple[Plan, set[int]]:
    plan = draw(plans)
    measuring = [step.index for step in plan if step.measures]
    return plan, draw(st.sets(st.sampled_from(measuring)))


@given(plans)
def test_legs_are_all_the_steps_in_order(plan: Plan) -> None:
    assert [step for leg in legs_of(plan) for step in leg.steps] == list(plan)


@pytest.mark.thorough
@given(plans_partly_done(), st.booleans())
@settings(max_examples=200)
def test_exactly_what_is_missing_is_measured_in_the_order_of_the_plan(
    case: tuple[Plan, set[int]], cold: bool
) -> None:
    plan, done = case
    left = [step.index for step in remaining_steps(plan, done, cold=cold) if step.measures]
    missing = [step.index for step in plan if step.measures and step.index not in done]
    assert left == missing


@pytest.mark.thorough
@given(plans_partly_done(), st.booleans(), st.floats(-1.0, 1.0))
@settings(max_examples=200)
def test_every_motion_begins_where_the_last_one_ended(
    case: tuple[Plan, set[int]], cold: bool, here: float
) -> None:
    plan, done = case
    at = np.full(6, here)
    left = remaining_steps(plan, done, cold=cold)
    for step in connected_steps(left, at, straight):
        if step.motion is not None:
            assert np.allclose(step.motion.q_start, at, atol=1e-9)
            at = step.motion.q_end


@pytest.mark.thorough
@given(plans_partly_done())
def test_every_measurement_is_under_its_own_load_weighed_after_it_was_declared(
    case: tuple[Plan, set[int]],
) -> None:
    plan, done = case
    weighs = any(step.kind == "weigh" for step in plan)
    declared = weighed = -1
    for step in remaining_steps(plan, done, cold=False):
        if step.kind == "payload":
            declared = step.load
        if step.kind == "weigh":
            assert declared == step.load
            weighed = step.load
        if step.measures:
            assert declared == step.load
            assert weighed == step.load or not weighs


@given(plans_partly_done())
def test_a_dwell_is_reached_by_the_motion_the_plan_has_for_it(case: tuple[Plan, set[int]]) -> None:
    plan, done = case
    left = connected_steps(remaining_steps(plan, done, cold=False), np.zeros(6), straight)
    for before, step in itertools.pairwise(left):
        if step.kind == "dwell":
            assert before == plan.steps[step.index - 1]


@given(plans)
def test_a_cold_arm_is_warmed_up_once_before_it_measures(plan: Plan) -> None:
    first = next(step.index for step in plan if step.measures)
    left = remaining_steps(plan, {first}, cold=True)
    kinds = [step.kind for step in left]
    if any(step.measures for step in left):
        assert kinds.count("warmup") == 2
        assert kinds.index("warmup") < kinds.index("dwell")


def test_nothing_is_left_of_what_is_all_done() -> None:
    plan = sweep(3, 2)
    done = {step.index for step in plan if step.measures}
    assert remaining_steps(plan, done, cold=True) == []


@given(plans_partly_done(), st.booleans())
def test_the_first_load_is_weighed_again_when_nothing_is_known_of_it(
    case: tuple[Plan, set[int]], cold: bool
) -> None:
    plan, done = case
    left = remaining_steps(plan, done, cold=cold, weigh_first=True)
    same = remaining_steps(plan, done, cold=cold)
    if not same or same[0].load == 0:
        assert left == same
        return
    extra = left[: len(left) - len(same)]
    assert left[len(extra) :] == same
    assert {step.load for step in extra} == {0}
    kinds = ["payload", "move", "weigh"] if any(step.kind == "weigh" for step in plan) else []
    assert [step.kind for step in extra] == (kinds or ["payload"])


def test_the_first_load_is_confirmed_where_the_arm_stands_and_later_ones_at_home() -> None:
    plan = sweep(2, 2, weigh=False)
    dwells = [step.index for step in plan if step.kind == "dwell" and step.load == 0]
    left = connected_steps(
        remaining_steps(plan, set(dwells[:-1]), cold=False), np.full(6, 0.7), straight
    )
    assert left[0].kind == "payload"
    second = next(i for i, s in enumerate(left) if s.kind == "payload" and s.load == 1)
    assert left[second - 1].motion is not None
    assert left[second - 1].motion.q_end[0] == 0.0
