"""Whole experiments over real sockets: the specs of continuous integration on a mock UR5."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from hil.recording.mcap_reader import read_topic
from hil_drivers.ur.state import TOPIC
from tests.support.mock_servers import mock_ur
from tests.support.paths import EXPERIMENTS

pytestmark = [pytest.mark.wire, pytest.mark.timeout(400)]

SPEEDS = {"ci_dwell_12.yaml": "4", "ci_fourier_2.yaml": "1"}
"""Device seconds per second: what a machine that is shared with other work keeps up with.
Set-points that come late are to be heard in the currents: what is led is led in real time."""


def station_at(address, folder, **options):
    station = yaml.safe_load((EXPERIMENTS / "stations" / "ur5_rtde_mock.yaml").read_text())
    station["robots"]["ur5"]["options"] |= {"address": address} | options
    path = folder / "station.yaml"
    path.write_text(yaml.safe_dump(station))
    return path


def run(spec, station, folder, *more):
    asked = ("run", EXPERIMENTS / spec, "--station", station, "--runs", folder, "--json", *more)
    command = [sys.executable, "-m", "hil", *map(str, asked)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=350)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout)


@pytest.mark.proof
@pytest.mark.parametrize("spec", ["ci_dwell_12.yaml", "ci_fourier_2.yaml"])
def test_the_spec_of_the_embedded_mock_passes_over_the_wire_without_a_gap(spec, tmp_path):
    with mock_ur("--speed", SPEEDS[spec], "--seed", "1") as running:
        said = run(spec, station_at(running.address, tmp_path), tmp_path / "runs")
    assert (said["outcome"], said["verdict"]) == ("completed", "passed")
    assert (said["gaps"], said["duplicates"]) == (0, 0)
    folder = Path(said["run"])
    start = json.loads((folder / "start.json").read_text())
    assert start["robot"]["identity"]["driver"] == "ur"
    assert start["robot"]["identity"]["details"]["torque_source"] == "current"
    rows = read_topic(folder / "recording" / "00.mcap")
    further = read_topic(folder / "recording" / "00.mcap", TOPIC)
    assert np.diff(rows["device_time"]) == pytest.approx(0.008)
    assert len(further) == len(rows)


@pytest.mark.proof
def test_a_commissioning_run_is_slow_and_short(tmp_path):
    with mock_ur("--speed", "4") as running:
        station = station_at(running.address, tmp_path)
        said = run(
            "ci_dwell_12.yaml", station, tmp_path / "runs", "--speed-scale", "30%", "--limit", "1"
        )
    assert (said["outcome"], said["verdict"], said["gaps"]) == ("completed", "not judged", 0)
    rows = read_topic(Path(said["run"]) / "recording" / "00.mcap")
    assert np.abs(rows["qd_target"]).max() < np.radians(60) * 0.3 * 1.05
