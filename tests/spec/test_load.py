"""Loading specs, stations and series: overrides, paths, identity, and what goes together."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from hil.arms import arm_names
from hil.arms.payload import Payload
from hil.core.errors import SpecError
from hil.core.yaml import MOST_PROBLEMS
from hil.planning.experiment import NOT_MOCKED, mock_bench
from hil.planning.robots import opened
from hil.spec import (
    ExperimentSpec,
    load_spec,
    load_station,
    resolve_robot,
    spec_from_text,
    spec_hash,
)
from hil.spec.experiment import Dwell, Fourier
from hil.spec.schedule import is_schedule
from hil.spec.series import is_series, load_series_spec
from hil.spec.station import StationRobot
from hil.workflow.robot_status import bench
from hil.workflow.series import load_series
from hil_drivers.cia402.options import options_of
from tests.support.paths import EXPERIMENTS

# Loading specs and stations: overrides, paths, identity, immutability


SHIPPED = [
    path
    for path in sorted(EXPERIMENTS.glob("*.yaml"))
    if not (is_series(path) or is_schedule(path))
]
STATIONS = {"lab6_can": "lab6_can_mock.yaml", "ur5-001": "fleet_mock.yaml"}
GOOD = """\
hil: 1
name: demo
robot: ur5
excitation: {kind: dwell, waypoints: 20}
loads: [{mass_kg: 1}, {mass_kg: 3}]
"""
BENCH = """\
hil_station: 1
robots:
  ur5: {driver: mock, model: ur5}
