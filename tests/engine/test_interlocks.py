"""Interlocks: what a spec says of them, what each watches, and what they cost."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.cli.bench import measure
from hil.core import plugins
from hil.core.errors import InterlockTripped, PlanError, SpecError
from hil.core.typing import FloatArray, StructArray
from hil.dynamics import Box, CollisionModel, Environment, Plane, RobotModel, payload_capsule
from hil.dynamics.collision import FlangeSpace
from hil.dynamics.sample_distances import SampleDistances
from hil.engine import Outcome
from hil.engine.interlocks import (
    Backlog,
    Distances,
    FreeSpace,
    HasMargin,
    Interlock,
    InterlockContext,
    LeastDistance,
    Margin,
    Trip,
    interlocks_from_spec,
)
from hil.engine.reading import SLOW_S, Judge
from hil.planning import load
from hil.planning.checks import flange_space
from hil.robot import Capabilities
from hil.spec import ExperimentSpec, load_spec, spec_from_text, spec_hash
from hil.spec.interlocks import DEFAULTS, PluggedInterlock
from hil.workflow.interlocks import RunInterlocks
from hil.workflow.preview import planned
from tests.support.engine_parts import ListSink, engine
from tests.support.in_time import InTime, measured_again
from tests.support.interlock_parts import NAMES, made, rows, spec_of, with_value
from tests.support.kinematic_robot import KinematicRobot
from tests.support.waiting import until

# What a spec may say about interlocks, and which watch when it says nothing


GOOD = """hil: 1
name: demo
robot: ur5
excitation: {kind: dwell, waypoints: 20}
"""
ALL = [
    *("tracking_error", "temperature", "torque", "clearance", "stale", "recorder", "disk"),
    "speed_scaling",
]
PLUGIN = """
import numpy as np
from hil.engine.interlocks import Trip


class Humid:
    name = "humidity"

    def __init__(self, context, *, action, limit_percent, sensor="hall"):
        self.action, self.limit, self.joints = action, limit_percent, context.joint_names
        self.watches = f"{limit_percent:g} %"
        self.seen = 0
        self.closed = False

    def check(self, block):
        self.seen += len(block)
        if self.seen < self.limit:
            return None
        return Trip(self.name, -1, self.seen, self.limit, "%", 0.0, "humidity of the hall")

    def clear(self, block):
        return True

    def close(self):
        self.closed = True


def half_made(context, *, action):
    return object()


def by_position(context, /, limit_percent, action):
    return Humid(context, action=action, limit_percent=limit_percent)


def by_any_position(*context, limit_percent, action):
    return Humid(*context, action=action, limit_percent=limit_percent)


def picky(context, *, action, **anything):
    raise ValueError("no sensor on port 7")
