"""What a weighing makes of the dwells it is handed, one by one; no robot, made-up torques."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import PreflightFailed
from hil.planning.plan import Plan
from hil.planning.plan_preview import preview
from hil.robot import Status
from tests.support.weighing_parts import CYLINDER, Mounted, Scales, bodies, sweep

GAINS = (10.0, 12.0, 9.0, 8.0, 8.5, 7.5)


@cache
def plan() -> Plan:
    return sweep({}, CYLINDER)


def light(load: Payload) -> Payload:
    return replace(load, mass=load.mass / 3)


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "gains"), [("torque", ()), ("current", GAINS)])
def test_torques_and_currents_are_weighed_alike(kind: str, gains: tuple[float, ...]) -> None:
    scales = Scales(plan(), effort_kind=kind, gains=gains)
    scales.weigh()
    assert scales.events[-1]["weighed_kg"] == pytest.approx(3.0, abs=1e-3)
    assert scales.events[-1]["shift_m"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)


def test_friction_of_either_approach_cancels_and_makes_the_result_less_certain() -> None:
    smooth, stiff = Scales(plan(), friction_nm=0.1), Scales(plan(), friction_nm=8.0)
    smooth.weigh()
    stiff.weigh()
    assert stiff.events[-1]["weighed_kg"] == pytest.approx(3.0, abs=1e-3)
    assert stiff.events[-1]["deviation_kg"] > 1.5 * smooth.events[-1]["deviation_kg"]
    assert stiff.events[0]["half_difference_nm"][0] == pytest.approx([8.0] * 6)


def test_the_message_says_what_was_declared_and_weighed_joint_by_joint() -> None:
    scales = Scales(plan(), light)
    with pytest.raises(PreflightFailed) as failed:
        scales.weigh()
    told = failed.value.message.splitlines()
    assert told[0].startswith("weighing: load 1: 3.00 kg declared, 1.00 ± 0.")
    model, step = scales.model, scales.steps(1)[0]
    assert step.motion is not None
    q = step.motion.q_end[None]
    shoulder = (model.with_payload(scales.plan.loads[1].payload).gravity(q) - model.gravity(q))[0]
    assert told[1].strip() == "torque it adds, pose by pose [N·m]:"
    assert f"shoulder_lift_joint: {shoulder[1]:.1f}, " in told[3]
    assert f"declared, {shoulder[1] / 3:.1f}, " in told[3]
    assert "--waive" in failed.value.hint


def test_a_load_is_compared_with_the_first_one_of_an_earlier_attempt() -> None:
    scales, resumed = Scales(plan()), Scales(plan())
    scales.weigh()
    resumed.weighing.restore(resumed.earlier())
    resumed.weigh(1)
    assert resumed.events == [scales.events[-1]]


def test_a_first_load_that_was_not_recorded_leaves_nothing_to_compare_with() -> None:
    scales = Scales(plan())
    scales.weighing.restore(dict.fromkeys(scales.earlier(), "nothing was recorded"))
    with pytest.raises(PreflightFailed, match=r"the first load is missing: .*nothing was recorded"):
        scales.weigh(1)


def test_a_load_that_is_weighed_again_is_judged_again() -> None:
    scales = Scales(plan(), light)
    with pytest.raises(PreflightFailed):
        scales.weigh()
    scales.mounted = lambda load: load
    scales.weigh(1)
    assert [event["result"] for event in scales.events] == ["first", "failed", "passed"]


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("qd", 0.01, "did not come to rest"),
        ("effort", np.nan, "no usable effort"),
        ("status", int(Status.MASKED), "no usable effort"),
    ],
)
def test_a_dwell_that_says_nothing_fails(field: str, value: float, told: str) -> None:
    scales = Scales(plan())
    scales.weigh(0)
    *steps, last = scales.steps(1)
    for step in steps:
        scales.weighing.measured(step, scales.settled(step))
    rows = scales.settled(last)
    rows[field] = value
    with pytest.raises(PreflightFailed, match=f"weighing pose 2 from above, .*{told}"):
        scales.weighing.measured(last, rows)


def test_other_dwells_are_no_business_of_the_weighing() -> None:
    scales = Scales(plan())
    dwell = next(step for step in plan() if step.kind == "dwell")
    scales.weighing.measured(dwell, scales.rows(dwell))
    assert scales.events == []


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("loads", "changes", "kind", "reason"),
    [
        (bodies(0, 3), {}, "current", "drive gains are not known"),
        (bodies(3, 0), {}, "torque", "is not the lightest"),
        (bodies(0, 3), {"weigh": False}, "torque", "switches weighing off"),
    ],
)
def test_loads_that_cannot_be_weighed_are_not_and_that_is_said(
    loads: list[dict[str, object]], changes: dict[str, object], kind: str, reason: str
) -> None:
    scales = Scales(sweep(*loads, **changes), light, effort_kind=kind)
    (event,) = scales.events
    assert event["result"] == "skipped"
    assert reason in event["reason"]
    scales.weigh()
    scales.weighing.restore({0: "nothing was recorded"})
    assert scales.events == [event]


def cylinder_left_on(load: Payload) -> Payload:
    return load if load.mass else plan().loads[1].payload


def test_a_first_load_that_is_weighed_again_is_compared_with_itself() -> None:
    scales = Scales(plan())
    scales.weighing.restore(scales.earlier())
    scales.weigh()
    assert [event["result"] for event in scales.events] == ["passed", "passed"]
    assert scales.events[0]["declared_kg"] == 0.0
    assert scales.events[0]["weighed_kg"] == pytest.approx(0.0, abs=1e-3)
    # The nearest other load is the one that may have been left on.
    assert scales.events[0]["differs_kg"] == 3.0


def test_a_load_left_on_where_the_first_one_is_weighed_again_is_found() -> None:
    scales = Scales(plan(), cylinder_left_on)
    scales.weighing.restore(Scales(plan()).earlier())
    with pytest.raises(PreflightFailed) as failed:
        scales.weigh(0)
    told = failed.value.message
    assert told.startswith("weighing: load 0: 0.00 kg declared, 3.0")
    assert "against the 0.00 kg of load 0 in an earlier attempt (limit" in told
    assert "mount load 0 as it was" in failed.value.hint
    assert '--waive "weighing=REASON"' in failed.value.hint
    assert scales.events[-1]["result"] == "failed"


def test_a_load_left_on_where_the_first_one_is_weighed_again_can_be_waived() -> None:
    scales = Scales(plan(), cylinder_left_on, waived=True)
    scales.weighing.restore(Scales(plan()).earlier())
    scales.weigh(0)
    (event,) = scales.events
    assert (event["load"], event["result"]) == (0, "waived")


@pytest.mark.thorough
@pytest.mark.parametrize(("kg", "passes"), [(0.13, True), (0.3, False)])
def test_the_first_load_weighed_again_has_the_limits_of_any_other(kg: float, passes: bool) -> None:
    heavier = Scales(sweep(*bodies(1, 4)), lambda load: replace(load, mass=load.mass + kg))
    heavier.weighing.restore(Scales(heavier.plan).earlier())
    if passes:
        heavier.weigh(0)
        assert heavier.events[-1]["limit_kg"] == pytest.approx(0.15, abs=0.05)
    else:
        with pytest.raises(PreflightFailed, match=r"load 0: 1\.00 kg declared, 1\.30"):
            heavier.weigh(0)


def test_an_earlier_weighing_that_cannot_be_read_is_said_and_the_run_goes_on() -> None:
    scales = Scales(plan(), cylinder_left_on)
    readings = scales.earlier()
    readings[min(readings)] = "the recording is torn"
    scales.weighing.restore(readings)
    scales.weigh(0)
    (event,) = scales.events
    assert event["result"] == "inconclusive"
    assert event["problem"].startswith("load 0: its weighing in an earlier attempt cannot be read ")
    assert "at weighing pose 1 from below, the recording is torn" in event["problem"]


@pytest.mark.thorough
@pytest.mark.parametrize("mounted", [lambda load: load, lambda load: Payload()])
def test_a_load_that_is_too_light_to_be_told_from_none_passes_without_a_conclusion(
    mounted: Mounted,
) -> None:
    scales = Scales(sweep(*bodies(0, 0.1)), mounted)
    scales.weigh()
    event = scales.events[-1]
    assert event["result"] == "inconclusive"
    assert (event["differs_kg"], event["limit_kg"]) == (0.1, pytest.approx(0.16))
    assert event["problem"].startswith("load 1: 0.10 kg declared, ")
    assert event["problem"].endswith("does not tell loads apart that differ by 0.10 kg")


@pytest.mark.thorough
@pytest.mark.parametrize(("mass", "result"), [(0.37, "inconclusive"), (0.38, "passed")])
def test_a_limit_of_half_the_difference_to_the_first_load_is_no_conclusion(
    mass: float, result: str
) -> None:
    # 0.15 kg + 10 % of the difference: half of it at 0.375 kg.
    scales = Scales(sweep(*bodies(1, 1 + mass)), friction_nm=0.1)
    scales.weigh()
    assert scales.events[-1]["result"] == result


@pytest.mark.thorough
def test_stiff_joints_make_a_weighing_inconclusive_that_would_tell_otherwise() -> None:
    smooth, stiff = (Scales(sweep(*bodies(0, 1)), friction_nm=nm) for nm in (2.0, 40.0))
    smooth.weigh()
    stiff.weigh()
    assert [one.events[-1]["result"] for one in (smooth, stiff)] == ["passed", "inconclusive"]


@pytest.mark.thorough
def test_another_load_is_found_where_a_right_one_would_not_be_told_from_none() -> None:
    scales = Scales(sweep(*bodies(0, 0.1)), lambda load: replace(load, mass=3 * load.mass))
    with pytest.raises(PreflightFailed, match=r"0\.10 kg declared, 0\.30"):
        scales.weigh()


@pytest.mark.thorough
@pytest.mark.parametrize(("mass", "result"), [(0.1, "inconclusive"), (3, "passed")])
def test_the_bare_flange_again_must_be_told_from_the_load_that_may_still_be_on(
    mass: float, result: str
) -> None:
    scales = Scales(sweep(*bodies(0, mass, 0)))
    scales.weigh()
    assert scales.events[-1]["result"] == result
    assert scales.events[-1]["differs_kg"] == mass


@pytest.mark.thorough
def test_loads_of_one_mass_and_different_centres_are_not_weighed_and_that_is_said() -> None:
    further = CYLINDER | {"com_m": [0, 0, 0.1]}
    plan = sweep(CYLINDER, further)
    (event,) = Scales(plan).events
    assert event["result"] == "skipped"
    assert "no two loads of different mass" in event["reason"]
    assert any("no load is weighed" in warning for warning in preview(plan).warnings)
    assert Scales(sweep(CYLINDER, CYLINDER)).events == []


@pytest.mark.thorough
def test_a_single_load_is_not_worth_a_word() -> None:
    assert Scales(sweep(CYLINDER)).events == []


@pytest.mark.thorough
def test_events_are_plain_json() -> None:
    scales = Scales(sweep({}, CYLINDER, {}), friction_nm=0.0)
    scales.weigh()
    assert json.loads(json.dumps(scales.events, allow_nan=False)) == scales.events
    assert [event["declared_kg"] for event in scales.events[1:]] == [3.0, 0.0]
    assert "shift_m" not in scales.events[2]
