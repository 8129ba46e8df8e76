"""`hil payload` on runs at rest: an unknown tool on the mock, by the experiment that ships."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core.errors import DataError, SpecError
from tests.support.paths import EXPERIMENTS

TOOL: dict[str, Any] = {
    "mass_kg": 2.2,
    "com_m": [-0.03, 0.04, 0.05],
    "inertia_kgm2": [3e-3, 3e-3, 3e-3, 0, 0, 0],
}
BARE = "loads: [{mass_kg: 0}]\n"


class Bench:
    """One individual; what hangs at its flange is no business of the spec's."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def run(self, spec: Path, mounted: dict[str, Any] | None = None) -> Path:
        options = json.dumps({"seed": 3} | ({"mounted_payload": mounted} if mounted else {}))
        station = self.folder / "station.yaml"
        robot = f"  ur5: {{driver: mock, model: ur5, options: {options}}}\n"
        station.write_text(f"hil_station: 1\nname: bench\nrobots:\n{robot}", "utf-8")
        return Path(hil.run(hil.load(spec, station), runs=self.folder / "runs").run)


class Weighed:
    """A model of the arm, the tool weighed, and the bare flange."""

    def __init__(self, folder: Path) -> None:
        bench = Bench(folder)
        moved = bench.run(EXPERIMENTS / "ci_fourier_2.yaml")
        self.motion = moved
        self.rigid = next((moved / "fit").glob("rigid-wls-*"))
        rested = bench.run(EXPERIMENTS / "ci_dwell_12.yaml")
        self.static = next((rested / "fit").glob("static-wls-*"))
        self.tool = bench.run(EXPERIMENTS / "ur5_weigh.yaml", TOOL)
        text = (EXPERIMENTS / "ur5_weigh.yaml").read_text("utf-8")
        begin, end = text.index("loads:"), text.index("warm_up:")
        poses = str(EXPERIMENTS / "ur5_weigh_poses.csv")
        bare = folder / "bare.yaml"
        bare.write_text(
            (text[:begin] + BARE + text[end:]).replace("ur5_weigh_poses.csv", poses), "utf-8"
        )
        self.bare = bench.run(bare)
        self.leaning = bench.run(EXPERIMENTS / "ur5_weigh.yaml", {"mass_kg": 0})


@pytest.fixture(scope="module")
def weighed(tmp_path_factory: pytest.TempPathFactory) -> Weighed:
    return Weighed(tmp_path_factory.mktemp("weighed"))


def told(*arguments: object) -> str:
    done = CliRunner().invoke(app, ["payload", *map(str, arguments)])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.stdout


@pytest.mark.thorough
@pytest.mark.parametrize("model", ["static", "rigid"])
def test_the_tool_that_hangs_there_is_weighed_not_the_declared_one(
    weighed: Weighed, model: str
) -> None:
    found = json.loads(told(getattr(weighed, model), weighed.tool, "--json"))
    (low, high), *centre = (one["interval_95"] for one in found["parameters"][:4])
    assert low <= TOOL["mass_kg"] <= high
    assert high - low < 1.2
    assert all(a <= x <= b for (a, b), x in zip(centre, TOOL["com_m"], strict=True))
    assert found["payload"]["inertia_kgm2"] == [None] * 6


@pytest.mark.thorough
def test_the_bare_flange_as_tare_makes_it_sharp(weighed: Weighed) -> None:
    plain, tared = (
        json.loads(told(weighed.static, weighed.tool, "--json", *more))["parameters"][:4]
        for more in ((), ("--bare", weighed.bare))
    )
    truth = (TOOL["mass_kg"], *TOOL["com_m"])
    for known, rough, sharp in zip(truth, plain, tared, strict=True):
        assert sharp["interval_95"][0] <= known <= sharp["interval_95"][1]
        assert sharp["std_error"] < 0.75 * rough["std_error"]


@pytest.mark.thorough
def test_gains_that_are_known_well_narrow_the_mass(weighed: Weighed) -> None:
    arguments = (weighed.static, weighed.tool, "--bare", weighed.bare, "--json")
    usual, calibrated = (
        json.loads(told(*arguments, "--gain-percent", percent))["parameters"][0]["std_error"]
        for percent in (5, 1)
    )
    assert calibrated < 0.8 * usual


@pytest.mark.thorough
def test_people_are_told_what_shows_and_what_does_not(weighed: Weighed) -> None:
    text = told(weighed.static, weighed.tool)
    assert "payload from gravity at 6 poses" in text
    assert "Ixx" not in text
    assert "do not determine the inertia of a payload" in text
    assert "an uncertainty of 5 % of each drive gain" in text
    assert "--payload" not in text  # nothing is well determined
    tared = told(weighed.static, weighed.tool, "--bare", weighed.bare)
    assert "for a spec:  loads: [{mass_kg: 2." in tared
    assert "for options: --payload 2." in tared
    assert "inertia_kgm2" not in tared


@pytest.mark.thorough
def test_a_bare_flange_shows_no_load(weighed: Weighed) -> None:
    text = told(weighed.static, weighed.bare)
    assert "no payload detected" in text
    assert "not observable" in text
    assert "--payload" not in text


@pytest.mark.thorough
def test_what_cannot_be_a_tare_is_named(weighed: Weighed) -> None:
    with pytest.raises(DataError, match="is passed both with payload and as the bare flange"):
        told(weighed.static, weighed.tool, "--bare", weighed.tool)
    with pytest.raises(DataError, match=r"declares 1\.5 kg to the controller"):
        told(weighed.static, weighed.tool, "--bare", weighed.leaning)
    with pytest.raises(DataError, match=f"{weighed.motion}.*6 of 6 poses were not recorded"):
        told(weighed.static, weighed.tool, "--bare", weighed.motion)


@pytest.mark.thorough
def test_friction_is_checked_whatever_was_recorded(weighed: Weighed) -> None:
    with pytest.raises(SpecError, match="friction is 'banana'"):
        told(weighed.static, weighed.tool, "--friction", "banana")
    with pytest.raises(SpecError, match="friction scale is for motion"):
        told(weighed.static, weighed.tool, "--friction", "scale")


@pytest.mark.thorough
def test_a_file_that_is_not_there_is_no_run(weighed: Weighed) -> None:
    with pytest.raises(DataError, match=r"nope\.mcap does not exist"):
        told(weighed.static, "nope.mcap")


@pytest.mark.thorough
def test_another_individual_is_said_first_and_gives_nothing_to_paste(weighed: Weighed) -> None:
    with patch("hil.evaluation.validation.serial_of", lambda source: "another"):
        text = told(weighed.static, weighed.tool, "--bare", weighed.bare)
    first, *others = text.splitlines()
    assert first.startswith("NOT RELIABLE: recorded on another robot (serial another)")
    assert not any("--payload" in line for line in others)


@pytest.mark.thorough
def test_a_tare_does_not_go_with_motion(weighed: Weighed) -> None:
    with pytest.raises(SpecError, match="this recording contains motion"):
        told(weighed.rigid, weighed.motion, "--bare", weighed.bare)
