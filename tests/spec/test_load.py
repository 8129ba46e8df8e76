"""Loading specs and stations: overrides, paths, identity, immutability."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from hil.arms import arm_names
from hil.arms.payload import Payload
from hil.core.errors import SpecError
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
from hil.spec.series import is_series
from hil.spec.station import StationRobot
from hil.workflow.robot_status import bench
from hil_drivers.cia402.options import options_of
from tests.support.paths import EXPERIMENTS

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
        "--set 3: robot: has no value: write one behind the = (an empty list is [], an empty "
        "text '')",
    ]


@pytest.mark.parametrize("key", ["", "loads.7.mass_kg", "name.first", "loads.mass_kg", "a..b"])
def test_an_override_of_a_place_that_cannot_be_is_refused(key: str) -> None:
    with pytest.raises(SpecError, match="there is no such place"):
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
    assert (
        "6:59: robots.b.surroundings.walls.0.normal: must point somewhere; it is all zeros" in said
    )
    assert len(said) == 6


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