"""


def dwell_of(spec: ExperimentSpec) -> Dwell:
    assert isinstance(spec.excitation, Dwell)
    return spec.excitation


# --- shipped files -------------------------------------------------------------------------
def test_the_dwell_experiment_is_the_programme_of_the_paper() -> None:
    spec = load_spec(EXPERIMENTS / "ur5_dwell_650.yaml")
    dwell = dwell_of(spec)

    assert (dwell.waypoints, dwell.dwell_s, dwell.samples_per_dwell) == (650, 0.095, 10)
    assert (dwell.max_velocity_deg_s, dwell.max_acceleration_deg_s2) == (60, 80)
    assert (dwell.approach, dwell.seed) == ("both", 7)
    assert [fit.estimator for fit in spec.fit] == ["static-wls"]
    assert spec.validation.hold_out.poses_percent == 20


def test_the_fourier_experiment_holds_three_of_twelve_trajectories_out() -> None:
    spec = load_spec(EXPERIMENTS / "ur5_fourier.yaml")

    assert isinstance(spec.excitation, Fourier)
    assert (spec.excitation.harmonics, spec.excitation.fundamental_hz) == (5, 0.1)
    assert (spec.excitation.trajectories, spec.validation.hold_out.trajectories) == (12, 3)
    assert [fit.estimator for fit in spec.fit] == ["rigid-wls", "rigid-hysteresis"]


def test_the_loaded_experiment_judges_on_the_load_it_did_not_fit() -> None:
    spec = load_spec(EXPERIMENTS / "ur5_fourier_loads.yaml")

    assert [load.mass_kg for load in spec.loads] == [0, 3]
    assert spec.validation.hold_out.loads == (1,)
    assert spec.loads[1].payload() == Payload(
        3.0, (0.0, 0.0, 0.05), (3.42e-3, 3.42e-3, 1.84e-3, 0.0, 0.0, 0.0)
    )


@pytest.mark.thorough
@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_every_shipped_experiment_runs_at_the_shipped_station(path: Path) -> None:
    spec = load_spec(path)
    station = load_station(EXPERIMENTS / "stations" / STATIONS.get(spec.robot, "mock.yaml"))

    on_can = spec.robot == "lab6_can"
    assert resolve_robot(spec, station).driver == ("cia402" if on_can else "mock")
    assert spec.name == path.stem.replace("_", "-")


def test_the_built_in_bench_has_every_arm_that_can_be_mocked(tmp_path: Path) -> None:
    robots = bench(folder=tmp_path)
    assert [robot.problem for robot in robots if robot.problem] == []
    assert {robot.name for robot in robots} >= set(arm_names()) - set(NOT_MOCKED)
    for name in NOT_MOCKED:
        with pytest.raises(SpecError), opened(name, StationRobot(driver="mock", model=name)):
            pass


def test_the_built_in_bench_has_the_drives_of_the_shipped_station() -> None:
    shipped = load_station(EXPERIMENTS / "stations" / "lab6_can_mock.yaml").robots["lab6_can"]
    built_in = mock_bench().robots["lab6_can"]

    assert (built_in.driver, built_in.model) == (shipped.driver, shipped.model)
    assert options_of(built_in.options, "lab6") == options_of(shipped.options, "lab6")


def test_the_mock_station_has_two_makes_of_arm() -> None:
    station = load_station(EXPERIMENTS / "stations" / "mock.yaml")

    assert {"ur5", "ur10e", "lab6"} <= set(station.robots)
    assert station.robots["ur5"].options == {"seed": 1}


# --- values --------------------------------------------------------------------------------
def test_a_spec_cannot_be_changed() -> None:
    spec = spec_from_text(GOOD)

    with pytest.raises(ValidationError, match="frozen"):
        spec.name = "other"
    with pytest.raises(ValidationError, match="frozen"):
        dwell_of(spec).waypoints = 3


def test_a_whole_number_may_be_spelt_with_a_point() -> None:
    assert dwell_of(spec_from_text(GOOD.replace("20", "2.0e1"))).waypoints == 20


def test_a_solid_ball_and_a_thin_rod_are_bodies_a_board_with_negative_moment_is_none() -> None:
    ball, rod = [0.4, 0.4, 0.4, 0, 0, 0], [1, 1, 0, 0, 0, 0]
    for inertia in (ball, rod, [0] * 6):
        spec_from_text(GOOD.replace("{mass_kg: 3}", f"{{mass_kg: 3, inertia_kgm2: {inertia}}}"))

    with pytest.raises(SpecError, match="no body has this inertia"):
        spec_from_text(
            GOOD.replace("{mass_kg: 3}", "{mass_kg: 3, inertia_kgm2: [1, 1, 1, 0.9, 0.9, -0.9]}")
        )


# --- overrides -----------------------------------------------------------------------------
def test_overrides_reach_into_mappings_and_lists() -> None:
    spec = spec_from_text(
        GOOD,
        overrides={
            "excitation.waypoints": "12",
            "loads.1.mass_kg": "2.5",
            "warm_up.duration_s": "1e1",
            "interlocks": "[{kind: speed, limit_deg_s: 100}]",
        },
    )

    assert dwell_of(spec).waypoints == 12
    assert [load.mass_kg for load in spec.loads] == [1, 2.5]
    assert spec.warm_up.duration_s == 10
    assert spec.interlocks[0].kind == "speed"


def test_a_wrong_override_is_reported_at_the_override() -> None:
    with pytest.raises(SpecError) as caught:
        spec_from_text(
            GOOD,
            "f",
            overrides={"excitation.waypoints": "many", "warm_up.duration_ms": "5", "robot": ""},
        )

    assert caught.value.message.splitlines() == [
        "--set 1: excitation.waypoints: must be a number, not the text 'many'",
        "--set 2: warm_up.duration_ms: unknown key; "
        "quantities carry their unit in the key: use duration_s: 0.005",
        "--set 3: robot: has no value: write a value after the = (an empty list is [], an empty "
        "text '')",
    ]


@pytest.mark.parametrize(("key", "value"), [("loads.0", "{mass_kg: 2}"), ("loads.0.mass_kg", "2")])
def test_an_override_may_fill_an_empty_entry_of_a_list(key: str, value: str) -> None:
    text = GOOD.replace("{mass_kg: 1}", "null")

    assert [load.mass_kg for load in spec_from_text(text, overrides={key: value}).loads] == [2, 3]


def test_an_override_is_not_blamed_for_problems_that_a_long_list_left_out() -> None:
    text = GOOD.replace("waypoints: 20", "waypoints: 0") + "".join(
        f"k{i}x: 1\n" for i in range(MOST_PROBLEMS)
    )

    with pytest.raises(SpecError) as caught:
        spec_from_text(text, "f", overrides={"excitation.waypoints": "12"})
    assert len(caught.value.message.splitlines()) == MOST_PROBLEMS
    assert "--set" not in caught.value.message


@pytest.mark.parametrize("key", ["", "loads.7.mass_kg", "name.first", "loads.mass_kg", "a..b"])
def test_an_override_of_a_place_that_cannot_be_is_refused(key: str) -> None:
    with pytest.raises(SpecError, match="this path does not exist"):
        spec_from_text(GOOD, overrides={key: "1"})


def test_an_override_that_is_no_yaml_is_refused() -> None:
    with pytest.raises(SpecError, match=r"^--set 1: name:1:3: a ',' or '\]' is missing"):
        spec_from_text(GOOD, overrides={"name": "[a"})


# --- files named in a spec -----------------------------------------------------------------
def test_a_file_of_poses_is_looked_for_beside_the_spec(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text("0,0,0,0,0,0\n")
    path = tmp_path / "spec.yaml"
    path.write_text(GOOD.replace("waypoints: 20", "file: poses.csv"))

    assert dwell_of(load_spec(path)).file == str((tmp_path / "poses.csv").resolve())


def test_a_missing_file_of_poses_is_an_error_of_the_spec(tmp_path: Path) -> None:
    path = tmp_path / "spec.yaml"
    path.write_text(GOOD.replace("waypoints: 20", "file: poses.csv"))

    with pytest.raises(SpecError, match=r"spec\.yaml:4:33: excitation\.file: there is no file"):
        load_spec(path)


# --- hash ----------------------------------------------------------------------------------
def test_the_hash_does_not_depend_on_how_a_spec_is_written() -> None:
    rewritten = """\
