"""Small things people type first: versions, lists, wrong file names."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

import hil as package
from hil.cli.app import _as_ours
from hil.core.errors import DataError, RecordingError
from tests.support.command import Said, hil
from tests.support.recorded import DWELL

MAP = """\
hil_map: 1
format: csv
robot: two-link
joint_names: [a, b]
effort_kind: torque
columns:
  t: {rate_hz: 100}
  q: {columns: "1:2", unit: rad}
  effort: {columns: "3:4", unit: N·m}
"""


def importing(folder: Path, out: str) -> Said:
    (folder / "map.yaml").write_text(MAP, "utf-8")
    (folder / "run.csv").write_text("0,0,1,1\n0.1,0.1,1,2\n", "utf-8")
    return hil("import", "run.csv", "--map", "map.yaml", "-o", out, cwd=folder)


def test_version_is_told() -> None:
    assert hil("--version").stdout == f"hil {package.__version__}\n"


def test_benchmarks_are_listed_with_what_they_measure() -> None:
    listed = json.loads(hil("bench", "list", "--json").stdout)
    told = {entry["name"]: entry["description"] for entry in listed}
    assert "faster than real time" in told["mock"]
    assert all(told.values())


def test_a_picture_of_another_format_is_refused_before_planning(tmp_path: Path) -> None:
    done = hil("plan", DWELL, "--picture", "motion.pdf", cwd=tmp_path)
    assert done.returncode == 2
    assert "--picture motion.svg" in done.stderr


@pytest.mark.thorough
def test_an_ordinary_plan_has_no_warnings_and_a_poor_one_says_so(tmp_path: Path) -> None:
    good = json.loads(hil("plan", DWELL, "--json", cwd=tmp_path).stdout)
    assert good["warnings"] == []
    poor = tmp_path / "poor.yaml"
    poor.write_text("hil: 1\nname: poor\nrobot: ur5\nexcitation: {kind: dwell, waypoints: 1}\n")
    done = hil("plan", poor, cwd=tmp_path)
    assert done.returncode == 0
    assert "warning: " in done.stdout
    assert "condition number" in done.stdout.partition("warning: ")[2]


@pytest.mark.thorough
def test_import_never_replaces_a_file_and_says_how_to_go_on(tmp_path: Path) -> None:
    (tmp_path / "out.mcap").write_text("mine")
    done = importing(tmp_path, "out.mcap")
    assert done.returncode == 7
    assert "choose another -o" in done.stderr
    assert (tmp_path / "out.mcap").read_text() == "mine"


@pytest.mark.thorough
def test_import_makes_no_folders_unasked(tmp_path: Path) -> None:
    done = importing(tmp_path, "imprted/out.mcap")
    assert done.returncode == 7
    assert "mkdir -p imprted" in done.stderr
    assert not (tmp_path / "imprted").exists()


@pytest.mark.thorough
def test_columns_are_counted_from_one(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(MAP.replace('"1:2"', '"0:1"'), "utf-8")
    (tmp_path / "run.csv").write_text("0,0,1,1\n0.1,0.1,1,2\n", "utf-8")
    done = hil("import", "run.csv", "--map", "map.yaml", "-o", "out.mcap", cwd=tmp_path)
    assert done.returncode == 2
    assert "columns.q.columns: columns are counted from 1" in done.stderr


@pytest.mark.thorough
def test_the_schema_of_import_maps_is_printed() -> None:
    schema = json.loads(hil("schema", "map").stdout)
    assert schema["title"] == "hil map"
    assert "joint_names" in schema["required"]


LACKING = """
import sys, hil, hil_mock_robot
from pathlib import Path
FILE = Path(hil_mock_robot.__file__).with_name("ranges.yaml")
from hil.cli.app import _as_ours
error = FileNotFoundError(2, "No such file or directory", str(FILE))
sys.stdout.write(f"{type(_as_ours(error)).__name__} {_as_ours(error).exit_code} {_as_ours(error)}")
"""


def test_a_file_that_an_installation_lacks_is_no_fault_of_a_recording() -> None:
    done = subprocess.run([sys.executable, "-c", LACKING], capture_output=True, text=True)
    assert done.stdout.startswith("PluginError 2 "), done.stderr
    assert "ranges.yaml" in done.stdout
    assert "install hil again" in done.stdout


def test_a_file_that_may_not_be_read_is_no_place_to_write_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = tmp_path / "start.json"
    closed.touch()
    refused = partial(PermissionError, 13, "Permission denied")
    monkeypatch.setattr(
        os, "access", lambda path, mode, **_: mode != os.R_OK or Path(path) != closed
    )
    told = _as_ours(refused(str(closed)))
    assert (type(told), told.message) == (DataError, f"cannot read {closed}: Permission denied")
    assert told.hint == "see whether you may read it"
    assert isinstance(_as_ours(refused(str(tmp_path / "other"))), RecordingError)
