"""Interlocks on measured quantities: tracking error, temperature, speed, current, torque."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hil.core.errors import InterlockTripped, PlanError
from hil.engine.interlocks import InterlockContext, interlocks_from_spec
from tests.support.interlock_parts import NAMES, made, rows, spec_of, with_value

CURRENT = InterlockContext(joint_names=NAMES, effort_kind="current")
GEARED = InterlockContext(
    joint_names=NAMES,
    effort_kind="current",
    drive_gains=(10.0, 10.0, 10.0, 8.0, 8.0, 8.0),
    effort_max=(150.0, 150.0, 150.0, 28.0, 28.0, 28.0),
)
TORQUE = InterlockContext(
    joint_names=NAMES, effort_kind="torque", effort_max=(150.0, 150.0, 150.0, 28.0, 28.0, 28.0)
)

CASES: list[tuple[dict[str, Any], InterlockContext, str, float, str, float]] = [
    ({"kind": "tracking_error", "limit_rad": 0.05}, CURRENT, "q", 0.05, "rad", 0.05),
    ({"kind": "temperature", "limit_c": 70}, CURRENT, "temperature", 70.0, "°C", 70.0),
    ({"kind": "speed", "limit_deg_s": 90}, CURRENT, "qd", np.pi / 2, "°/s", 90.0),
    ({"kind": "current", "limit_a": 3}, CURRENT, "effort", 3.0, "A", 3.0),
    ({"kind": "torque", "limit_nm": 20}, TORQUE, "effort", 20.0, "N·m", 20.0),
    ({"kind": "torque", "limit_nm": 20}, GEARED, "effort", 2.5, "N·m", 20.0),
    ({"kind": "torque"}, TORQUE, "effort", 26.6, "N·m", 26.6),
    ({"kind": "torque"}, GEARED, "effort", 26.6 / 8, "N·m", 26.6),
]
"""Entry, robot, field of the record, limit in the record's unit, unit and limit for people."""

IDS = [f"{case[0]['kind']}-{i}" for i, case in enumerate(CASES)]


@pytest.mark.parametrize(("entry", "context", "field", "limit", "unit", "told"), CASES, ids=IDS)
@pytest.mark.parametrize("sign", [1, -1])
def test_one_value_beyond_the_limit_trips_and_one_at_it_does_not(
    entry: Any, context: Any, field: str, limit: float, unit: str, told: float, sign: int
) -> None:
    interlock = made(context, **entry)
    assert interlock.check(with_value(field, sign * limit * (1 - 1e-9))) is None
    trip = interlock.check(with_value(field, sign * limit * (1 + 1e-6)))
    assert trip is not None
    assert (trip.interlock, trip.joint, trip.unit) == (entry["kind"], 3, unit)
    assert (trip.value, trip.limit) == (pytest.approx(told, rel=1e-5), pytest.approx(told))
    assert trip.device_time == 2 / 125


@pytest.mark.parametrize(("entry", "context", "field", "limit", "unit", "told"), CASES, ids=IDS)
def test_what_is_beyond_the_limit_trips_in_every_block(
    entry: Any, context: Any, field: str, limit: float, unit: str, told: float
) -> None:
    interlock, beyond = made(context, **entry), with_value(field, 1.1 * limit)
    assert [interlock.check(beyond) is not None for _ in range(3)] == [True] * 3
    assert interlock.check(rows()) is None


@pytest.mark.parametrize(("entry", "context", "field", "limit", "unit", "told"), CASES, ids=IDS)
def test_what_is_not_measured_trips_while_the_arm_moves_temperatures_excepted(
    entry: Any, context: Any, field: str, limit: float, unit: str, told: float
) -> None:
    interlock = made(context, **entry)
    unknown: Any = {"row": slice(None)}
    assert interlock.check(with_value(field, np.nan, **unknown)) is None
    trip = interlock.check(with_value(field, np.nan, moving=True, **unknown))
    if entry["kind"] == "temperature":
        assert trip is None
    else:
        assert trip is not None
        assert "j4 not measured" in trip.text(NAMES)