# a comment
robot: "ur5"
loads:
  - mass_kg: 1.0        # the same number
  - {mass_kg: 3e0, com_m: [0, -0.0, 0.0]}
name: demo
excitation:
  waypoints: 0x14
  kind: dwell
  dwell_s: 95.0e-3      # the default, written out
hil: 1
"""
    assert spec_hash(spec_from_text(rewritten)) == spec_hash(spec_from_text(GOOD))


def test_the_hash_changes_with_every_value() -> None:
    changes = {"name": "x", "excitation.seed": "8", "loads.1.mass_kg": "3.0000001"}
    hashes = {spec_hash(spec_from_text(GOOD, overrides={k: v})) for k, v in changes.items()}

    assert len(hashes | {spec_hash(spec_from_text(GOOD))}) == 4


def test_the_hash_counts_what_a_file_of_poses_says_and_not_where_it_lies(tmp_path: Path) -> None:
    hashes = []
    for folder, text in (("a", "0,0\n"), ("b", "0,0\n"), ("c", "0,1\n")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / f"{folder}.csv").write_text(text)
        spec = spec_from_text(
            GOOD, overrides={"excitation.file": f"{folder}.csv"}, folder=tmp_path / folder
        )
        hashes.append(spec_hash(spec))

    assert hashes[0] == hashes[1] != hashes[2]


def test_a_file_of_poses_that_went_away_has_no_hash(tmp_path: Path) -> None:
    file = tmp_path / "poses.csv"
    file.write_text("0\n")
    spec = spec_from_text(GOOD, overrides={"excitation.file": str(file)})
    file.unlink()

    with pytest.raises(SpecError, match="cannot be read"):
        spec_hash(spec)


# --- stations ------------------------------------------------------------------------------
def station_lines(tmp_path: Path, text: str) -> list[str]:
    path = tmp_path / "bench.yaml"
    path.write_text(text)
    with pytest.raises(SpecError) as caught:
        load_station(path)
    return [line.removeprefix(f"{path}:") for line in caught.value.message.splitlines()]


def test_a_station_reports_drivers_models_names_and_walls_at_once(tmp_path: Path) -> None:
    text = (
        BENCH.replace("mock", "mok").replace("model: ur5", "model: ur55")
        + "  'my arm': {driver: mock, model: cell/arm.urdf, gravity: [0, 0, 9.81]}\n"
        + "  b: {driver: mock, model: ur5,\n"
        + "      surroundings: {walls: [{point_m: [0, 0, 0], normal: [0, 0, 0]}]}}\n"
    )

    said = station_lines(tmp_path, text)

    assert "3:17: robots.ur5.driver: there is no driver 'mok'; did you mean 'mock'?" in said
    assert any(line.startswith("3:29: robots.ur5.model: there is no built-in arm") for line in said)
    missing = (
        f"4:35: robots.my arm.model: there is no file {tmp_path}/cell/arm.urdf; "
        f"there is no folder {tmp_path}/cell"
    )
    assert missing in said
    assert any(line.startswith("4:3: robots.my arm: must begin with a letter") for line in said)
    assert any(line.endswith("use gravity_m_s2") and line.startswith("4:50:") for line in said)
    assert "6:59: robots.b.surroundings.walls.0.normal: must not be the zero vector" in said
    assert len(said) == 6


def test_an_arm_like_no_other_is_answered_with_the_list_of_arms(tmp_path: Path) -> None:
    (line,) = station_lines(tmp_path, BENCH.replace("model: ur5", "model: banana"))
    arms = ", ".join(sorted(arm_names()))
    assert line.endswith(f"; available: {arms}. Write the path of a URDF.")


def test_an_experiment_is_no_station(tmp_path: Path) -> None:
    assert station_lines(tmp_path, GOOD) == [
        "1:1: this file is an experiment, but a station is needed here"
    ]


def test_a_urdf_is_looked_for_beside_the_station(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text("<robot/>")
    path = tmp_path / "bench.yaml"
    path.write_text(BENCH.replace("model: ur5", "model: ./arm.urdf"))

    model = load_station(path).robots["ur5"].model

    assert model == str((tmp_path / "arm.urdf").resolve())


def test_a_robot_the_station_lacks_is_guessed(tmp_path: Path) -> None:
    path = tmp_path / "bench.yaml"
    path.write_text(BENCH)
    spec = spec_from_text(GOOD.replace("robot: ur5", "robot: urr5"))

    with pytest.raises(SpecError, match="has no robot 'urr5'") as caught:
        resolve_robot(spec, load_station(path))
    assert caught.value.hint.startswith("did you mean 'ur5'?")


# Series files: what is wrong with them, with file, line and column, and with what they name


SPEC = """
hil: 1
name: small
robot: ur5
excitation: {kind: dwell, waypoints: 4}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "small.yaml").write_text(SPEC, "utf-8")
    return tmp_path