"""


@pytest.fixture
def plugged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A few plug-ins, beside those that are installed."""
    (tmp_path / "lab_interlocks.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "lab_interlocks", raising=False)
    targets = {"humidity": "Humid", "half-made": "half_made", "picky": "picky", "broken": "None_"}
    targets |= {"by-position": "by_position", "by-any-position": "by_any_position"}
    group = "hil.interlocks"
    points = [EntryPoint(name, f"lab_interlocks:{t}", group) for name, t in targets.items()]
    installed = plugins.entry_points
    monkeypatch.setattr(
        plugins, "entry_points", lambda *, group: (*installed(group=group), *_of(points, group))
    )


def _of(points: list[EntryPoint], group: str) -> list[EntryPoint]:
    return [point for point in points if point.group == group]


def with_interlocks(entries: str) -> ExperimentSpec:
    return spec_from_text(GOOD + f"interlocks: [{entries}]\n", "f")


def problem(entries: str) -> str:
    with pytest.raises(SpecError) as caught:
        with_interlocks(entries)
    return "\n".join(line.partition(": ")[2] for line in caught.value.message.splitlines())


def test_without_a_word_the_defaults_watch() -> None:
    assert [interlock.kind for interlock in spec_from_text(GOOD).interlocks] == ALL


def test_what_is_listed_replaces_the_default_of_its_kind_and_of_no_other() -> None:
    spec = with_interlocks("{kind: temperature, limit_c: 60}, {kind: speed, limit_deg_s: 90}")
    kinds = [interlock.kind for interlock in spec.interlocks]
    assert kinds[:2] == ["temperature", "speed"]
    assert sorted(kinds) == sorted([*ALL, "speed"])
    assert spec.interlocks[0].limit_c == 60  # type: ignore[union-attr]


def test_one_kind_may_pause_first_and_stop_later() -> None:
    spec = with_interlocks(
        "{kind: temperature, limit_c: 60, action: pause}, {kind: temperature, limit_c: 70}"
    )
    heat = [i for i in interlocks_from_spec(spec.interlocks) if i.name == "temperature"]
    assert [interlock.action for interlock in heat] == ["pause", "stop"]


def test_a_default_is_switched_off_by_its_name_only() -> None:
    spec = with_interlocks("{kind: disk, enabled: false}, {kind: torque, enabled: false}")
    made = interlocks_from_spec(spec.interlocks, InterlockContext(folder=Path))
    assert not {"disk", "torque"} & {interlock.name for interlock in made}
    assert {(off.name, off.why) for off in made.off} >= {("disk", "switched off in the spec")}


def test_stale_data_cannot_be_switched_off_and_its_time_reaches_the_engine() -> None:
    assert "cannot be disabled" in problem("{kind: stale, enabled: false}")
    assert (
        interlocks_from_spec(
            with_interlocks("{kind: stale, after_s: 0.2}").interlocks
        ).stale_after_s
        == 0.2
    )
    assert interlocks_from_spec(spec_from_text(GOOD).interlocks).stale_after_s == 0.5
    assert interlocks_from_spec([]).stale_after_s == 0.5


def test_written_out_defaults_and_another_order_are_the_same_spec() -> None:
    plain = spec_hash(spec_from_text(GOOD))
    assert spec_hash(with_interlocks("{kind: disk}, {kind: tracking_error}")) == plain
    assert spec_hash(with_interlocks("")) == plain
    assert spec_hash(with_interlocks("{kind: disk, free_mb: 501}")) != plain


def test_a_spec_survives_being_written_and_read_again() -> None:
    spec = with_interlocks("{kind: current, limit_a: [1, 2, 3, 4, 5, 6]}, {kind: stale}")
    again = ExperimentSpec.model_validate(spec.model_dump(mode="json", by_alias=True))
    assert again == spec


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        (
            "{kind: clearance, action: pause}",
            "interlocks.0.action: must be stop, not 'pause'",
        ),
        (
            "{kind: disk, action: warn}",
            "interlocks.0.action: must be one of stop, pause, not 'warn'",
        ),
        (
            "{kind: disk, enabled: no}",
            "interlocks.0.enabled: must be true or false, not 'no'",
        ),
        (
            "{kind: tracking_error, limit_rad: [0.1, 2]}",
            "interlocks.0.limit_rad.1: must be at most 1 rad, not 2",
        ),
        (
            "{kind: current, limit_a: []}",
            "interlocks.0.limit_a: must not be empty: at least 1 required",
        ),
        (
            "{kind: current, limit_ma: 500}",
            "interlocks.0.limit_ma: unknown key; quantities carry their unit in the key: "
            "use limit_a: 0.5",
        ),
        (
            "{kind: disk, free_gb: 1}",
            "interlocks.0.free_gb: unknown key; quantities carry their unit in the key: "
            "use free_mb: 1000",
        ),
        (
            "{kind: temperature, action: pause, resume_below_c: 80}",
            "interlocks.0.resume_below_c: must be below limit_c (75 °C)",
        ),
        (
            "{kind: temperature, resume_below_c: 50}",
            "interlocks.0.resume_below_c: requires action: pause",
        ),
        (
            "{kind: workspace}",
            "interlocks.0: has no limit: give min_m, max_m or planes",
        ),
        (
            "{kind: workspace, min_m: [0, 0, 0.5], max_m: [1, 1, 0.4]}",
            "interlocks.0.max_m.2: must be above min_m (0.5 m)",
        ),
        (
            "{kind: speed, limit_deg_s: [90, 90, 90, 50, 90, 90]}",
            "interlocks.0.limit_deg_s: must be above "
            "excitation.max_velocity_deg_s (60 °/s): reduce that limit, or increase this one, at "
            "most to the limit of the arm",
        ),
    ],
)
def test_a_wrong_entry_is_explained(entry: str, told: str) -> None:
    assert problem(entry) == told


def test_a_plug_in_is_found_by_its_kind_and_gets_its_own_keys(plugged: None) -> None:
    spec = with_interlocks("{kind: humidity, limit_percent: 70, action: pause}")
    (entry,) = (i for i in spec.interlocks if isinstance(i, PluggedInterlock))
    assert entry.parameters == {"limit_percent": 70}
    (made,) = interlocks_from_spec([entry], InterlockContext(joint_names=NAMES))
    assert (made.name, made.action) == ("humidity", "pause")
    assert (made.limit, made.joints) == (70, NAMES)  # type: ignore[attr-defined]


def test_a_plug_in_stops_a_run_in_its_own_words(plugged: None) -> None:
    interlocks = interlocks_from_spec([spec_of(kind="humidity", limit_percent=100)])
    robot = KinematicRobot()
    result = engine(robot, ListSink(), interlocks=interlocks).run()
    assert result.outcome is Outcome.TRIPPED
    assert result.reason.startswith("interlock humidity: humidity of the hall at 1")
    assert "stop" in robot.calls


