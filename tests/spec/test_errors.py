"""What a lab engineer reads when a spec is wrong: place, key, and how to mend it."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from textwrap import dedent

import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core import plugins
from hil.core.errors import SpecError
from hil.spec import spec_from_text
from hil.spec.judgeable import require_judgeable
from hil.spec.load import load_station
from hil.spec.schedule import load_schedule_spec
from hil.spec.series import load_series_spec

GOOD = """\
hil: 1
name: demo
robot: ur5
excitation:
  kind: dwell
"""


Members = type("Members", (), dict.fromkeys(plugins.MEMBERS["hil.estimators"]))
"""Members that every estimator has; none of them is called here."""


class Network(Members):
    """An estimator with parameters, as a plug-in brings it."""

    estimator = "network"

    def __init__(self, *, layers: tuple[int, ...] = (4, 1), epochs: int = 10) -> None:
        if epochs < 1:
            raise ValueError(f"epochs is {epochs}, but must be at least 1")


class AtRest(Members):
    """An estimator for dwells, which can make do with slow stretches of motions."""

    estimator = "at-rest"
    series_kinds = (("dwell",), ("trajectory",))


class StaticWls(AtRest):
    """The same under another name."""

    estimator = "static-wls"


class InMotion(Members):
    """An estimator for trajectories, which can make do with moves."""

    estimator = "in-motion"
    series_kinds = (("trajectory",), ("move",))


class NeedsGap(Members):
    """An estimator with a parameter that has no default."""

    estimator = "needs-gap"

    def __init__(self, *, gap_s: float, rounds: int = 1) -> None:
        pass


def anything(**parameters: object) -> dict[str, object]:
    """An estimator that takes any parameter."""
    return parameters


@pytest.fixture(autouse=True)
def _estimators(monkeypatch: pytest.MonkeyPatch) -> None:
    group = "hil.estimators"
    points = [
        EntryPoint("static-wls", "tests.spec.test_errors:StaticWls", group),
        EntryPoint("at-rest", "tests.spec.test_errors:AtRest", group),
        EntryPoint("in-motion", "tests.spec.test_errors:InMotion", group),
        EntryPoint("network", "tests.spec.test_errors:Network", group),
        EntryPoint("needs-gap", "tests.spec.test_errors:NeedsGap", group),
        EntryPoint("anything", "tests.spec.test_errors:anything", group),
        EntryPoint("broken", "no_such_module:Thing", group),
    ]
    monkeypatch.setattr(plugins, "entry_points", lambda *, group: points)


def lines_of(text: str) -> list[str]:
    with pytest.raises(SpecError) as caught:
        spec_from_text(text, "f")
    return caught.value.message.splitlines()


def line_of(text: str) -> str:
    (line,) = lines_of(text)
    return line


# Added below GOOD, whose last line is number 5 and which is still inside `excitation`.
IN_EXCITATION = [
    ("waypoint: 9", "6:3: excitation.waypoint: unknown key; did you mean 'waypoints'?"),
    (
        "harmonics: 5",
        "6:3: excitation.harmonics: unknown key; it belongs to `excitation` with `kind: fourier`",
    ),
    ("kind: dwell", "6:3: excitation.kind: occurs twice, first at line 5, column 3"),
    ("waypoints: 0", "6:14: excitation.waypoints: must be at least 1, not 0"),
    ("waypoints: 1.5", "6:14: excitation.waypoints: must be a whole number, not 1.5"),
    ("waypoints: true", "6:14: excitation.waypoints: must be a number, not true"),
    ("waypoints: [1]", "6:14: excitation.waypoints: must be a number, not a list"),
    (
        "waypoints: '650'",
        "6:14: excitation.waypoints: must be a number, not the text '650': remove the quotes",
    ),
    (
        "waypoints: 1_000",
        "6:14: excitation.waypoints: must be a number, not the text '1_000': write it without '_'",
    ),
    (
        "dwell_s: 0,095",
        "6:12: excitation.dwell_s: must be a number, not the text '0,095': write a decimal point",
    ),
    (
        "dwell_s: 12:30",
        "6:12: excitation.dwell_s: must be a number, not the text '12:30'",
    ),
    ("dwell_s:", "6:11: excitation.dwell_s: has no value: add a value, or remove the key"),
    ("dwell_s: 0.001", "6:12: excitation.dwell_s: must be at least 0.01 s, not 0.001"),
    ("dwell_s: 601", "6:12: excitation.dwell_s: must be at most 600 s, not 601"),
    ("dwell_s: .inf", "6:12: excitation.dwell_s: must be at most 600 s, not inf"),
    ("approach_deg: -1", "6:17: excitation.approach_deg: must be above 0 °, not -1"),
    ("approach_deg: .inf", "6:17: excitation.approach_deg: must be a finite number, not inf"),
    (
        "approach: bth",
        "6:13: excitation.approach: must be one of both, positive, negative, free, not 'bth'; "
        "did you mean 'both'?",
    ),
    (
        "approach: sideways",
        "6:13: excitation.approach: must be one of both, positive, negative, free, not 'sideways'",
    ),
    ("file: 3", "6:9: excitation.file: must be text: put it in quotes, '3'"),
    ("file: [a]", "6:9: excitation.file: must be text, not a list"),
    ("file: nowhere.csv", f"6:9: excitation.file: there is no file nowhere.csv in {Path.cwd()}"),
    ("range_deg: [[0, 1], [0]]", "6:23: excitation.range_deg.1: needs 2 values, but has 1"),
    ("range_deg: [[0, 1, 2]]", "6:15: excitation.range_deg.0: needs 2 values, but has 3"),
    (
        "range_deg: [[90, -90]]",
        "6:15: excitation.range_deg.0: the range must go from low to high, not from 90 to -90",
    ),
    ("range_deg: 90", "6:14: excitation.range_deg: must be a list, not 90"),
]


@pytest.mark.parametrize(("entry", "line"), IN_EXCITATION)
def test_a_wrong_entry_of_the_excitation(entry: str, line: str) -> None:
    assert line_of(f"{GOOD}  {entry}\n") == f"f:{line}"


UNITS = [
    ("dwell_ms: 95", "dwell_s: 0.095"),
    ("dwell: 95", "dwell_s"),
    ("Dwell_S: 95", "dwell_s: 95"),
    ("dwell_min: 1", "dwell_s: 60"),
    ("max_velocity_rad_s: 1", "max_velocity_deg_s: 57.2958"),
    ("max_velocity: 60", "max_velocity_deg_s"),
    ("max_acceleration_rad_s2: 1.5", "max_acceleration_deg_s2: 85.9437"),
    ("settle_deg_s: 0.1", "settle_rad_s: 0.00174533"),
    ("approach_rad: text", "approach_deg"),
]


@pytest.mark.parametrize(("entry", "use"), UNITS)
def test_a_key_with_another_unit_is_told_the_right_one(entry: str, use: str) -> None:
    key = entry.partition(":")[0]

    assert line_of(f"{GOOD}  {entry}\n") == (
        f"f:6:3: excitation.{key}: unknown key; quantities carry their unit in the key: use {use}"
    )


QUANTITIES = [
    ("dwell_s: 95 ms", "dwell_s: 0.095"),
    ("dwell_s: 0.1s", "dwell_s: 0.1"),
    ("max_velocity_deg_s: 1 rad/s", "max_velocity_deg_s: 57.2958"),
    ("max_acceleration_deg_s2: 80 °/s²", "max_acceleration_deg_s2: 80"),
    ("max_acceleration_deg_s2: 80 deg/s^2", "max_acceleration_deg_s2: 80"),
]


@pytest.mark.parametrize(("entry", "write"), QUANTITIES)
def test_a_unit_in_the_value_is_converted_for_the_reader(entry: str, write: str) -> None:
    assert line_of(f"{GOOD}  {entry}\n").endswith(
        f": the key contains the unit, so write only the number: {write}"
    )


AT_THE_TOP = [
    ("loads: []", "6:8: loads: must not be empty: at least 1 required"),
    ("loads: {mass_kg: 3}", "6:8: loads: must be a list, not a mapping"),
    (
        "loads: [3]",
        "6:9: loads.0: must be a mapping with keys such as mass_kg, com_m, inertia_kgm2, not 3",
    ),
    (
        "loads: [{mass_g: 500}]",
        "6:10: loads.0.mass_g: unknown key; quantities carry their unit in the key: "
        "use mass_kg: 0.5",
    ),
    (
        "loads: [{mass_lb: 1}]",
        "6:10: loads.0.mass_lb: unknown key; quantities carry their unit in the key: "
        "use mass_kg: 0.453592",
    ),
    ("loads: [{com_m: [0, 0]}]", "6:17: loads.0.com_m: needs 3 values, but has 2"),
    ("loads: [{com_m: [0, 0, x]}]", None),
    (
        "loads: [{mass_kg: 1, inertia_kgm2: [1, 1, 3, 0, 0, 0]}]",
        "6:36: loads.0.inertia_kgm2: no body has this inertia: each principal moment must be ≥ 0 "
        "and at most the sum of the other two (the order is Ixx, Iyy, Izz, Ixy, Ixz, Iyz)",
    ),
    (
        "interlocks: [{kind: temperature, limit_k: 343.15}]",
        "6:34: interlocks.0.limit_k: unknown key; quantities carry their unit in the key: "
        "use limit_c: 70",
    ),
    (
        "interlocks: [{kind: temperature, limit_c: 343}]",
        "6:43: interlocks.0.limit_c: must be at most 150 °C, not 343",
    ),
    (
        "interlocks: [{kind: temprature, limit_c: 70}]",
        "6:21: interlocks.0.kind: there is no kind 'temprature'; did you mean 'temperature'?",
    ),
    (
        "interlocks: [{limit_c: 70}]",
        "6:14: interlocks.0.kind: is missing: one of tracking_error, temperature, speed, current, "
        "torque, workspace, clearance, stale, recorder, disk, speed_scaling",
    ),
    (
        "interlocks: [{kind: speed, limit_deg_s: 60}]",
        "6:41: interlocks.0.limit_deg_s: must be above "
        "excitation.max_velocity_deg_s (60 °/s): reduce that limit, or increase this one, at most "
        "to the limit of the arm",
    ),
    (
        "interlocks: [{kind: speed, limit_deg_s: 90, action: pause}]",
        "6:53: interlocks.0.action: must be stop, not 'pause'",
    ),
    (
        "interlocks: [{kind: stale, enabled: false}]",
        "6:37: interlocks.0.enabled: cannot be disabled: no other interlock detects a lost "
        "connection",
    ),
    ("record:", "6:8: record: has no value: add a value, or remove the key"),
    (
        "validate: {hold_out: {loads: [0, 2]}}",
        "6:34: validate.hold_out.loads.1: there is no load 2: `loads` has 1, counted from 0",
    ),
    (
        "validate: {hold_out: {loads: [0]}}",
        "6:30: validate.hold_out.loads: holds out every load, so that none is left to fit",
    ),
    (
        "validate: {hold_out: {trajectories: 2}}",
        "6:37: validate.hold_out.trajectories: a dwell program has no trajectories: "
        "use poses_percent",
    ),
    (
        "validation: {}",
        "6:1: validation: unknown key; did you mean 'validate'?",
    ),
    (
        "accept: {rmse: {max: 1, unit: V}}",
        "6:31: accept.rmse.unit: must be one of A, N·m, Nm, not 'V'",
    ),
    ("waypoints: 9", "6:1: waypoints: unknown key; it belongs to `excitation` with `kind: dwell`"),
    ("hil: 1", "6:1: hil: occurs twice, first at line 1, column 1"),
    (
        "zzz: 9",
        "6:1: zzz: unknown key; known here: hil, name, description, robot, excitation, loads, "
        "weigh, warm_up, reference, record, interlocks, fit, validate, accept, study",
    ),
    (
        "fit: [{}]",
        "6:7: fit.0.estimator: is missing: "
        "Name of an estimator (entry point in `hil.estimators`), e.g. `static-wls`",
    ),
    (
        "fit: [{estimater: network}]",
        "6:7: fit.0.estimator: is missing; is 'estimater' a misspelling of it?",
    ),
    (
        "fit: [{estimator: static-wsl}]",
        "6:19: fit.0.estimator: there is no estimator 'static-wsl'; did you mean 'static-wls'?",
    ),
    (
        "fit: [{estimator: zzz}]",
        "6:19: fit.0.estimator: there is no estimator 'zzz'; "
        "available: anything, at-rest, broken, in-motion, needs-gap, network, static-wls",
    ),
    (
        "fit: [{estimator: network, layer: [4, 1]}]",
        "6:28: fit.0.layer: network has no parameter 'layer'; did you mean 'layers'? "
        "(it has layers, epochs)",
    ),
    (
        "fit: [{estimator: network, epochs: 0}]",
        "6:36: fit.0.epochs: epochs is 0, but must be at least 1",
    ),
    (
        "fit: [{estimator: broken, a: 1}]",
        "6:19: fit.0.estimator: the estimator 'broken' (no_such_module:Thing) does not load: "
        "ModuleNotFoundError: No module named 'no_such_module' → "
        "an unknown distribution is installed incompletely: install it again",
    ),
]


@pytest.mark.parametrize(("entry", "line"), AT_THE_TOP)
def test_a_wrong_entry_at_the_top(entry: str, line: str | None) -> None:
    expected = line or "6:24: loads.0.com_m.2: must be a number, not the text 'x'"

    assert line_of(f"{GOOD}{entry}\n") == f"f:{expected}"


HEADS = [
    ("hil: 1", "hil: 2", "1:6: hil: this version of hil reads format 1, not 2"),
    ("hil: 1", "hil: true", "1:6: hil: must be a number, not true"),
    ("robot: ur5\n", "", "1:1: robot: is missing: Name of a robot of the station"),
    ("robot: ur5", "robott: ur5", "3:1: robott: unknown key; did you mean 'robot'?"),
    (
        "name: demo",
        "name: my demo",
        "2:7: name: must begin with a letter or digit and contain only letters, digits, '_', '.' "
        "and '-', at most 64 characters, not 'my demo'",
    ),
    (
        "kind: dwell",
        "kind: dwel",
        "5:9: excitation.kind: there is no kind 'dwel'; did you mean 'dwell'?",
    ),
    (
        "kind: dwell",
        "seed: 1",
        "5:3: excitation.kind: is missing: one of dwell, fourier",
    ),
    (
        "excitation:\n  kind: dwell",
        "excitation: dwell",
        "4:13: excitation: must be a mapping with keys such as kind, not 'dwell'",
    ),
    (
        "excitation:\n  kind: dwell",
        "excitation:",
        "4:12: excitation: has no value: add a value, or remove the key",
    ),
    ("hil: 1", "hil_station: 1", "1:1: this file is a station, but an experiment is needed here"),
]


@pytest.mark.parametrize(("old", "new", "line"), HEADS)
def test_a_wrong_head(old: str, new: str, line: str) -> None:
    assert line_of(GOOD.replace(old, new)) == f"f:{line}"


def test_a_list_is_no_experiment() -> None:
    assert line_of("- hil: 1") == "f:1:1: must be a mapping that begins with `hil: 1`"


def test_everything_wrong_is_reported_at_once_in_the_order_of_the_file() -> None:
    text = dedent("""\
        hil: 1
        name: a b
        excitation:
          kind: dwell
          dwell_ms: 95
          seed: -1
          seed: 2
        loads: [{mass_kg: -1}, {com_m: [1]}]
        fit: [{estimator: network, layer: 3}, {estimator: nix}]
        accept: {rmse: {max: 0, unit: A}}
        """)

    places = [":".join(line.split(":")[1:4]) for line in lines_of(text)]

    assert places == [
        "1:1: robot",
        "2:7: name",
        "5:3: excitation.dwell_ms",
        "6:9: excitation.seed",
        "7:3: excitation.seed",
        "8:19: loads.0.mass_kg",
        "8:32: loads.1.com_m",
        "9:28: fit.0.layer",
        "9:51: fit.1.estimator",
        "10:22: accept.rmse.max",
    ]


def test_a_plug_in_excitation_without_the_model_of_its_section_is_refused() -> None:
    """The entry points of this file stand for every group."""
    told = line_of(GOOD.replace("kind: dwell", "kind: at-rest"))
    assert "the excitation 'at-rest' has no `Spec`" in told


def test_only_the_chosen_kind_complains() -> None:
    said = lines_of(GOOD.replace("dwell", "fourier") + "  harmonics: 1\n  waypoints: 3\n")

    assert said == [
        "f:6:14: excitation.harmonics: must be at least 2, not 1",
        "f:7:3: excitation.waypoints: unknown key; it belongs to `excitation` with `kind: dwell`",
    ]


def test_one_typing_slip_is_one_line_and_not_also_a_missing_key() -> None:
    text = GOOD + "interlocks: [{kind: tracking_error, limit_deg: 3}]\n"

    assert lines_of(text) == [
        "f:6:37: interlocks.0.limit_deg: unknown key; quantities carry their unit in the key: "
        "use limit_rad: 0.0523599"
    ]


def test_the_hint_says_where_all_keys_are_listed() -> None:
    with pytest.raises(SpecError) as caught:
        spec_from_text(GOOD + "zzz: 1\n")

    assert "`hil schema experiment`" in caught.value.hint
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    ("entry", "hint"),
    [
        ("  wypnts: 12\n", "`hil explain excitation`"),
        ("  max_velocity_deg_s: fast\n", "`hil explain excitation.max_velocity_deg_s`"),
        ("loads: [{banana: 1}]\n", "`hil explain loads`"),
        ("fit: [{banana: 1}]\nzzz: 1\n", "`hil explain fit.estimator`"),
        ("zzz: 1\n", "`hil schema experiment`"),
    ],
)
def test_the_hint_leads_to_the_first_section_with_a_wrong_key(entry: str, hint: str) -> None:
    with pytest.raises(SpecError) as caught:
        spec_from_text(GOOD + entry)
    assert hint in caught.value.hint
    asked = caught.value.hint.split("`")[1].removeprefix("hil ").split()
    assert CliRunner().invoke(app, asked).exit_code == 0


def test_the_hint_in_a_station_is_of_what_a_robot_may_have(tmp_path: Path) -> None:
    path = tmp_path / "station.yaml"
    path.write_text(
        "hil_station: 1\nname: a\nrobots:\n  left: {driver: mock, model: ur5, host: 1}\n"
    )
    with pytest.raises(SpecError) as caught:
        load_station(path)
    assert caught.value.hint == "`hil explain robots` lists the allowed keys and values"
    assert "in_service" in CliRunner().invoke(app, ["explain", "robots"]).stdout


@pytest.mark.parametrize(
    ("kind", "load"),
    [("series", load_series_spec), ("schedule", load_schedule_spec), ("station", load_station)],
)
def test_the_hint_is_of_the_kind_of_file(
    kind: str, load: Callable[[Path], object], tmp_path: Path
) -> None:
    path = tmp_path / "f.yaml"
    path.write_text(f"hil_{kind}: 1\nzzz: 1\n")
    with pytest.raises(SpecError) as caught:
        load(path)
    assert caught.value.hint is not None
    asked = caught.value.hint.split("`")[1].removeprefix("hil ").split()
    assert asked == ["schema", kind]
    assert f'"hil_{kind}"' in CliRunner().invoke(app, asked).stdout


def test_a_hopeless_file_gets_fifty_lines_and_a_count() -> None:
    text = GOOD + "".join(f"k{i}x: 1\n" for i in range(300))

    said = lines_of(text)

    assert len(said) == 51
    assert said[-1] == "… and 250 more"


def test_trajectories_held_out_must_leave_some_to_fit_on() -> None:
    text = GOOD.replace("dwell", "fourier\n  trajectories: 3")

    spec_from_text(text + "validate: {hold_out: {trajectories: 2}}")
    assert "holds out 3 of 3 trajectories" in line_of(
        text + "validate: {hold_out: {trajectories: 3}}"
    )


def test_a_fit_holds_a_quarter_of_the_trajectories_out_unless_told_otherwise() -> None:
    def held(trajectories: int, more: str = "") -> int:
        text = GOOD.replace("dwell", f"fourier\n  trajectories: {trajectories}")
        how = spec_from_text(f"{text}fit: [{{estimator: network}}]\n{more}").validation.hold_out
        return how.trajectories_of(trajectories)

    assert [held(n) for n in (2, 3, 7, 8, 12)] == [1, 1, 1, 2, 3]
    loads = "loads: [{mass_kg: 0}, {mass_kg: 1}]\nvalidate: {hold_out: {loads: [1]}}"
    assert held(12, loads) == 0


UNJUDGEABLE = [
    (
        "fourier\n  trajectories: 1",
        "",
        "validate.hold_out: holds out 1 of 1 trajectories, so that none is left to fit",
    ),
    (
        "fourier",
        "validate: {hold_out: {trajectories: 0}}",
        "validate.hold_out.trajectories: holds out nothing, so that no model can be "
        "evaluated: hold out trajectories or loads",
    ),
    (
        "dwell\n  waypoints: 1",
        "",
        "validate.hold_out: holds out 1 of 1 poses, so that none is left to fit",
    ),
    (
        "dwell",
        "validate: {hold_out: {poses_percent: 0}}",
        "validate.hold_out.poses_percent: holds out nothing, so that no model can be "
        "evaluated: hold out poses or loads",
    ),
    (
        "fourier",
        "validate: {hold_out: {poses_percent: 20}}",
        "validate.hold_out.poses_percent: a Fourier program has no poses: use trajectories",
    ),
    (
        "fourier",
        "validate: {hold_out: {trajectories: 2, trajectories_percent: 25}}",
        "validate.hold_out.trajectories_percent: excludes `trajectories`, which selects the "
        "last ones: remove one of the two keys",
    ),
    (
        "fourier",
        "validate: {hold_out: {trajectories_percent: 0}}",
        "validate.hold_out.trajectories_percent: holds out nothing, so that no model can be "
        "evaluated: hold out trajectories or loads",
    ),
    (
        "fourier\n  trajectories: 1",
        "validate: {hold_out: {trajectories_percent: 50}}",
        "validate.hold_out.trajectories_percent: holds out 1 of 1 trajectories, so that none is "
        "left to fit",
    ),
    (
        "dwell",
        "validate: {hold_out: {trajectories_percent: 25}}",
        "validate.hold_out.trajectories_percent: a dwell program has no trajectories: use "
        "poses_percent",
    ),
]


@pytest.mark.parametrize(("kind", "validate", "expected"), UNJUDGEABLE)
def test_what_can_only_fail_after_the_motion_is_refused_before(
    kind: str, validate: str, expected: str
) -> None:
    text = GOOD.replace("dwell", kind) + "fit: [{estimator: network}]\n"
    assert line_of(text + validate).endswith(expected)


def test_a_recording_that_is_not_fitted_needs_nothing_held_out() -> None:
    assert spec_from_text(GOOD + "  waypoints: 1").fit == ()


@pytest.mark.parametrize(
    ("kind", "estimator", "expected"),
    [
        ("fourier", "at-rest", "at-rest cannot use the trajectories of this excitation"),
        ("dwell", "in-motion", "in-motion cannot use the dwells of this excitation"),
    ],
)
def test_an_estimator_for_another_excitation_is_refused(
    kind: str, estimator: str, expected: str
) -> None:
    other = {"fourier": "dwell", "dwell": "fourier"}[kind]
    line = line_of(GOOD.replace("dwell", kind) + f"fit: [{{estimator: {estimator}}}]")
    assert line.endswith(f"{expected}; it needs kind: {other}")
    spec_from_text(GOOD.replace("dwell", other) + f"fit: [{{estimator: {estimator}}}]")


def test_an_estimator_that_does_not_load_is_found_before_the_robot_moves() -> None:
    line = line_of(GOOD + "fit: [{estimator: broken}]")
    assert "fit.0.estimator: the estimator 'broken' (no_such_module:Thing) does not load" in line


@pytest.mark.parametrize(
    ("unit", "kind", "fine"),
    [("A", "current", True), ("A", "torque", False), ("Nm", "torque", True)],
)
def test_a_limit_in_another_unit_than_the_robots_effort_is_refused(
    unit: str, kind: str, fine: bool
) -> None:
    spec = spec_from_text(f"{GOOD}accept: {{rmse: {{max: 1, unit: {unit}}}}}")
    if fine:
        require_judgeable(spec, kind)
        return
    with pytest.raises(SpecError, match="the limit is in A, but ur5 measures a torque in N·m"):
        require_judgeable(spec, kind)


@pytest.mark.parametrize("entry", ["estimator: needs-gap", "estimator: needs-gap, rounds: 2"])
def test_a_parameter_without_default_is_missed_before_the_robot_moves(entry: str) -> None:
    assert line_of(GOOD + f"fit: [{{{entry}}}]").endswith("fit.0.estimator: needs-gap needs gap_s")


def test_an_estimator_that_takes_anything_is_given_anything() -> None:
    spec = spec_from_text(GOOD + "fit: [{estimator: anything, copy: 1, parameters: 2}]")

    assert spec.fit[0].parameters == {"copy": 1, "parameters": 2}


def test_what_another_machine_has_need_not_be_here_to_read_its_run() -> None:
    text = GOOD + "  file: gone.csv\nfit: [{estimator: theirs, secret: 1}]\n"

    assert spec_from_text(text, look_up=False).fit[0].parameters == {"secret": 1}
    assert len(lines_of(text)) == 2
