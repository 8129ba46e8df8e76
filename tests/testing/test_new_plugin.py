"""`hil new driver` and the other plug-ins: three files whose test passes as they stand."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core import SpecError
from hil.testing import PLUGIN_KINDS
from tests.support.paths import ROOT


@pytest.fixture(params=PLUGIN_KINDS)
def plugin(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A new plug-in called `lab-KIND`."""
    kind, name = request.param, f"lab-{request.param}"
    done = CliRunner().invoke(app, ["new", kind, name, "--out", str(tmp_path), "--json"])
    created = json.loads(done.stdout)
    assert created["next"][0] == 'pip install "hil[testing]"'
    assert created["next"][2] == f"python -m pytest {tmp_path / name}"
    files = [Path(file).name for file in created["files"]]
    assert files == ["pyproject.toml", f"lab_{kind}.py", f"test_lab_{kind}.py"]
    return tmp_path / name


def register(plugin: Path) -> None:
    """Write what `pip install -e` would write, without pip and the network."""
    text = (plugin / "pyproject.toml").read_text("utf-8")
    [section] = [part for part in text.split("\n\n") if "entry-points" in part]
    heading, line = section.splitlines()
    group = heading.split('"')[1]
    folder = plugin / f"{plugin.name.replace('-', '_')}-0.1.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {plugin.name}\nVersion: 0.1\n")
    (folder / "entry_points.txt").write_text(f"[{group}]\n{line.replace(chr(34), '')}\n")


@pytest.mark.wire
def test_a_new_plugin_passes_its_own_test(plugin: Path) -> None:
    register(plugin)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", "-p", "no:cacheprovider", "."],
        cwd=plugin,
        env=os.environ | {"PYTHONPATH": str(plugin)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-4000:]


def test_a_new_plugin_is_formatted_as_this_project(plugin: Path) -> None:
    config = ROOT / "pyproject.toml"
    for command in (["check"], ["format", "--check"]):
        done = subprocess.run(
            [sys.executable, "-m", "ruff", *command, "--config", config,
             f"{plugin.name.replace('-', '_')}.py"],
            cwd=plugin,
            capture_output=True,
            text=True,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("name", ["Lab", "lab_arm", "7arm", "a--b", "class", "json", "ur"])
def test_names_that_cannot_be_a_driver_are_refused(name: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["new", "driver", "--name", name, "--out", str(tmp_path)])
    assert isinstance(done.exception, SpecError)


def test_nothing_is_overwritten(plugin: Path) -> None:
    kind = plugin.name.removeprefix("lab-")
    done = CliRunner().invoke(app, ["new", kind, plugin.name, "--out", str(plugin.parent)])
    assert isinstance(done.exception, SpecError)
    assert "exists already" in done.exception.message


def test_a_new_map_describes_its_sample_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    created = json.loads(CliRunner().invoke(app, ["new", "map", "--robot", "ur3", "--json"]).stdout)
    assert created["files"] == ["my-recording.yaml", "my-recording.csv"]
    for command in created["next"]:
        done = CliRunner().invoke(app, command.split()[1:])
        assert done.exit_code == 0, done.output
