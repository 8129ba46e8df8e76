"""Plans are made at a desk: who plans connects to no robot in wall time unless told to."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import hil
from hil.core.errors import RobotConnectionError
from hil.planning.robots import opened
from hil.robot.lease import leased
from hil.workflow.preview import WITHOUT_THE_ROBOT
from tests.support.paths import EXPERIMENTS

SPEC = EXPERIMENTS / "ci_dwell_12.yaml"
NOBODY = "198.51.100.7"
"""An address for documentation (RFC 5737): nobody is there, and nobody refuses."""


@pytest.fixture
def station(tmp_path):
    raw = yaml.safe_load((EXPERIMENTS / "stations" / "ur5_rtde_mock.yaml").read_text())
    raw["robots"]["ur5"]["options"]["address"] = NOBODY
    path = tmp_path / "station.yaml"
    path.write_text(yaml.safe_dump(raw))
    return path


@pytest.fixture
def experiment(station, monkeypatch, tmp_path):
    monkeypatch.setenv("HIL_LEASES", str(tmp_path / "leases"))
    return hil.load(SPEC, station)


@pytest.fixture
def no_network(monkeypatch):
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("it has connected")

    monkeypatch.setattr("socket.create_connection", refuse)


def plan_in_a_process(station: Path, *more: str) -> subprocess.CompletedProcess[str]:
    asked = [sys.executable, "-m", "hil", "plan", str(SPEC), "--station", str(station), *more]
    return subprocess.run(
        asked,
        capture_output=True,
        text=True,
        cwd=station.parent,
        env={**os.environ, "HIL_LEASES": str(station.parent / "leases")},
        timeout=300,
    )


def test_a_robot_in_wall_time_is_not_connected_to(experiment, no_network):
    with opened("ur5", experiment.robot) as robot:
        rate = robot.capabilities.rate_hz
    made = hil.plan(experiment)
    assert made.rate_hz == rate
    assert np.ptp(made.q_start) > 0.1  # a pose with room around it, not all zeros
    assert min(made.margins.values()) >= 0


@pytest.mark.thorough
def test_the_same_plan_follows_every_time(experiment, no_network):
    assert hil.plan(experiment).hash == hil.plan(experiment).hash


def test_one_that_somebody_drives_is_planned_for_and_not_disturbed(experiment, no_network):
    with (
        opened("ur5", experiment.robot) as robot,
        leased(robot, name="ur5", driver="ur", station="another"),
    ):
        assert len(hil.plan(experiment)) > 12
        # Asked for its lease before anything is said to it.
        with pytest.raises(RobotConnectionError, match="robot ur5 is held by"):
            hil.plan(experiment, connect=True)


@pytest.mark.thorough
def test_a_robot_on_a_virtual_clock_is_planned_from_where_it_stands():
    experiment = hil.load(SPEC)
    assert hil.plan(experiment).hash == hil.plan(experiment, connect=True).hash


@pytest.mark.thorough
def test_the_command_says_what_it_did_not_ask(station):
    done = plan_in_a_process(station, "--json")
    assert done.returncode == 0, done.stderr
    assert WITHOUT_THE_ROBOT in json.loads(done.stdout)["warnings"]


@pytest.mark.thorough
def test_told_to_connect_it_does(station):
    station.write_text(station.read_text().replace(NOBODY, "no-such-robot.invalid"))
    done = plan_in_a_process(station, "--connect")
    assert done.returncode == 4
    assert "no-such-robot.invalid" in done.stderr