def test_plug_ins_are_described_and_closed_with_the_others(plugged: None) -> None:
    interlocks = interlocks_from_spec([spec_of(kind="humidity", limit_percent=70)])
    assert interlocks.describe()[0] == {"name": "humidity", "action": "stop", "limit": "70 %"}
    interlocks.close()
    assert interlocks[0].closed  # type: ignore[attr-defined]


def test_a_plug_in_has_a_line_in_the_list_of_plug_ins(plugged: None) -> None:
    found = {info.name: info for info in plugins.describe_all() if info.group == "hil.interlocks"}
    assert found["humidity"].error == ""
    assert "does not load" in found["broken"].error


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ("{kind: humidty}", "interlocks.0.kind: there is no kind 'humidty'; did you mean 'humid"),
        ("{kind: temprature}", "interlocks.0.kind: there is no kind 'temprature'; did you mean"),
        (
            "{kind: humidity, limit_percnt: 70}",
            "interlocks.0.limit_percnt: humidity has no parameter 'limit_percnt'; did you mean "
            "'limit_percent'? (it has limit_percent, sensor)",
        ),
        ("{kind: humidity}", "interlocks.0.kind: humidity needs limit_percent"),
        ("{kind: humidity, limit_percent: 70, action: warn}", "interlocks.0.action: "),
        ("{kind: broken}", "interlocks.0.kind: the interlock 'broken' (lab_interlocks:None_) does"),
    ],
)  # fmt: skip
def test_a_wrong_plug_in_is_found_with_the_spec(plugged: None, entry: str, told: str) -> None:
    assert problem(entry).startswith(told)


@pytest.mark.parametrize("kind", ["by-position", "by-any-position"])
def test_the_context_of_a_plug_in_is_given_by_position(plugged: None, kind: str) -> None:
    spec = with_interlocks(f"{{kind: {kind}, limit_percent: 70}}").interlocks[0]
    assert [one.watches for one in interlocks_from_spec([spec])] == ["70 %"]
    assert problem(f"{{kind: {kind}}}").endswith(f"{kind} needs limit_percent")


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ({"kind": "humidity"}, "TypeError: .*limit_percent"),
        ({"kind": "picky"}, "ValueError: no sensor on port 7"),
        (
            {"kind": "half-made"},
            "its plug-in is not an interlock: it lacks name, action, check, clear",
        ),
        ({"kind": "wishful"}, "unknown interlock kind 'wishful'"),
    ],
)
def test_a_plug_in_that_cannot_watch_is_refused(
    plugged: None, entry: dict[str, Any], told: str
) -> None:
    with pytest.raises(PlanError, match=told):
        interlocks_from_spec([spec_of(**entry)])


def test_the_spec_of_a_run_is_readable_where_its_plug_in_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "spec.yaml"
    path.write_text(GOOD + "interlocks: [{kind: humidity, limit_percent: 70}]\n")
    assert load_spec(path, look_up=False).interlocks[0].kind == "humidity"
    with pytest.raises(SpecError, match="there is no kind 'humidity'"):
        load_spec(path)


def test_the_default_set_lets_a_quiet_robot_be() -> None:
    interlocks = interlocks_from_spec(DEFAULTS, InterlockContext(joint_names=NAMES, folder=Path))
    block = rows(8)
    assert all(interlock.check(block) is None for interlock in interlocks)
    interlocks.close()


def test_a_hot_joint_pauses_a_run_that_goes_on_when_it_is_cool() -> None:
    def warms_up_and_cools_down(block: StructArray) -> None:
        hot = (block["device_time"] > 1.0) & (block["device_time"] < 4.0)
        block["temperature"] = np.where(hot, 72.0, 40.0)[:, None]

    sink = ListSink()
    heat = interlocks_from_spec([spec_of(kind="temperature", limit_c=70, action="pause")])
    result = engine(KinematicRobot(warms_up_and_cools_down), sink, interlocks=heat).run()
    assert result.outcome is Outcome.COMPLETED
    assert [e["kind"] for e in sink.events].count("resumed") == 1


# Interlocks on measured quantities: tracking error, temperature, speed, current, torque


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
        assert "j4 is not measured" in trip.text(NAMES)


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
    assert "j4 is no longer measured, limit 70 °C" in trip.text(NAMES)
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


# Clearance and workspace: few samples are computed, every one is judged


LOAD = Payload(3.0, (0.0, 0.0, 0.05))
AROUND = Environment(
    table_z=0.0,
    walls=(Plane((0.7, 0.0, 0.0), (-1.0, -0.3, 0.0), "window"),),
    boxes=(Box((0.0, -0.6, 0.2), (0.3, 0.2, 0.4), "rack"),),
)
HOME = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])
MIN_M, MAX_M = (-0.5, -0.6, 0.1), (0.6, 0.5, 1.0)


