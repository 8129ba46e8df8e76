"""`hil new driver`: three files that keep the contract of a robot as they are."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core import SpecError
from tests.support.paths import ROOT


@pytest.fixture
def driver(tmp_path: Path) -> Path:
    done = CliRunner().invoke(app, ["new", "driver", "lab-arm", "--out", str(tmp_path), "--json"])
    made = json.loads(done.stdout)
    names = [Path(file).name for file in made["files"]]
    assert made["next"][0] == 'pip install "hil[testing]"'
    assert made["next"][2] == f"python -m pytest {tmp_path / 'lab-arm'}"
    assert names == ["pyproject.toml", "lab_arm.py", "test_lab_arm.py"]
    return tmp_path / "lab-arm"


@pytest.mark.wire
def test_a_new_driver_keeps_the_contract(driver: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", "-p", "no:cacheprovider", "."],
        cwd=driver,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-4000:]


def test_a_new_driver_is_formatted_as_this_project(driver: Path) -> None:
    config = ROOT / "pyproject.toml"
    for command in (["check"], ["format", "--check"]):
        done = subprocess.run(
            [sys.executable, "-m", "ruff", *command, "--config", config, "lab_arm.py"],
            cwd=driver,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("name", ["Lab", "lab_arm", "7arm", "a--b", "class", "json", "ur"])
def test_names_that_cannot_be_a_driver_are_refused(name: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["new", "driver", "--name", name, "--out", str(tmp_path)])
    assert isinstance(done.exception, SpecError)


def test_nothing_is_overwritten(driver: Path) -> None:
    done = CliRunner().invoke(app, ["new", "driver", "lab-arm", "--out", str(driver.parent)])
    assert isinstance(done.exception, SpecError)
    assert "already" in done.exception.message
