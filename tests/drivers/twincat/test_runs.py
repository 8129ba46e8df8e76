"""A whole experiment behind a PLC: the shipped spec and station, made short."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hil.recording.mcap_reader import read_topic
from hil_drivers.twincat.reading import TOPIC
from tests.support.mock_servers import mock_plc
from tests.support.paths import EXPERIMENTS

pytestmark = [pytest.mark.wire, pytest.mark.timeout(240)]


def shortened(folder: Path, address: str) -> tuple[Path, Path]:
    spec = yaml.safe_load((EXPERIMENTS / "twincat_fourier.yaml").read_text())
    spec["excitation"] |= {"trajectories": 3, "fundamental_hz": 0.5, "harmonics": 3}
    spec["warm_up"], spec["reference"] = {"duration_s": 1}, {"every": 0}
    spec["validate"] = {"hold_out": {"trajectories": 1}}
    spec["accept"] = {"rmse": {"max": 20, "unit": "N·m", "per": "mean"}, "gaps_percent": {"max": 0}}
    station = yaml.safe_load((EXPERIMENTS / "stations" / "lab6_twincat_mock.yaml").read_text())
    station["robots"]["lab6"]["options"]["address"] = address
    paths = folder / "spec.yaml", folder / "station.yaml"
    for path, told in zip(paths, (spec, station), strict=True):
        path.write_text(yaml.safe_dump(told))
    return paths


def run(spec: Path, station: Path, folder: Path) -> dict[str, Any]:
    asked = ("run", spec, "--station", station, "--runs", folder, "--json")
    command = [sys.executable, "-m", "hil", *map(str, asked)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    return dict(json.loads(done.stdout))


def test_an_experiment_behind_a_plc_is_recorded_at_1_khz_without_a_gap(tmp_path: Path) -> None:
    with mock_plc(tmp_path, "--speed", "20") as running:
        spec, station = shortened(tmp_path, running.address)
        said = run(spec, station, tmp_path / "runs")
        commands = {line["by"] for line in running.journal("command")}
    assert (said["outcome"], said["verdict"]) == ("completed", "passed")
    assert (said["gaps"], said["duplicates"]) == (0, 0)
    recording = Path(said["run"]) / "recording" / "00.mcap"
    rows, told = read_topic(recording), read_topic(recording, TOPIC)
    assert np.diff(rows["device_time"]) == pytest.approx(0.001)
    assert (np.diff(told["sequence"]) == 1).all()
    start = json.loads((Path(said["run"]) / "start.json").read_text())
    assert start["robot"]["identity"]["driver"] == "twincat"
    assert {"take", "load", "start", "payload", "release"} <= commands


@pytest.mark.proof
@pytest.mark.timeout(600)
def test_the_shipped_experiment_of_twelve_trajectories_passes(tmp_path: Path) -> None:
    with mock_plc(tmp_path, "--speed", "5") as running:
        _, station = shortened(tmp_path, running.address)
        said = run(EXPERIMENTS / "twincat_fourier.yaml", station, tmp_path / "runs")
    assert (said["outcome"], said["verdict"]) == ("completed", "passed")
    assert (said["gaps"], said["duplicates"]) == (0, 0)
    assert said["samples"] > 150_000