@cache
def bodies(arm: str = "ur5") -> CollisionModel:
    description = load_arm(arm)
    return CollisionModel(description, AROUND, payload_capsule(LOAD, description.n_joints))


@cache
def space(tip_m: float = 0.1) -> FlangeSpace:
    low = [Plane(MIN_M, tuple(np.eye(3)[i]), f"{'xyz'[i]} of min_m") for i in range(3)]
    high = [Plane(MAX_M, tuple(-np.eye(3)[i]), f"{'xyz'[i]} of max_m") for i in range(3)]
    return FlangeSpace(load_arm("ur5"), [*low, *high], tip_m)


def wander(seed: int, count: int, step_rad: float) -> FloatArray:
    """(count, 6) a smooth random path through the joint space, in and out of everything."""
    random = np.random.default_rng(seed)
    speed = np.cumsum(random.normal(0.0, 0.2, (count, 6)), axis=0)
    speed *= step_rad / np.abs(speed).mean()
    return np.asarray(HOME + np.cumsum(speed, axis=0))


def first_trip(interlock: LeastDistance, block: StructArray, length: int) -> Trip | None:
    parts = (block[i : i + length] for i in range(0, len(block), length))
    return next((trip for part in parts if (trip := interlock.check(part))), None)


def random_positions(count: int, seed: int = 0) -> FloatArray:
    arm = load_arm("ur5")
    return np.random.default_rng(seed).uniform(arm.excite_min, arm.excite_max, (count, 6))


@pytest.mark.thorough
@pytest.mark.parametrize("length", [1, 7, 400])
@pytest.mark.parametrize("step_rad", [0.001, 0.02])
@pytest.mark.parametrize("measured", ["clearance", "workspace"])
def test_it_trips_at_the_very_sample_at_which_a_loop_over_all_finds_too_little(
    length: int, step_rad: float, measured: str
) -> None:
    slow = bodies() if measured == "clearance" else space()
    fast = SampleDistances(bodies()) if measured == "clearance" else slow
    tripped = 0
    for seed in range(6):
        q = wander(seed, 400, step_rad)
        brute = slow.distances(q).min(axis=0)
        # From below the least distance of the start to above it: some paths trip, some do not.
        for least in (0.2 * brute[0], 0.9 * brute[0], 0.5 * (brute.min() + brute[0])):
            interlock = LeastDistance(measured, fast, least)
            trip = first_trip(interlock, rows(400, q=q), length)
            bad = np.flatnonzero(brute < least - 1e-5)
            if trip is None:
                assert len(bad) == 0
                assert interlock.computed < 400
            else:
                tripped += 1
                at = round(trip.device_time * 125)
                assert brute[at] < least + 1e-5
                assert (brute[:at] >= least - 1e-5).all()
                assert trip.value == pytest.approx(1e3 * brute[at], abs=0.01) or brute[at] < 0
    assert tripped > 5


class Lever:
    """Distances that use their reach up to the last bit: 1 m, less what two joints turn."""

    names = (("lever", "stop"), ("lever", "wall"))
    reach = np.array([[0.5, 0, 0, 0, 0, 0], [0.2, 0.4, 0, 0, 0, 0]])

    def distances(self, q: FloatArray) -> FloatArray:
        return np.asarray(1.0 - self.reach @ q.T)

    def copy_for_thread(self) -> Lever:
        return self


@pytest.mark.parametrize(("joint", "trips_at"), [(0, 1.8), (1, 2.25), (2, np.inf)])
@pytest.mark.parametrize("step", [0.011, 0.13, 0.7])
def test_nothing_is_skipped_where_motion_really_uses_up_what_was_to_spare(
    joint: int, trips_at: float, step: float
) -> None:
    q = np.zeros((300, 6))
    q[:, joint] = step * np.arange(300)
    trip = first_trip(LeastDistance("lever", Lever(), 0.1), rows(300, q=q), 5)
    beyond = np.flatnonzero(q[:, joint] > trips_at + 1e-9)
    assert (None if trip is None else round(trip.device_time * 125)) == (
        int(beyond[0]) if len(beyond) else None
    )


@pytest.mark.parametrize("measured", [bodies(), space()], ids=["clearance", "workspace"])
def test_no_distance_changes_by_more_than_its_reach_allows(
    measured: CollisionModel | FlangeSpace,
) -> None:
    random = np.random.default_rng(3)
    a = random_positions(3000)
    sizes = 10.0 ** random.uniform(-4, 0, (3000, 1))
    b = a + sizes * random.normal(size=a.shape) * (random.random(a.shape) < 0.5)
    change = np.abs(measured.distances(b) - measured.distances(a))
    allowed = measured.reach @ np.abs(b - a).T
    assert (change <= allowed + 2e-6).all()
    # Not by an empty margin either: somewhere the bound is nearly used up.
    assert (change[allowed > 1e-3] / allowed[allowed > 1e-3]).max() > 0.9