@pytest.mark.parametrize("of_a_block", [4, 1])
def test_an_arm_whose_set_point_changes_moves_whatever_its_status_says(of_a_block: int) -> None:
    interlock = made(kind="speed", limit_deg_s=90)
    block = rows(8, qd=np.nan)
    block["q_target"][5:, 1] = 1e-4
    trips = [interlock.check(block[i : i + of_a_block]) for i in range(0, 8, of_a_block)]
    (trip,) = [trip for trip in trips if trip is not None]
    assert trip.device_time == 5 / 125


def test_a_set_point_that_is_not_reported_moves_nothing() -> None:
    assert made(kind="speed", limit_deg_s=90).check(rows(qd=np.nan, q_target=np.nan)) is None


def test_the_first_violation_is_the_one_reported() -> None:
    block = with_value("q", 0.3, row=3, joint=0)
    block["q"][1, 5] = 0.2
    trip = made(kind="tracking_error", limit_rad=0.05).check(block)
    assert trip is not None
    assert (trip.joint, trip.value, trip.device_time) == (5, 0.2, 1 / 125)


def test_every_joint_may_have_a_limit_of_its_own() -> None:
    interlock = made(CURRENT, kind="current", limit_a=[5, 5, 5, 2, 2, 2])
    assert interlock.check(with_value("effort", 4.0, joint=2)) is None
    trip = interlock.check(with_value("effort", 4.0, joint=3))
    assert trip is not None
    assert (trip.joint, trip.limit) == (3, 2.0)


def test_a_limit_per_joint_needs_one_for_each() -> None:
    with pytest.raises(PlanError, match=r"interlocks\.0 \(current\): 2 limits for 6 joints"):
        made(CURRENT, kind="current", limit_a=[5, 2])


def test_the_trip_says_what_where_and_when() -> None:
    trip = made(kind="speed", limit_deg_s=90).check(with_value("qd", 2.0))
    assert trip is not None
    error = trip.error(NAMES)
    assert isinstance(error, InterlockTripped)
    assert error.message == "interlock speed: j4 at 114.6 °/s, limit 90 °/s, device time 0.016 s"


@pytest.mark.parametrize(
    ("entry", "context", "hint"),
    [
        ({"kind": "current", "limit_a": 3}, TORQUE, "use kind: torque with limit_nm"),
        ({"kind": "torque", "limit_nm": 20}, CURRENT, "use kind: current with limit_a"),
    ],
)
def test_an_effort_the_robot_does_not_measure_is_refused_with_the_right_one(
    entry: Any, context: Any, hint: str
) -> None:
    with pytest.raises(PlanError, match=hint):
        made(context, **entry)


def test_all_that_cannot_be_judged_is_refused_at_once() -> None:
    entries = [
        spec_of(kind="torque", limit_nm=20),
        spec_of(kind="temperature"),
        spec_of(kind="clearance", least_m=0.01),
        spec_of(kind="workspace", min_m=[0, 0, 0]),
    ]
    with pytest.raises(PlanError) as caught:
        interlocks_from_spec(entries, CURRENT)
    told = [line.partition(":")[0] for line in caught.value.message.splitlines()]
    assert told == ["interlocks.0 (torque)", "interlocks.2 (clearance)", "interlocks.3 (workspace)"]


def test_the_robots_own_torque_limit_is_watched_only_where_it_can_be() -> None:
    for context in (CURRENT, InterlockContext(effort_kind="torque")):
        interlocks = interlocks_from_spec([spec_of(kind="torque")], context)
        assert len(interlocks) == 0
        assert [off.name for off in interlocks.off] == ["torque"]
        assert "not known" in interlocks.off[0].why


@pytest.mark.parametrize("unknown", [np.inf, np.nan, 0.0])
@pytest.mark.parametrize("what", ["effort_max", "drive_gains"])
def test_a_joint_without_a_torque_limit_of_its_own_is_named_and_the_others_are_watched(
    what: str, unknown: float
) -> None:
    known = getattr(GEARED, what)
    interlocks = interlocks_from_spec(
        [spec_of(kind="torque")], replace(GEARED, **{what: (*known[:5], unknown)})
    )
    assert [off.name for off in interlocks.off] == ["torque"]
    assert "not known for j6" in interlocks.off[0].why
    (watching,) = interlocks
    assert interlocks.describe()[0]["limit"] == "26.6 to 142.5 N·m"
    assert watching.check(with_value("effort", 99.0, joint=5, moving=True)) is None
    trip = watching.check(with_value("effort", 99.0, joint=4))
    assert trip is not None
    assert (trip.value, trip.limit) == (pytest.approx(99 * 8), pytest.approx(26.6))