def written(folder: Path, text: str) -> Path:
    path = folder / "series.yaml"
    path.write_text("hil_series: 1\nname: all\n" + text, "utf-8")
    return path


def refusal(path: Path) -> list[str]:
    with pytest.raises(SpecError) as caught:
        load_series(path)
    return str(caught.value.message).splitlines()


def test_paths_start_at_the_folder_of_the_series(folder: Path) -> None:
    path = written(folder, "series: [{spec: small.yaml}]\n")
    assert load_series_spec(path).series[0].spec == str((folder / "small.yaml").resolve())


def test_the_station_is_the_one_named_last_before_the_run(folder: Path) -> None:
    mock, fast = EXPERIMENTS / "stations" / "mock.yaml", EXPERIMENTS / "stations" / "mock_1khz.yaml"
    entries = f"[{{spec: small.yaml}}, {{spec: small.yaml, station: {fast}}}]"
    path = written(folder, f"station: {mock}\nseries: {entries}\n")
    assert [e.station_source for e in load_series(path).experiments] == [str(mock), str(fast)]
    named = load_series(path, fast).experiments
    assert {experiment.station_source for experiment in named} == {str(fast)}


def test_a_file_that_is_missing_is_told_with_its_place_and_a_guess(folder: Path) -> None:
    path = written(folder, "series:\n  - {spec: smal.yaml}\n")
    (line,) = refusal(path)
    assert line.startswith(f"{path}:4:12: series.0.spec: there is no file")
    assert line.endswith(f"did you mean {folder}/small.yaml?")