def test_a_slow_program_needs_few_samples_computed() -> None:
    q = HOME + np.linspace(0.0, 1.0, 2000)[:, None] * np.array([0.8, 0.2, -0.2, 0.0, 0.0, 0.5])
    interlock = LeastDistance("clearance", SampleDistances(bodies()), 0.01)
    assert first_trip(interlock, rows(2000, q=q), 1) is None
    assert interlock.computed < 200


def test_an_arm_that_stands_needs_one_sample_computed() -> None:
    interlock = LeastDistance("clearance", SampleDistances(bodies()), 0.01)
    assert first_trip(interlock, rows(500, q=HOME), 1) is None
    assert interlock.computed == 1


@pytest.mark.parametrize("name", ["ur5", "ur10e", "lab6"])
def test_coal_and_numpy_agree_on_every_distance(name: str) -> None:
    arm = load_arm(name)
    q = np.random.default_rng(1).uniform(arm.excite_min, arm.excite_max, (300, arm.n_joints))
    ours, theirs = bodies(name).distances(q), SampleDistances(bodies(name)).distances(q)
    apart = ours > 1e-3
    np.testing.assert_allclose(theirs[apart], ours[apart], atol=1e-5)
    assert (theirs[~apart] < 1e-3 + 1e-5).all()


def test_the_trip_names_the_two_that_are_too_close() -> None:
    q = HOME.copy()
    q[1] = np.radians(-30.0)  # the upper arm down towards the table
    trip = LeastDistance("clearance", SampleDistances(bodies()), 0.01).check(rows(1, q=q))
    assert trip is not None
    assert "payload and table" in trip.text(NAMES)
    assert "at least 10 mm" in trip.text(NAMES)
    assert trip.joint == -1


def test_the_flange_is_where_pinocchio_says() -> None:
    q = random_positions(200, seed=5)
    poses = RobotModel.from_arm("ur5").flange_pose(q)
    flange, tip = poses[:, :3, 3], poses[:, :3, 3] + 0.1 * poses[:, :3, 2]
    found = dict(zip(space().names, space().distances(q), strict=True))
    for axis in range(3):
        for point, at in (("flange", flange), ("payload", tip)):
            low = found[point, f"{'xyz'[axis]} of min_m"]
            high = found[point, f"{'xyz'[axis]} of max_m"]
            np.testing.assert_allclose(low, at[:, axis] - MIN_M[axis], atol=1e-9)
            np.testing.assert_allclose(high, MAX_M[axis] - at[:, axis], atol=1e-9)


def workspace() -> InterlockContext:
    flange = partial(flange_space, load_arm("ur5"), sizes=[None, (0.1, 0.03)])
    return InterlockContext(joint_names=NAMES, flange=flange)


@pytest.mark.parametrize(
    ("entry", "beyond"),
    [
        ({"min_m": [0.0, -2.0, -2.0]}, "payload and x of min_m"),
        ({"max_m": [2.0, 2.0, 0.7]}, "flange and z of max_m"),
        (
            {"planes": [{"name": "door", "point_m": [0, 0, 0.5], "normal": [0, 0, -2]}]},
            "flange and door",
        ),
    ],
)
def test_a_flange_or_payload_outside_the_workspace_trips(entry: Any, beyond: str) -> None:
    inside = made(workspace(), kind="workspace", min_m=[-2, -2, -2], max_m=[2, 2, 2])
    assert inside.check(rows(q=HOME)) is None
    # Stretched straight up, the tool axis level: the flange is 1 m high, the tip reaches to −y.
    up = np.radians([-90.0, -90.0, 0.0, -90.0, 0.0, 0.0])
    trip = made(workspace(), kind="workspace", **entry).check(rows(q=up))
    assert trip is not None
    assert beyond in trip.text(NAMES)


def test_positions_that_are_not_measured_trip_while_the_arm_moves() -> None:
    interlock = LeastDistance("clearance", SampleDistances(bodies()), 0.01)
    block = rows(q=HOME)
    block["q"][1, 2] = np.nan
    assert interlock.check(block) is None
    block["status"] = 1
    trip = interlock.check(block)
    assert trip is not None
    assert "j3 is not measured" in trip.text(NAMES)
    block["q"][1, 2] = np.inf
    assert interlock.check(block) is not None
    # What is measured again is judged again.
    assert interlock.check(rows(q=HOME, moving=True)) is None


def test_positions_that_are_not_measured_trip_where_the_set_point_changes() -> None:
    interlock = LeastDistance("clearance", SampleDistances(bodies()), 0.01)
    block = rows(q=HOME, q_target=HOME)
    assert interlock.check(block) is None
    block["q"][:, 2] = np.nan
    assert interlock.check(block) is None
    assert interlock.check(rows(q=np.nan, q_target=HOME + 1e-4)) is not None