@pytest.mark.parametrize("unknown", [np.inf, np.nan, 0.0])
def test_torque_is_off_where_no_joint_has_a_limit(unknown: float) -> None:
    interlocks = interlocks_from_spec(
        [spec_of(kind="torque")], replace(TORQUE, effort_max=(unknown,) * 6)
    )
    assert len(interlocks) == 0
    assert "not known for j1, j2, j3, j4, j5, j6" in interlocks.off[0].why


def test_a_torque_limit_that_is_given_needs_the_gain_of_every_joint() -> None:
    gains = (10.0, 10.0, np.nan, 8.0, 8.0, 8.0)
    with pytest.raises(PlanError, match="drive gains are not known for j3"):
        made(replace(GEARED, drive_gains=gains), kind="torque", limit_nm=20)


@pytest.mark.parametrize("sign", [1, -1])
def test_currents_that_count_the_other_way_round_are_watched_alike(sign: int) -> None:
    context = replace(GEARED, drive_gains=tuple(-gain for gain in GEARED.drive_gains))
    for entry in ({"kind": "torque"}, {"kind": "torque", "limit_nm": 26.6}):
        interlock = made(context, **entry)
        assert interlock.check(with_value("effort", sign * 3.3)) is None
        trip = interlock.check(with_value("effort", sign * 3.4))
        assert trip is not None
        assert (trip.value, trip.limit) == (pytest.approx(27.2), pytest.approx(26.6))


@pytest.mark.parametrize(
    ("more", "still_hot", "cool"),
    [({}, 65.1, 64.9), ({"resume_below_c": 50}, 50.1, 49.9)],
)
def test_a_pause_for_temperature_ends_when_every_joint_has_cooled_down(
    more: Any, still_hot: float, cool: float
) -> None:
    interlock = made(kind="temperature", limit_c=70, action="pause", **more)
    assert interlock.action == "pause"
    assert not interlock.clear(with_value("temperature", still_hot))
    assert interlock.clear(with_value("temperature", cool))


def test_a_temperature_that_was_never_measured_keeps_no_run_paused() -> None:
    interlock = made(kind="temperature", action="pause")
    assert interlock.check(rows(temperature=np.nan, moving=True)) is None
    assert interlock.clear(rows(temperature=np.nan))


def test_a_temperature_sensor_that_dies_ends_no_pause() -> None:
    interlock = made(kind="temperature", limit_c=70, action="pause")
    assert interlock.check(rows(temperature=80.0)) is not None
    assert interlock.check(rows(temperature=np.nan)) is None, "at rest"
    assert not interlock.clear(rows(temperature=np.nan))
    assert not interlock.clear(with_value("temperature", np.nan, row=0))
    assert interlock.clear(rows(temperature=40.0))


def test_a_temperature_sensor_that_dies_trips_while_the_arm_moves() -> None:
    interlock = made(kind="temperature", limit_c=70)
    never = rows(moving=True)
    never["temperature"][:, 1] = np.nan
    assert interlock.check(never) is None, "joint 2 has no sensor"
    dies = never.copy()
    dies["temperature"][1:, 3] = np.nan
    assert [interlock.check(dies) is not None for _ in range(3)] == [True] * 3
    trip = interlock.check(dies)
    assert trip is not None
    assert "j4 was measured, is not any more, limit 70 °C" in trip.text(NAMES)
    assert interlock.check(never) is None


def test_a_temperature_may_be_late_at_the_start() -> None:
    block = with_value("temperature", np.nan, row=0, moving=True)
    assert made(kind="temperature").check(block) is None


def test_a_pause_for_temperature_ends_per_joint() -> None:
    limits = [70, 70, 70, 50, 50, 50]
    interlock = made(kind="temperature", limit_c=limits, action="pause")
    assert interlock.clear(with_value("temperature", 64.0, joint=1))
    assert not interlock.clear(with_value("temperature", 46.0, joint=4))


def test_other_quantities_are_clear_below_nine_tenths_of_their_limit() -> None:
    interlock = made(CURRENT, kind="current", limit_a=3)
    assert not interlock.clear(with_value("effort", 2.8))
    assert interlock.clear(with_value("effort", 2.6))
    assert not interlock.clear(with_value("effort", np.nan))
