"""A file that is not there: where it was looked for, and what is there instead."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil.core.errors import DataError, SpecError
from hil.core.suggest import MOST_NAMED, neighbour_of, no_file
from hil.dynamics.build import read_serial_arm
from hil.importers.foreign_recordings import import_recording
from hil.spec.load import load_spec
from tests.support.paths import EXPERIMENTS

MAPS = EXPERIMENTS / "maps"


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_a_relative_path_is_told_with_the_folder_it_starts_at(tmp_path: Path) -> None:
    assert no_file(Path("cell/arm.urdf")) == f"there is no file cell/arm.urdf in {tmp_path}"
    assert no_file(tmp_path / "arm.urdf") == f"there is no file {tmp_path}/arm.urdf"


def test_a_slip_is_led_to_the_file_that_is_there(tmp_path: Path) -> None:
    (tmp_path / "my_arm.urdf").touch()
    (tmp_path / "my_arn.csv").touch()
    told = neighbour_of(tmp_path / "my_arn.urdf", [".urdf"])
    assert told == f"did you mean {tmp_path}/my_arm.urdf?"


def test_few_of_its_kind_are_listed_and_many_are_not(tmp_path: Path) -> None:
    for number in range(MOST_NAMED):
        (tmp_path / f"{number}.urdf").touch()
    listed = neighbour_of(tmp_path / "nothere.urdf", [".urdf"])
    assert listed.startswith("available: 0.urdf, 1.urdf")
    (tmp_path / "more.urdf").touch()
    assert "is the path correct" in neighbour_of(tmp_path / "nothere.urdf", [".urdf"])


def test_a_folder_that_is_not_there_is_what_is_missing() -> None:
    assert neighbour_of(Path("cel/arm.urdf"), [".urdf"]) == "there is no folder cel"


def test_a_urdf_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "my_arm.urdf").touch()
    with pytest.raises(SpecError) as caught:
        read_serial_arm(Path("my_arn.urdf"))
    assert caught.value.message == f"there is no file my_arn.urdf in {tmp_path}"
    assert caught.value.hint.startswith("did you mean my_arm.urdf?")


def test_poses_that_are_not_there_are_told_with_their_neighbour(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").touch()
    spec = tmp_path / "spec.yaml"
    spec.write_text(
        "hil: 1\nname: a\nrobot: ur5\nexcitation: {kind: dwell, file: pose.csv}\n", "utf-8"
    )
    with pytest.raises(SpecError, match=r"excitation\.file: there is no file") as caught:
        load_spec(spec)
    assert f"did you mean {tmp_path}/poses.csv?" in caught.value.message


def test_a_log_to_import_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "log.mat").touch()
    layout = MAPS / "kr300_mat.yaml"
    with pytest.raises(DataError) as caught:
        import_recording(Path("lgo.mat"), map_file=layout, out=tmp_path / "out.mcap")
    assert caught.value.message == f"there is no file lgo.mat in {tmp_path}"
    assert caught.value.hint == "did you mean log.mat?"
