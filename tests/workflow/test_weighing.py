"""Weighing of loads: on the mock, of made-up torques, and in a sweep that is resumed."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hil
from hil.arms.payload import Payload
from hil.core.errors import PreflightFailed
from hil.engine import Outcome
from hil.planning.plan import Plan, Step
from hil.planning.plan_preview import preview
from hil.recording.recorder import Recorder
from hil.recording.run_directory import RunDirectory
from hil.robot import Capabilities, Status
from hil.spec.experiment import Weigh
from hil.workflow.payload_check import all_reliable, readings_of_earlier_attempts
from hil.workflow.running import RunReport
from hil_mock_robot.embedded.robot import MockRobot
from tests.support.resuming import (
    Noted,
    Told,
    copy_of_stopped,
    measured,
    plan_of,
    plan_of_spec,
    stopped_run,
)
from tests.support.weighing_parts import CYLINDER, OFF_AXIS, Mounted, Scales, bodies, sweep, weigh

# Weighing on the mock: an honest load passes on every robot, another one is found and named


pytestmark = pytest.mark.usefixtures("plans_once")

MASSES = (0.5, 1, 2, 3, 5)


@cache
def honest_plan(*masses: float) -> Plan:
    return sweep(*bodies(0, *masses))


@cache
def cylinder() -> Plan:
    return sweep({}, CYLINDER)


@cache
def off_axis() -> Plan:
    return sweep({}, OFF_AXIS)


def require_honest(profile: str, seed: int, *masses: float) -> None:
    found = weigh(honest_plan(*masses), seed=seed, profile=profile)
    assert found.result.outcome is Outcome.COMPLETED
    assert [event["result"] for event in found.events] == ["first", *["passed"] * len(masses)]
    for event, mass in zip(found.events[1:], masses, strict=True):
        assert event["weighed_kg"] == pytest.approx(mass, abs=0.08 + 0.07 * mass)
        assert event["deviation_kg"] < 0.06 + 0.04 * mass


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("profile", "seed"), [("ideal", 1), *(("full", seed) for seed in range(1, 6))]
)
def test_honest_loads_pass(profile: str, seed: int) -> None:
    require_honest(profile, seed, 1, 5)


@pytest.mark.proof
@pytest.mark.parametrize("seed", range(1, 21))
@pytest.mark.parametrize("profile", ["full", "ideal"])
def test_honest_loads_pass_on_every_robot(profile: str, seed: int) -> None:
    require_honest(profile, seed, *MASSES)


@pytest.mark.thorough
@pytest.mark.parametrize("profile", ["full", "ideal"])
def test_one_kilogram_instead_of_three_is_found_and_named(profile: str) -> None:
    light = weigh(
        cylinder(), lambda load: replace(load, mass=load.mass / 3), seed=2, profile=profile
    )
    assert isinstance(light.result.error, PreflightFailed)
    assert light.result.outcome is Outcome.FAILED
    first, _, *joints = light.message.splitlines()
    assert first.startswith("weighing: load 1: 3.00 kg declared, ")
    assert "centre of mass" not in first
    assert [line.split(":")[0].strip() for line in joints] == list(cylinder().joint_names)
    assert "mount the declared load" in light.result.error.hint
    assert light.events[-1]["result"] == "failed"
    assert light.events[-1]["weighed_kg"] == pytest.approx(1.0, abs=0.2)


def test_nothing_is_measured_under_a_load_that_failed() -> None:
    plan = cylinder()
    found = weigh(plan, lambda load: Payload(), seed=1)
    last = plan.steps[found.result.steps_done]
    assert (last.kind, last.load) == ("weigh", 1)
    assert not any(step.measures for step in plan.steps[: last.index] if step.load == 1)


def test_a_load_left_on_while_the_bare_flange_was_weighed_is_found() -> None:
    found = weigh(cylinder(), lambda load: cylinder().loads[1].payload, seed=4)
    assert found.events[-1]["weighed_kg"] == pytest.approx(0.0, abs=0.15)
    assert found.events[-1]["result"] == "failed"
    assert "relative to the 0.00 kg of load 0" in found.message


@pytest.mark.thorough
def test_a_load_left_on_when_the_bare_flange_comes_again_is_found() -> None:
    plan = sweep({}, CYLINDER, {})
    declared: list[Payload] = []

    def forgotten(load: Payload) -> Payload:
        declared.append(load)
        return declared[1] if len(declared) == 3 else load

    found = weigh(plan, forgotten, seed=5)
    assert [event["result"] for event in found.events] == ["first", "passed", "failed"]
    assert found.message.startswith("weighing: load 2: 0.00 kg declared, ")
    assert found.events[2]["weighed_kg"] == pytest.approx(3.0, abs=0.3)
    assert 0.05 < found.events[2]["deviation_kg"] < 0.2


@pytest.mark.thorough
@pytest.mark.parametrize("profile", ["full", "ideal"])
def test_a_mount_turned_by_half_a_turn_is_found_by_its_centre_of_mass(profile: str) -> None:
    x, y, z = OFF_AXIS["com_m"]
    found = weigh(off_axis(), lambda load: replace(load, com=(-x, -y, z)), seed=6, profile=profile)
    event = found.events[-1]
    assert event["result"] == "failed"
    assert event["weighed_kg"] == pytest.approx(3.0, abs=0.45)
    assert event["shift_m"][0] == pytest.approx(-2 * x, abs=0.015)
    assert "centre of mass declared at (0.030, 0.000, 0.050) m" in found.message


@pytest.mark.thorough
def test_an_honest_load_beside_the_axis_passes() -> None:
    found = weigh(off_axis(), seed=6)
    assert found.events[-1]["result"] == "passed"
    assert max(map(abs, found.events[-1]["shift_m"])) < 0.01


def test_a_shift_that_the_tolerance_allows_passes() -> None:
    found = weigh(
        cylinder(),
        lambda load: replace(load, com=(0.06, 0.0, 0.05)),
        tolerance=Weigh(tolerance_com_m=0.1),
        seed=7,
    )
    assert found.events[-1]["result"] == "passed"


def test_a_narrow_tolerance_is_no_narrower_than_the_weighing_itself() -> None:
    found = weigh(cylinder(), tolerance=Weigh(tolerance_kg=0.001, tolerance_percent=0), seed=8)
    event = found.events[-1]
    assert event["limit_kg"] == pytest.approx(4 * event["deviation_kg"], abs=1e-3)
    assert event["result"] == "passed"


def test_a_waived_weighing_is_recorded_and_the_run_goes_on() -> None:
    found = weigh(cylinder(), lambda load: Payload(), seed=9, waived=True)
    assert found.result.outcome is Outcome.COMPLETED
    assert found.events[-1]["result"] == "waived"
    assert "3.00 kg declared" in found.events[-1]["problem"]


# What a weighing makes of the dwells it is handed, one by one; no robot, made-up torques


GAINS = (10.0, 12.0, 9.0, 8.0, 8.5, 7.5)


@cache
def cylinder_sweep() -> Plan:
    return sweep({}, CYLINDER)


def light(load: Payload) -> Payload:
    return replace(load, mass=load.mass / 3)


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "gains"), [("torque", ()), ("current", GAINS)])
def test_torques_and_currents_are_weighed_alike(kind: str, gains: tuple[float, ...]) -> None:
    scales = Scales(cylinder_sweep(), effort_kind=kind, gains=gains)
    scales.weigh()
    assert scales.events[-1]["weighed_kg"] == pytest.approx(3.0, abs=1e-3)
    assert scales.events[-1]["shift_m"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)


def test_friction_of_either_approach_cancels_and_makes_the_result_less_certain() -> None:
    smooth, stiff = (
        Scales(cylinder_sweep(), friction_nm=0.1),
        Scales(cylinder_sweep(), friction_nm=8.0),
    )
    smooth.weigh()
    stiff.weigh()
    assert stiff.events[-1]["weighed_kg"] == pytest.approx(3.0, abs=1e-3)
    assert stiff.events[-1]["deviation_kg"] > 1.5 * smooth.events[-1]["deviation_kg"]
    assert stiff.events[0]["half_difference_nm"][0] == pytest.approx([8.0] * 6)


def test_the_message_says_what_was_declared_and_weighed_joint_by_joint() -> None:
    scales = Scales(cylinder_sweep(), light)
    with pytest.raises(PreflightFailed) as failed:
        scales.weigh()
    told = failed.value.message.splitlines()
    assert told[0].startswith("weighing: load 1: 3.00 kg declared, 1.00 ± 0.")
    model, step = scales.model, scales.steps(1)[0]
    assert step.motion is not None
    q = step.motion.q_end[None]
    shoulder = (model.with_payload(scales.plan.loads[1].payload).gravity(q) - model.gravity(q))[0]
    assert told[1].strip() == "additional torque of the load, pose by pose [N·m]:"
    assert f"shoulder_lift_joint: {shoulder[1]:.1f}, " in told[3]
    assert f"declared, {shoulder[1] / 3:.1f}, " in told[3]
    assert "--waive" in failed.value.hint


def test_a_load_is_compared_with_the_first_one_of_an_earlier_attempt() -> None:
    scales, resumed = Scales(cylinder_sweep()), Scales(cylinder_sweep())
    scales.weigh()
    resumed.weighing.restore(resumed.earlier())
    resumed.weigh(1)
    assert resumed.events == [scales.events[-1]]


def test_a_first_load_that_was_not_recorded_leaves_nothing_to_compare_with() -> None:
    scales = Scales(cylinder_sweep())
    scales.weighing.restore(dict.fromkeys(scales.earlier(), "nothing was recorded"))
    with pytest.raises(
        PreflightFailed, match=r"readings of the first load are missing: .*nothing was recorded"
    ):
        scales.weigh(1)


def test_a_load_that_is_weighed_again_is_judged_again() -> None:
    scales = Scales(cylinder_sweep(), light)
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
    scales = Scales(cylinder_sweep())
    scales.weigh(0)
    *steps, last = scales.steps(1)
    for step in steps:
        scales.weighing.measured(step, scales.settled(step))
    rows = scales.settled(last)
    rows[field] = value
    with pytest.raises(PreflightFailed, match=f"payload-check pose 2 from above, .*{told}"):
        scales.weighing.measured(last, rows)


def test_other_dwells_are_no_business_of_the_weighing() -> None:
    scales = Scales(cylinder_sweep())
    dwell = next(step for step in cylinder_sweep() if step.kind == "dwell")
    scales.weighing.measured(dwell, scales.rows(dwell))
    assert scales.events == []


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("loads", "changes", "kind", "reason"),
    [
        (bodies(0, 3), {}, "current", "drive gains are unknown"),
        (bodies(3, 0), {}, "torque", "is not the lightest"),
        (bodies(0, 3), {"weigh": False}, "torque", "disables the payload check"),
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
    return load if load.mass else cylinder_sweep().loads[1].payload


def test_a_first_load_that_is_weighed_again_is_compared_with_itself() -> None:
    scales = Scales(cylinder_sweep())
    scales.weighing.restore(scales.earlier())
    scales.weigh()
    assert [event["result"] for event in scales.events] == ["passed", "passed"]
    assert scales.events[0]["declared_kg"] == 0.0
    assert scales.events[0]["weighed_kg"] == pytest.approx(0.0, abs=1e-3)
    # The nearest other load is the one that may have been left on.
    assert scales.events[0]["differs_kg"] == 3.0


def test_a_load_left_on_where_the_first_one_is_weighed_again_is_found() -> None:
    scales = Scales(cylinder_sweep(), cylinder_left_on)
    scales.weighing.restore(Scales(cylinder_sweep()).earlier())
    with pytest.raises(PreflightFailed) as failed:
        scales.weigh(0)
    told = failed.value.message
    assert told.startswith("weighing: load 0: 0.00 kg declared, 3.0")
    assert "relative to the 0.00 kg of load 0 in an earlier attempt (limit" in told
    assert "mount load 0 as in the earlier attempt" in failed.value.hint
    assert '--waive "weighing=REASON"' in failed.value.hint
    assert scales.events[-1]["result"] == "failed"


def test_a_load_left_on_where_the_first_one_is_weighed_again_can_be_waived() -> None:
    scales = Scales(cylinder_sweep(), cylinder_left_on, waived=True)
    scales.weighing.restore(Scales(cylinder_sweep()).earlier())
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
    scales = Scales(cylinder_sweep(), cylinder_left_on)
    readings = scales.earlier()
    readings[min(readings)] = "the recording is incomplete"
    scales.weighing.restore(readings)
    scales.weigh(0)
    (event,) = scales.events
    assert event["result"] == "inconclusive"
    assert event["problem"].startswith("load 0: the weighing of an earlier attempt cannot be read ")
    assert "at payload-check pose 1 from below, the recording is incomplete" in event["problem"]


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
    assert event["problem"].endswith("cannot distinguish loads that differ by 0.10 kg")


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
    cylinder_sweep = sweep(CYLINDER, further)
    (event,) = Scales(cylinder_sweep).events
    assert event["result"] == "skipped"
    assert "all loads have the same mass" in event["reason"]
    assert any("no payload check" in warning for warning in preview(cylinder_sweep).warnings)
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


# A sweep that is resumed: is the first load the one that was measured with?


SWEEP = """
hil: 1
name: sweep
robot: ur5
excitation: {kind: dwell, waypoints: 2, approach: positive, seed: 3}
warm_up: {duration_s: 0}
reference: {every: 0}
weigh: {poses: 1}
loads: [{mass_kg: 0, prompt: "Remove everything"}, {mass_kg: 3, prompt: "Mount 3 kg"}]
"""
WAIVED = {"weighing": "the test wants it"}


@pytest.fixture
def plan(tmp_path: Path) -> Plan:
    return plan_of_spec(tmp_path, SWEEP)


def mounts(patch: pytest.MonkeyPatch, really: Callable[[Payload], Payload]) -> None:
    """Whatever is declared, `really` hangs there."""
    original = MockRobot.set_payload

    def set_payload(robot: MockRobot, payload: Payload) -> Payload:
        back = original(robot, payload)
        robot._arm.on.set_payloads(really(payload), payload)
        return back

    patch.setattr(MockRobot, "set_payload", set_payload)


def loses(patch: pytest.MonkeyPatch, step: Step, keeping: int = 0) -> None:
    """The recording has nothing of a step but its first samples."""
    put, seen = Recorder.put, 0

    def keep(recorder: Recorder, topic: str, rows: Any) -> None:
        nonlocal seen
        own = rows["segment"] == step.index
        kept = ~own | (seen + np.cumsum(own) <= keeping)
        seen += int(own.sum())
        put(recorder, topic, rows[kept])

    patch.setattr(Recorder, "put", keep)


def of_load(plan: Plan, load: int, kind: str) -> list[Step]:
    return [step for step in plan if step.kind == kind and step.load == load]


def weighings(run: Path) -> list[tuple[int, str]]:
    events = RunDirectory.open(run).events()
    return [(e["load"], e["result"]) for e in events if e["kind"] == "weighing"]


def left_on(declared: Payload) -> Payload:
    return declared if declared.mass else Payload(3.0, (0.0, 0.0, 0.05))


def resume_with_load_left_on(run: Path, **options: Any) -> RunReport:
    with pytest.MonkeyPatch.context() as patch:
        mounts(patch, left_on)
        return hil.resume(run, **options)


def earlier(run: Path) -> Any:
    directory, plan = RunDirectory.open(run), plan_of(run)
    can = Capabilities(plan.joint_names, plan.rate_hz, "torque", ())
    return readings_of_earlier_attempts(plan, directory.recordings, can)


@pytest.mark.thorough
def test_the_right_load_passes_and_the_run_is_completed(tmp_path: Path, plan: Plan) -> None:
    run = copy_of_stopped(tmp_path, of_load(plan, 0, "dwell")[1].index, SWEEP)
    told: list[dict[str, Any]] = []
    assert hil.resume(run, observers=[Noted(told)]).outcome == "completed"
    assert weighings(run) == [(0, "first"), (0, "passed"), (1, "passed")]
    assert any(str(event.get("stage")).startswith("weighing again, because") for event in told)


@pytest.mark.thorough
def test_a_load_left_on_is_found_and_taking_it_off_helps(tmp_path: Path, plan: Plan) -> None:
    run = copy_of_stopped(tmp_path, of_load(plan, 0, "dwell")[1].index, SWEEP)
    done = measured(run)
    report = resume_with_load_left_on(run)
    assert isinstance(report.error, PreflightFailed)
    assert report.error.message.startswith("weighing: load 0: 0.00 kg declared, ")
    assert measured(run) == done
    # What failed is no reference for the next attempt.
    assert hil.resume(run).outcome == "completed"
    assert weighings(run)[1:] == [(0, "failed"), (0, "passed"), (1, "passed")]


@pytest.mark.thorough
def test_a_load_left_on_can_be_waived(tmp_path: Path, plan: Plan) -> None:
    run = copy_of_stopped(tmp_path, of_load(plan, 0, "dwell")[1].index, SWEEP)
    assert resume_with_load_left_on(run, waivers=WAIVED).outcome == "completed"
    assert weighings(run)[1] == (0, "waived")


@pytest.mark.thorough
def test_a_first_load_nothing_was_measured_with_may_be_put_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plan: Plan
) -> None:
    with monkeypatch.context() as patch:
        mounts(patch, left_on)
        run = stopped_run(tmp_path, patch, of_load(plan, 0, "weigh")[-1].index + 1, SWEEP)
    assert earlier(run) == {}
    assert hil.resume(run).outcome == "completed"
    assert weighings(run) == [(0, "first"), (0, "first"), (1, "passed")]


@pytest.mark.thorough
def test_a_first_load_that_was_weighed_and_measured_is_not_mounted_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plan: Plan
) -> None:
    run = copy_of_stopped(tmp_path, of_load(plan, 1, "dwell")[1].index, SWEEP)
    assert all_reliable(earlier(run))
    told = Told(monkeypatch)
    assert hil.resume(run).outcome == "completed"
    assert told.said == ["Mount 3 kg", "3 kg"]


def run_without_its_weighing(folder: Path, patch: pytest.MonkeyPatch, plan: Plan) -> Path:
    with patch.context() as lossy:
        loses(lossy, of_load(plan, 0, "weigh")[0])
        return stopped_run(folder, lossy, of_load(plan, 1, "dwell")[1].index, SWEEP)


@pytest.mark.thorough
def test_a_first_load_whose_weighing_is_lost_is_mounted_and_weighed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plan: Plan
) -> None:
    run = run_without_its_weighing(tmp_path, monkeypatch, plan)
    done = measured(run)
    told = Told(monkeypatch)
    assert hil.resume(run).outcome == "completed"
    assert told.said == ["Remove everything", "0 kg", "Mount 3 kg", "3 kg"]
    assert weighings(run)[2:] == [(0, "inconclusive"), (1, "passed")]
    assert not done & set(json.loads((run / "resume-01.json").read_text("utf-8"))["steps"])


@pytest.mark.thorough
def test_a_first_load_weighed_for_the_others_alone_is_remembered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plan: Plan
) -> None:
    run = run_without_its_weighing(tmp_path, monkeypatch, plan)
    with monkeypatch.context() as patch:
        mounts(patch, lambda declared: Payload())
        assert isinstance(hil.resume(run).error, PreflightFailed)
    assert all_reliable(earlier(run))
    told = Told(monkeypatch)
    assert hil.resume(run).outcome == "completed"
    assert told.said == ["Mount 3 kg", "3 kg"]


@pytest.mark.thorough
def test_a_torn_weighing_that_was_measured_after_is_said_and_no_reason_to_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plan: Plan
) -> None:
    with monkeypatch.context() as lossy:
        loses(lossy, of_load(plan, 0, "weigh")[0], keeping=60)
        run = stopped_run(tmp_path, lossy, of_load(plan, 0, "dwell")[1].index, SWEEP)
    assert hil.resume(run).outcome == "completed"
    assert weighings(run) == [(0, "first"), (0, "inconclusive"), (1, "passed")]
    page = " ".join((run / "report.html").read_text("utf-8").split())
    assert "of an earlier attempt cannot be read (at payload-check pose 1 from below, the" in page