def test_everything_that_is_wrong_is_told_at_once(folder: Path) -> None:
    path = written(folder, "seires: []\nseries:\n  - {spec: none.yaml, sation: a.yaml}\n")
    told = refusal(path)
    assert any("3:1: seires: unknown key; did you mean 'series'?" in line for line in told)
    assert any("sation: unknown key; did you mean 'station'?" in line for line in told)
    assert any("series.0.spec: there is no file" in line for line in told)


def test_what_is_wrong_with_any_experiment_is_told_with_that_file(folder: Path) -> None:
    for name in ("one", "two"):
        (folder / f"{name}.yaml").write_text(SPEC.replace("dwell", f"dwel_{name}"), "utf-8")
    told = refusal(written(folder, "series: [{spec: one.yaml}, {spec: two.yaml}]\n"))
    assert [Path(line.partition(":")[0]).name for line in told] == ["one.yaml", "two.yaml"]


def test_a_series_of_nothing_is_none(folder: Path) -> None:
    assert "must not be empty" in refusal(written(folder, "series: []\n"))[0]


def test_a_series_is_told_from_an_experiment(folder: Path) -> None:
    path = written(folder, "series: [{spec: small.yaml}]\n")
    assert is_series(path)
    assert not is_series(folder / "small.yaml")
    assert not is_series(folder / "missing.yaml")
    with pytest.raises(SpecError, match="this file is a series of experiments, but an experiment"):
        load_spec(path)
    with pytest.raises(SpecError, match="this file is an experiment, but a series"):
        load_series_spec(folder / "small.yaml")


@pytest.mark.parametrize(
    "path",
    [path for path in sorted(EXPERIMENTS.glob("*.yaml")) if is_series(path)],
    ids=lambda path: path.stem,
)
def test_every_shipped_series_runs_on_mocks(path: Path) -> None:
    series = load_series(path)
    assert {each.robot.driver for each in series.experiments} == {"mock"}
    assert series.spec.name == path.stem.replace("_", "-")


def test_a_series_that_names_itself_is_no_experiment(folder: Path) -> None:
    (line,) = refusal(written(folder, "series: [{spec: series.yaml}]\n"))
    assert "series.yaml:3:17: series.0.spec: " in line
    assert line.endswith("series.yaml is a series of experiments, but an experiment is needed here")


def test_a_missing_file_and_files_of_another_kind_are_told_at_once_by_line(folder: Path) -> None:
    mock = EXPERIMENTS / "stations" / "mock.yaml"
    entries = ("none.yaml", "series.yaml", f"small.yaml, station: {folder / 'small.yaml'}", mock)
    path = written(folder, "series:\n" + "".join(f"  - {{spec: {one}}}\n" for one in entries))
    missing, nested, station, spec = refusal(path)
    assert "series.0.spec: there is no file" in missing
    assert "series.yaml:5:12: series.1.spec: " in nested
    assert station.endswith("small.yaml is an experiment, but a station is needed here")
    assert spec.endswith("mock.yaml is a station, but an experiment is needed here")


def test_no_list_of_keys_is_pointed_at_where_a_file_name_is_wrong(folder: Path) -> None:
    known = "`hil explain series"
    for entry, hint in (("spec: none.yaml", ""), ("spec: small.yaml, to: 1", known)):
        with pytest.raises(SpecError) as caught:
            load_series(written(folder, f"series: [{{{entry}}}]\n"))
        assert (caught.value.hint or "")[: len(known)] == hint


