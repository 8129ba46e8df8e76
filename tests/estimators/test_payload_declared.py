"""Declared loads against identified ones, on arms whose gains nobody knows exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from hil.arms.payload import Payload
from hil.estimators.payload_declaration import FALSE_ALARM, Floor, check_declarations
from tests.support.load_parts import OFF_AXIS, ON_AXIS, estimates

SEEDS = range(100, 107)
"""Arms; three loads each."""


def turned(load: Payload, degrees: float) -> Payload:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    x, y, z = load.com
    return replace(load, com=(float(c * x - s * y), float(s * x + c * y), z))


def shifted(load: Payload, axis: int, by: float) -> Payload:
    com = list(load.com)
    com[axis] += by
    return replace(load, com=tuple(com))


def heavier(load: Payload, by: float) -> Payload:
    return replace(load, mass=load.mass + by)


def kinds(seed: int, wrong: int, mistake: Callable[[Payload], Payload]) -> list[list[str]]:
    """What is found about each load of an arm where one of them is declared wrongly."""
    declared = list(OFF_AXIS)
    declared[wrong] = mistake(declared[wrong])
    checked = check_declarations(declared, estimates(seed))
    return [[finding.kind for finding in one.findings] for one in checked]


@pytest.mark.thorough
@pytest.mark.parametrize("seed", SEEDS)
def test_correct_declarations_agree(seed: int) -> None:
    checked = check_declarations(OFF_AXIS, estimates(seed))
    assert all(one.agrees and one.trusted for one in checked)


@pytest.mark.parametrize("by", [0.3, -0.3])
@pytest.mark.parametrize("seed", SEEDS)
def test_three_kilograms_are_known_to_300_grams(seed: int, by: float) -> None:
    assert kinds(seed, 1, lambda load: heavier(load, by)) == [[], ["mass"], []]


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_a_centre_30_mm_off_is_named(axis: int, wrong: int) -> None:
    for seed in SEEDS:
        found = kinds(seed, wrong, lambda load: shifted(load, axis, 0.03))
        assert found == [["centre"] if i == wrong else [] for i in range(3)]


@pytest.mark.parametrize("degrees", [180.0, 90.0])
@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_a_turned_tool_is_named_with_its_angle(wrong: int, degrees: float) -> None:
    for seed in SEEDS:
        declared = list(OFF_AXIS)
        declared[wrong] = turned(declared[wrong], -degrees)
        found = check_declarations(declared, estimates(seed))
        assert [f.kind for one in found for f in one.findings] == ["mount"]
        told = found[wrong].findings[0].text
        angle = float(told.split("°")[0].split()[-1])
        assert abs(abs(angle) - degrees) < 15.0


@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_an_absurd_inertia_is_named(wrong: int) -> None:
    absurd = (0.9, 0.9, 0.9, 0.0, 0.0, 0.0)
    for seed in SEEDS:
        found = kinds(seed, wrong, lambda load: replace(load, inertia=absurd))
        assert found == [["inertia"] if i == wrong else [] for i in range(3)]


def test_an_inertia_that_no_body_has_is_named() -> None:
    impossible = (1e-3, 1e-3, 5e-3, 0.0, 0.0, 0.0)
    assert kinds(100, 1, lambda load: replace(load, inertia=impossible))[1] == ["no body"]


def test_an_inertia_that_nobody_declared_is_not_judged() -> None:
    assert kinds(100, 2, lambda load: replace(load, inertia=6 * (0.0,))) == [[], [], []]


def test_two_mistakes_in_one_load_are_both_named() -> None:
    found = kinds(100, 1, lambda load: heavier(turned(load, 180.0), -0.5))
    assert found == [[], ["mass", "mount"], []]


def test_a_load_that_was_forgotten_is_named_by_its_mass() -> None:
    assert kinds(100, 1, lambda _: Payload()) == [[], ["mass"], []]


def test_a_load_that_nobody_mounted_is_named_by_its_mass() -> None:
    mounted = (OFF_AXIS[0], Payload(), OFF_AXIS[2])
    checked = check_declarations(OFF_AXIS, estimates(100, mounted))
    assert [[finding.kind for finding in one.findings] for one in checked] == [[], ["mass"], []]


def test_a_wrong_load_is_trusted_by_no_other() -> None:
    declared = [OFF_AXIS[0], heavier(OFF_AXIS[1], 0.4), OFF_AXIS[2]]
    checked = check_declarations(declared, estimates(100))
    assert [one.trusted for one in checked] == [True, False, True]


def test_other_loads_tell_the_gains() -> None:
    errors = []
    for seed in SEEDS:
        alone = check_declarations(OFF_AXIS[1:2], estimates(seed)[1:2])[0]
        among = check_declarations(OFF_AXIS, estimates(seed))[1]
        assert among.limit[0] < 0.8 * alone.limit[0]
        errors.append([one.found[0] - OFF_AXIS[1].mass for one in (alone, among)])
    by_itself, by_others = np.sqrt(np.mean(np.square(errors), axis=0))
    assert by_others < 0.3 * by_itself


def test_the_angle_of_a_load_on_the_axis_cannot_be_observed() -> None:
    on = check_declarations(ON_AXIS, estimates(100, ON_AXIS))
    off = check_declarations(OFF_AXIS, estimates(100))
    assert not any(one.mount_observable for one in on)
    assert all(one.agrees for one in on)
    assert all(one.mount_observable for one in off)
    again = check_declarations([turned(load, 180.0) for load in ON_AXIS], estimates(100, ON_AXIS))
    assert all(one.agrees for one in again)


def test_few_blocks_of_time_mean_wider_limits() -> None:
    known = estimates(100)[1]
    rare = replace(known, degrees=np.full(10, 3.0))
    many = replace(known, degrees=np.full(10, 300.0))
    limits = [check_declarations(OFF_AXIS[1:2], [one])[0].limit for one in (rare, many)]
    assert np.all(limits[0] > limits[1])


def test_an_estimate_without_noise_is_still_no_surer_than_the_model() -> None:
    exact = replace(estimates(100)[1], covariance=np.zeros((10, 10)), by_gain=np.zeros((10, 6)))
    limit = check_declarations(OFF_AXIS[1:2], [exact], floor=Floor(com_m=0.004))[0].limit
    assert limit[1:4] == pytest.approx(limit[1])
    assert limit[1] == pytest.approx(0.004 * norm.isf(FALSE_ALARM / 20))
    assert limit[0] > 0.01 * 3.0 * 3.0


def test_fewer_false_alarms_mean_wider_limits() -> None:
    loose = check_declarations(OFF_AXIS, estimates(100), false_alarm=1e-4)
    tight = check_declarations(OFF_AXIS, estimates(100), false_alarm=1e-2)
    assert all(np.all(a.limit > b.limit) for a, b in zip(loose, tight, strict=True))