def test_it_is_clear_again_some_way_beyond_the_least_distance() -> None:
    least = float(bodies().clearance(HOME[None])[0])
    assert LeastDistance("c", bodies(), least - 0.001).check(rows(q=HOME)) is None
    assert not LeastDistance("c", bodies(), least - 0.001).clear(rows(q=HOME))
    assert LeastDistance("c", bodies(), least - 0.01).clear(rows(q=HOME))


def test_half_of_what_the_plan_keeps_is_the_default() -> None:
    context = InterlockContext(clearance=SampleDistances(bodies()), clearance_m=0.02)
    assert made(context, kind="clearance").watches == "10 mm"  # type: ignore[attr-defined]
    assert made(context, kind="clearance", least_m=0.004).watches == "4 mm"  # type: ignore[attr-defined]


# How far interlocks say they are from tripping: what people are shown, at the limit itself 0


def margin_of(interlock: Interlock | LeastDistance, block: StructArray) -> Margin | None:
    assert isinstance(interlock, HasMargin)
    return interlock.margin(block)


def test_the_joint_nearest_to_its_own_limit_counts() -> None:
    interlock = made(kind="current", limit_a=[10, 10, 10, 2, 2, 2])
    block = with_value("effort", 1.5, row=3, joint=4)
    block["effort"][3, 0] = 5.0
    found = margin_of(interlock, block)
    assert found == Margin(1.5, 2.0, "A", 0.25, joint=4)


def test_only_the_last_row_counts() -> None:
    found = margin_of(made(kind="current", limit_a=10), with_value("effort", 9.0, row=2))
    assert found is not None
    assert found.share == 1.0


@pytest.mark.parametrize(("share", "trips"), [(1e-6, False), (0.0, True)])
def test_no_margin_is_left_where_it_trips(share: float, trips: bool) -> None:
    interlock = made(kind="speed", limit_deg_s=90)
    block = with_value("qd", np.pi / 2 * (1 - share + (1e-9 if trips else 0)), row=3)
    found = margin_of(interlock, block)
    assert found is not None
    assert found.share == pytest.approx(share, abs=1e-9)
    assert (interlock.check(block) is not None) is trips


def test_what_nobody_measures_has_no_margin() -> None:
    block = rows(temperature=np.nan)
    assert margin_of(made(kind="temperature", limit_c=60), block) is None
    lever = LeastDistance("lever", Lever(), 0.1)
    assert margin_of(lever, rows(q=np.nan)) is None


def test_an_infinite_limit_is_none() -> None:
    context = InterlockContext(
        joint_names=NAMES, effort_kind="torque", effort_max=(np.inf,) * 5 + (10.0,)
    )
    found = margin_of(made(context, kind="torque"), with_value("effort", 5.0, 3, 5))
    assert found is not None
    assert (found.joint, found.limit) == (5, pytest.approx(9.5))
    still = margin_of(made(context, kind="torque"), rows())
    assert still is not None, "standing still, a joint without a limit hides those that have one"
    assert (still.joint, still.share) == (5, 1.0)


def test_the_nearest_pair_counts() -> None:
    q = np.zeros((4, 6))
    q[-1, 0] = 1.7
    found = margin_of(LeastDistance("lever", Lever(), 0.1), rows(q=q))
    assert found is not None
    assert (found.subject, found.least) == ("lever and stop", True)
    assert (found.value, found.limit, found.share) == pytest.approx((150, 100, 0.5))


@pytest.mark.parametrize("measured", [bodies(), space()], ids=["clearance", "workspace"])
def test_looking_disturbs_no_judgement(measured: Distances) -> None:
    """It happens on another thread, at any time: nothing that judging keeps may change."""
    looked, alone = (LeastDistance("x", measured, -1.0) for _ in range(2))
    rng = np.random.default_rng(5)
    for _ in range(20):
        block = rows(4, q=rng.uniform(-2, 2, (4, 6)))
        margin_of(looked, rows(4, q=rng.uniform(-2, 2, (4, 6))))
        assert looked.check(block) == alone.check(block)
        assert looked.computed == alone.computed


def test_backlog_and_disk() -> None:
    backlog: Any = Backlog(lambda: 0.5, 2.0).margin(rows())
    assert (backlog.value, backlog.share) == (0.5, 0.75)
    disk = FreeSpace(Path, 500, free=lambda folder: 2_000_000_000)
    assert disk.margin(rows()) is None  # nobody has looked yet
    disk.check(rows())
    found: Any = disk.margin(rows())
    disk.close()
    assert (found.value, found.share) == (2000.0, 0.75)


# Interlocks on the recording: a recorder that falls behind, a disk that fills up or hangs


BLOCK = rows()
HERE = Path
MB = 1_000_000


class Clock:
    def __init__(self) -> None:
        self.time = 100.0

    def __call__(self) -> float:
        return self.time


