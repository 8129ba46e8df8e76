"""What a spec may say about interlocks, and which watch when it says nothing."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.core import plugins
from hil.core.errors import PlanError, SpecError
from hil.core.typing import StructArray
from hil.engine import Outcome
from hil.engine.interlocks import InterlockContext, interlocks_from_spec
from hil.spec import ExperimentSpec, load_spec, spec_from_text, spec_hash
from hil.spec.interlocks import DEFAULTS, PluggedInterlock
from tests.support.engine_parts import ListSink, engine
from tests.support.interlock_parts import NAMES, rows, spec_of
from tests.support.kinematic_robot import KinematicRobot

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


def picky(context, *, action, **anything):
    raise ValueError("no sensor on port 7")
"""


@pytest.fixture
def plugged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three plug-ins, beside those that are installed."""
    (tmp_path / "lab_interlocks.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "lab_interlocks", raising=False)
    targets = {"humidity": "Humid", "half-made": "half_made", "picky": "picky", "broken": "None_"}
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
    assert "cannot be switched off" in problem("{kind: stale, enabled: false}")
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
            "interlocks.0.limit_a: must not be empty: at least 1 needed",
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
            "interlocks.0.resume_below_c: must be below the limit of 75 °C",
        ),
        (
            "{kind: temperature, resume_below_c: 50}",
            "interlocks.0.resume_below_c: only an interlock with action: pause resumes",
        ),
        (
            "{kind: workspace}",
            "interlocks.0: bounds nothing: give min_m, max_m or planes",
        ),
        (
            "{kind: workspace, min_m: [0, 0, 0.5], max_m: [1, 1, 0.4]}",
            "interlocks.0.max_m.2: must be above the 0.5 m of min_m",
        ),
        (
            "{kind: speed, limit_deg_s: [90, 90, 90, 50, 90, 90]}",
            "interlocks.0.limit_deg_s: must be above the 60 °/s of excitation.max_velocity_deg_s: "
            "lower that one, or raise this one as far as the arm goes",
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


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ({"kind": "humidity"}, "TypeError: .*limit_percent"),
        ({"kind": "picky"}, "ValueError: no sensor on port 7"),
        ({"kind": "half-made"}, "its plug-in is no interlock: it lacks name, action, check, clear"),
        ({"kind": "wishful"}, "there is no interlock of kind 'wishful'"),
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
