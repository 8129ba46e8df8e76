"""Weighing on the mock: an honest load passes on every robot, another one is found and named."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest

from hil.arms.payload import Payload
from hil.core.errors import PreflightFailed
from hil.engine import Outcome
from hil.planning.plan import Plan
from hil.spec.experiment import Weigh
from tests.support.weighing_parts import CYLINDER, OFF_AXIS, bodies, sweep, weigh

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
    assert "mount the load that is declared" in light.result.error.hint
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
    assert "against the 0.00 kg of load 0" in found.message


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
    assert "centre of mass at (0.030, 0.000, 0.050) m declared" in found.message


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