@pytest.fixture
def disk() -> Iterator[Callable[..., FreeSpace]]:
    """Makes disk interlocks that look every 5 ms, and ends them."""
    made: list[FreeSpace] = []

    def make(free: Callable[[Path], int], **more: Any) -> FreeSpace:
        made.append(FreeSpace(HERE, 500.0, free=free, poll_s=0.005, **more))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_a_recorder_that_falls_behind_trips_and_is_clear_when_it_has_caught_up() -> None:
    behind = [0.1]
    interlock = Backlog(lambda: behind[0], 2.0, action="pause")
    assert interlock.check(BLOCK) is None
    behind[0] = 2.5
    trip = interlock.check(BLOCK)
    assert trip is not None
    assert trip.text(NAMES).startswith(
        "interlock recorder: backlog of the recorder at 2.5 s, limit 2 s"
    )
    assert trip.joint == -1
    behind[0] = 1.5
    assert not interlock.clear(BLOCK)
    behind[0] = 0.9
    assert interlock.clear(BLOCK)


def test_a_robot_that_waits_for_the_recorder_needs_no_watch_over_it() -> None:
    for context in (
        InterlockContext(behind_s=lambda: 9.0, clock="virtual"),
        InterlockContext(behind_s=None, clock="wall"),
    ):
        interlocks = interlocks_from_spec([spec_of(kind="recorder")], context)
        assert [off.name for off in interlocks.off] == ["recorder"]
    wall = InterlockContext(behind_s=lambda: 9.0, clock="wall")
    assert made(wall, kind="recorder", behind_s=1).check(BLOCK) is not None


def test_a_disk_that_fills_up_trips_within_a_poll(disk: Any) -> None:
    free = [501 * MB]
    interlock = disk(lambda folder: free[0])
    assert interlock.check(BLOCK) is None
    free[0] = 499 * MB
    until(lambda: interlock.check(BLOCK))
    trip = interlock.check(BLOCK)
    assert trip is not None
    assert "free space for . at 499 MB, at least 500 MB" in trip.text(NAMES)


def test_a_full_disk_trips_with_the_first_check(disk: Any) -> None:
    assert disk(lambda folder: 10 * MB).check(BLOCK) is not None


def test_a_disk_is_clear_again_with_a_fifth_more_than_the_least(disk: Any) -> None:
    free = [550 * MB]
    interlock = disk(lambda folder: free[0], action="pause")
    assert not interlock.clear(BLOCK)
    free[0] = 601 * MB
    until(lambda: interlock.clear(BLOCK))


def test_a_disk_that_hangs_is_never_waited_for_and_trips_after_ten_seconds(disk: Any) -> None:
    hang, clock, waited_out = threading.Event(), Clock(), list[bool]()

    def hanging(folder: Path) -> int:
        waited_out.append(hang.wait(300.0))
        return 900 * MB

    interlock = disk(hanging, now=clock)
    asked = InTime()
    for seconds in (0.0, 4.0, 5.9):
        clock.time += seconds
        assert interlock.check(BLOCK) is None
    clock.time += 0.2
    trip = interlock.check(BLOCK)
    taken = asked.taken()
    taken.require(1.0)
    assert not waited_out
    assert trip is not None
    assert "free space for . is not measured" in trip.text(NAMES)
    hang.set()
    until(lambda: interlock.check(BLOCK) is None)


def test_a_disk_that_refuses_to_answer_trips_too(disk: Any) -> None:
    clock = Clock()

    def gone(folder: Path) -> int:
        raise OSError("stale file handle")

    interlock = disk(gone, now=clock)
    assert interlock.check(BLOCK) is None
    clock.time += 10.1
    assert interlock.check(BLOCK) is not None


def test_the_control_thread_never_asks_the_disk(disk: Any) -> None:
    threads: set[str] = set()

    def noting(folder: Path) -> int:
        threads.add(threading.current_thread().name)
        return 900 * MB

    interlock = disk(noting)
    for _ in range(20):
        interlock.check(BLOCK)
        time.sleep(0.001)
    assert threads == {"hil-free-space"}


def test_the_disk_is_asked_about_once_a_second() -> None:
    asked = 0

    def counting(folder: Path) -> int:
        nonlocal asked
        asked += 1
        return 900 * MB

    interlock = FreeSpace(HERE, 500.0, free=counting)
    end = time.monotonic() + 0.3
    while time.monotonic() < end:
        interlock.check(BLOCK)
    interlock.close()
    assert asked == 1


def test_closing_ends_the_thread_and_nothing_begins_before_the_first_check() -> None:
    def threads() -> int:
        return sum(t.name == "hil-free-space" for t in threading.enumerate())

    before = threads()
    interlocks = interlocks_from_spec(
        [spec_of(kind="disk", free_mb=0.001)], InterlockContext(folder=HERE)
    )
    assert threads() == before
    (interlock,) = interlocks
    assert interlock.check(BLOCK) is None
    assert threads() == before + 1
    interlocks.close()
    interlocks.close()
    assert threads() == before