def test_a_key_that_is_nothing_like_the_known_ones_is_no_slip_of_one(folder: Path) -> None:
    (line,) = refusal(written(folder, "series: [{spec: small.yaml, rate: 1}]\n"))
    assert "did you mean" not in line


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"hil_series: 1\nname: \xff\n", "f.yaml:2:7: byte 0xff is not UTF-8"),
        (b"hil_series: 2\nname: a\nseries: []\n", "reads format 1, not 2"),
        (
            b"hil_series: 1\nname: a\nseries: [{spec: x, to: 1}]\n",
            "series.0.to: unknown key",
        ),
        (b"hil_series: 1\nname: a\nseries: &a [*a]\n", "an alias contains itself"),
        (b"", "the file is empty"),
    ],
)
def test_what_is_no_series_is_told_by_line(folder: Path, content: bytes, words: str) -> None:
    path = folder / "f.yaml"
    path.write_bytes(content)
    assert words in "\n".join(refusal(path))


# The key `validate.under_loads` and its criteria: what goes together, and what it holds out


FOURIER = "hil: 1\nname: a\nrobot: ur5\nexcitation: {kind: fourier, trajectories: 8}\n"
LOADS = "loads: [{mass_kg: 0}, {mass_kg: 1}, {mass_kg: 3}]\n"
FIT = "fit: [{estimator: rigid-wls}]\n"
ASKED = "validate: {under_loads: true, hold_out: {trajectories: 2}}\n"


def spec(*lines: str) -> ExperimentSpec:
    return spec_from_text("".join(lines))


def test_every_load_but_the_first_is_held_out_with_the_motions() -> None:
    held = spec(FOURIER, LOADS, FIT, ASKED).hold_out
    assert (held.loads, held.trajectories) == ((1, 2), 2)


def test_a_quarter_of_the_motions_is_held_out_unless_told() -> None:
    assert spec(FOURIER, LOADS, FIT, "validate: {under_loads: true}\n").hold_out.trajectories == 2


def test_without_it_is_held_out_what_is_written() -> None:
    held = spec(FOURIER, LOADS, FIT, "validate: {hold_out: {loads: [2]}}\n").hold_out
    assert (held.loads, held.trajectories) == ((2,), None)


@pytest.mark.parametrize(
    ("lines", "where", "told"),
    [
        ((FOURIER, FIT, ASKED), "validate.under_loads", "requires a second load in `loads`"),
        ((FOURIER, "loads: [{mass_kg: 3}]\n", FIT, ASKED), "validate.under_loads", "a second load"),
        ((FOURIER, LOADS, ASKED), "validate.under_loads", "`fit` is empty"),
        (
            (FOURIER.replace("8", "2"), LOADS, FIT, "validate: {under_loads: true}\n"),
            "excitation.trajectories",
            "at least 3",
        ),
        (
            (FOURIER.replace("fourier, trajectories: 8", "dwell"), LOADS, FIT,
             "validate: {under_loads: true}\n"),
            "validate.under_loads",
            "a dwell program has none",
        ),
        (
            (FOURIER, LOADS, FIT, "validate: {under_loads: true, hold_out: {loads: [2]}}\n"),
            "validate.hold_out.loads",
            "must be omitted",
        ),
        (
            (FOURIER, LOADS, FIT, "validate: {under_loads: true, hold_out: {trajectories: 0}}\n"),
            "validate.hold_out.trajectories",
            "holds out nothing",
        ),
        (
            (FOURIER, LOADS, FIT, "accept: {load_error_ratio: {max: 1.5}}\n"),
            "accept.load_error_ratio",
            "requires validate",
        ),
        (
            (FOURIER, LOADS, FIT, "accept: {contradicted_loads: {max: 0}}\n"),
            "accept.contradicted_loads",
            "requires validate",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_is_said_where_it_is(lines: tuple[str, ...], where: str, told: str) -> None:
    with pytest.raises(SpecError) as failed:
        spec(*lines)
    assert where in str(failed.value)
    assert told in str(failed.value)
