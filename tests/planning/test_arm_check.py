"""`hil validate` against the arm itself: what a plan or a run would refuse, with its place."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import SpecError
from hil.planning.experiment import load as load_experiment
from hil.workflow.checks import check_driver

SPEC = """\
hil: 1
name: asked
robot: ur5
excitation:
  kind: fourier
  max_velocity_deg_s: 6000
  range_deg: [[-90, 90], [-90, 90]]
loads: [{mass_kg: 7}]
accept: {rmse: {max: 1, unit: Nm}}
fit: [{estimator: rigid-wls}]
"""


def refused(text: str, tmp_path: Path, *words: str) -> list[str]:
    (tmp_path / "s.yaml").write_text(text)
    error = CliRunner().invoke(app, ["validate", str(tmp_path / "s.yaml"), *words]).exception
    assert isinstance(error, SpecError)
    return error.message.replace(str(tmp_path / "s.yaml"), "s").splitlines()


def test_all_that_the_arm_cannot_do_is_told_at_once_with_places(tmp_path: Path) -> None:
    assert refused(SPEC, tmp_path) == [
        "s:6:23: excitation.max_velocity_deg_s: "
        "6000 °/s exceeds the limit of shoulder_pan_joint, 180 °/s",
        "s:7:14: excitation.range_deg: 2 ranges, but the ur5 has 6 joints",
        "s:8:19: loads.0.mass_kg: 7 kg exceeds the rated payload of the ur5, 5 kg",
        "s:9:31: accept.rmse.unit: the limit is in Nm, but ur5 measures a current in A: "
        "give the limit in A",
    ]


def test_a_value_of_the_command_line_is_told_at_its_option(tmp_path: Path) -> None:
    fine = SPEC.split("  max_velocity")[0]
    told = refused(fine, tmp_path, "--set", "excitation.max_velocity_deg_s=1e9")
    assert len(told) == 1
    assert told[0].startswith(
        "--set 1: excitation.max_velocity_deg_s: 1e+09 °/s exceeds the limit of "
        "shoulder_pan_joint, 180"
    )


def test_a_spec_without_a_file_is_told_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text(SPEC)
    experiment = replace(load_experiment(tmp_path / "s.yaml"), spec_source="")
    with pytest.raises(SpecError, match=r"(?m)^asked: excitation\.max_velocity_deg_s: 6000"):
        check_driver(experiment)


def test_an_interlock_below_the_speed_is_not_to_be_raised_beyond_the_arm(tmp_path: Path) -> None:
    text = SPEC + "interlocks: [{kind: speed, limit_deg_s: 90}]\n"
    [told] = refused(text, tmp_path)
    assert "reduce that limit, or increase this one, at most to the limit of the arm" in told


def test_a_robot_that_the_station_lacks_is_told_with_its_place(tmp_path: Path) -> None:
    assert refused(SPEC.replace("ur5", "arm"), tmp_path)[0].startswith("s:3:8: robot: the station")
    told = refused(SPEC, tmp_path, "--set", "robot=arm")
    assert told[0].startswith("--set 1: robot: the station")


def test_the_description_of_an_arm_is_told_as_one(tmp_path: Path) -> None:
    text = files("hil.arms").joinpath("ur5.yaml").read_text("utf-8")
    (told,) = refused(text, tmp_path)
    assert told.endswith("this file is the description of an arm, but an experiment is needed here")


BOX = """\
hil: 1
name: boxed
robot: ur5
excitation: {kind: dwell, waypoints: 24}
interlocks: [{kind: workspace, min_m: [-1, -1, 0], max_m: [1, 1, 0.5]}]
fit: [{estimator: static-wls}]
"""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("max_m: [1, 1, 0.5]", "max_m: [1, 1, 0.04]"), "leaves 40 mm to min_m on z"),
        (("min_m: [-1, -1, 0]", "min_m: [0.98, -1, 0]"), "max_m.0: leaves 20 mm to min_m on x"),
        (("min_m: [-1, -1, 0], max_m: [1", "min_m: [1, -1, 0], max_m: [2"), "beyond x of min_m"),
        (("fit:", "reference: {q_deg: [0, -90, 0, -90, 0, 0]}\nfit:"), "beyond z of max_m"),
        (("waypoints: 24", "file: p.csv, file_unit: deg"), "p.csv:2: the flange is 501.1 mm"),
    ],
    ids=["flat", "narrow", "out of reach", "reference", "pose of a file"],
)
def test_what_a_workspace_leaves_no_room_for_is_refused_without_a_plan(
    change: tuple[str, str], message: str, tmp_path: Path
) -> None:
    low, upright = "0,-60,110,-90,0,0", "0,-90,0,-90,0,0"
    (tmp_path / "p.csv").write_text("\n".join([low, upright, *[low] * 30]), "utf-8")
    lines = refused(BOX.replace(*change), tmp_path)
    assert len(lines) == 1
    assert message in lines[0]


def test_poses_too_near_to_a_side_are_refused_with_every_way_out(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("0,-90,0,-90,0,0\n" * 30, "utf-8")  # upright: 1.0011 m
    box = BOX.replace("1, 0.5]", "1, 1.01]").replace("waypoints: 24", "file: p.csv, file_unit: deg")
    (tmp_path / "s.yaml").write_text(box)
    error = CliRunner().invoke(app, ["validate", str(tmp_path / "s.yaml")]).exception
    assert isinstance(error, SpecError)
    assert error.hint == (
        "change these values, or move that side of the workspace interlock outwards, "
        "or lower the station's clearance_m, or choose a different robot"
    )