@pytest.mark.thorough
def test_the_interlocks_of_a_run_watch_its_own_folder_and_recorder(tmp_path: Path) -> None:
    """Made before the motion is confirmed, they get both when the recording begins."""
    spec, station = tmp_path / "spec.yaml", tmp_path / "station.yaml"
    spec.write_text(
        "hil: 1\nname: short\nrobot: ur5\nexcitation: {kind: dwell, waypoints: 20, seed: 7}\n"
        "interlocks: [{kind: recorder, behind_s: 2}, {kind: disk, free_mb: 1.0e+12}]\n"
    )
    station.write_text(
        "hil_station: 1\nrobots: {ur5: {driver: mock, model: ur5, options: {clock: wall}}}\n"
    )
    with planned(load(spec, station)) as (robot, plan, _):
        interlocks = RunInterlocks(load(spec, station), robot, plan)
    backlog, disk = (one for one in interlocks.all if one.name in ("recorder", "disk"))
    for one in (backlog, disk):
        with pytest.raises(RuntimeError, match="before the recording began"):
            one.check(BLOCK)
    recorder: Any = SimpleNamespace(behind_s=1.0)
    interlocks.watch_recording(tmp_path, recorder)
    assert backlog.check(BLOCK) is None
    recorder.behind_s = 3.0
    assert backlog.check(BLOCK) is not None
    trip = disk.check(BLOCK)
    interlocks.all.close()
    assert trip is not None
    assert f"free space for {tmp_path}" in trip.text(NAMES)


# Interlocks of others: one that raises, dawdles or hangs is named, and not the driver


class Foreign:
    """An interlock of somebody's package; does what it is told to in `check`."""

    action = "stop"

    def __init__(self, name: str, does: Any) -> None:
        self.name = name
        self._does = does

    def check(self, block: StructArray) -> Any:
        return self._does(block)

    def clear(self, block: StructArray) -> bool:
        return True


def boo(block: StructArray) -> None:
    raise ValueError("boo")


@pytest.mark.thorough
def test_an_interlock_that_raises_is_named_with_its_place() -> None:
    robot = KinematicRobot()
    result = engine(robot, ListSink(), interlocks=[Foreign("raiser", boo)]).run()
    assert result.outcome is Outcome.TRIPPED
    assert result.reason == "interlock raiser: ValueError: boo"
    assert result.error is not None
    assert "tests.engine.test_interlocks.Foreign" in result.error.hint
    assert f"{__file__}:" in result.error.hint
    assert result.notes == ()
    assert "stop" in robot.calls


def test_what_is_no_trip_is_none() -> None:
    says_true = Foreign("handmade", lambda block: True)
    result = engine(KinematicRobot(), ListSink(), interlocks=[says_true]).run()
    assert result.reason == "interlock handmade: check returned True, which is not a Trip"


def test_an_interlock_that_dawdles_is_named_at_the_end() -> None:
    clock = iter([0.0, 5.0, 5.0, 5.0 + 2 * SLOW_S, 6.0, 6.0 + SLOW_S / 2])
    judge = Judge([Foreign("sleeper", lambda block: None)], now=lambda: next(clock))
    for _ in range(3):
        assert list(judge.violations(ListSink)) == []  # type: ignore[arg-type]
    assert judge.notes == [
        "interlock sleeper took up to 0.5 s for one block: its check must not wait"
    ]


class WallRobot(KinematicRobot):
    @property
    def capabilities(self) -> Capabilities:
        own = super().capabilities
        return Capabilities(own.joint_names, own.rate_hz, own.effort_kind, clock="wall")


@pytest.mark.thorough
@measured_again
def test_an_interlock_that_hangs_is_named_and_not_the_driver() -> None:
    for_ever = threading.Event()
    waited_out = []
    hangs = Foreign("light curtain", lambda block: waited_out.append(for_ever.wait(300)))
    asked = InTime()
    result = engine(WallRobot(), ListSink(), interlocks=[hangs]).run()
    taken = asked.taken()
    assert not waited_out
    for_ever.set()
    taken.require(15)
    assert isinstance(result.error, InterlockTripped)
    assert result.reason == "interlock light curtain: its check did not return for several seconds"
    assert "the watchdog stopped the robot" in result.notes[0]


# Judging every sample costs little: the benchmark, on its smaller problem


@pytest.mark.thorough
def test_the_default_set_is_far_cheaper_than_computing_every_sample() -> None:
    measured = measure("interlocks", quick=True)
    assert measured["figures"]["computed_percent"] < 15
    assert measured["ratios"]["blocks_of_1"] > 4
    assert measured["ratios"]["blocks_of_16"] > 15
    assert measured["ratios"]["coal_vs_numpy_one_sample"] > 3
