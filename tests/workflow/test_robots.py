"""`hil robots`: the robots of a station, and who holds them."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import RobotConnectionError, SpecError
from hil.core.lock_file import hold_run
from hil.robot import Capabilities
from hil.robot.lease import leased
from hil.workflow import robot_status as bench_module
from hil.workflow.live_state import LiveState
from hil.workflow.robot_status import bench
from tests.support.kinematic_robot import KinematicRobot

STATION = """\
hil_station: 1
robots:
  left: {driver: mock, model: ur5, options: {address: 192.0.2.7}}
  right: {driver: mock, model: ur5e}
  odd: {driver: mock, model: ur3}
  toy: {driver: mock, model: ur10}
"""


class AddressedRobot(KinematicRobot):
    resource = "ur://192.0.2.7"


class RealRobot(KinematicRobot):
    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(("j1",), 125.0, "current", clock="wall")


ROBOTS = {"left": AddressedRobot, "right": RealRobot, "toy": KinematicRobot}


@contextlib.contextmanager
def opened(name: str, described: Any) -> Iterator[KinematicRobot]:
    if name not in ROBOTS:
        raise SpecError("option address is missing")
    yield ROBOTS[name]()


@pytest.fixture
def station(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HIL_LEASES", str(tmp_path / "leases"))
    monkeypatch.setenv("HIL_STATION", "")
    monkeypatch.setattr(bench_module, "opened", opened)
    path = tmp_path / "station.yaml"
    path.write_text(STATION)
    return path


def listed(*arguments: str) -> Any:
    done = CliRunner().invoke(app, ["robots", *arguments])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout) if "--json" in arguments else done.stdout


def test_every_robot_says_what_it_is_and_who_has_it(station: Path, tmp_path: Path) -> None:
    run = tmp_path / "0042-dwell"
    run.mkdir()
    LiveState(run).notify({"kind": "state", "state": "paused", "reason": "lunch"})
    about: Any = {"name": "right", "driver": "mock", "station": str(station)}
    with leased(RealRobot(), **about) as lease, hold_run(run):
        lease.note_run(run)
        left, right, odd, toy = listed("--station", str(station), "--json")
    assert (left["resource"], left["holder"]) == ("ur://192.0.2.7", None)
    assert (toy["resource"], toy["holder"]) == (None, None)
    assert odd["problem"] == "option address is missing"
    assert right["resource"] == f"mock:right@{station}"
    holder = right["holder"]
    assert (holder["pid"], holder["run"], holder["state"]) == (os.getpid(), str(run), "paused")
    assert 0 <= holder["heartbeat_s"] < 2
    assert {"user", "host", "command", "since"} <= holder.keys()


def test_the_table_tells_the_same(station: Path) -> None:
    about: Any = {"name": "left", "driver": "mock", "station": str(station)}
    with leased(AddressedRobot(), **about):
        rows = listed("--station", str(station)).splitlines()
    told = {row.split()[0]: row for row in rows}
    assert f"pid {os.getpid()}, since " in told["left"]
    assert "heartbeat" in told["left"]
    assert "free" in told["right"]
    assert "private" in told["toy"]
    assert "address is missing" in told["odd"]


def test_held_robots_of_other_stations_are_listed_too(station: Path) -> None:
    with leased(RealRobot(), name="far", driver="ur", station="another bench"):
        far = bench(station)[-1]
    assert (far.name, far.driver, far.station) == ("far", "ur", "another bench")
    assert far.holder is not None
    assert "far" not in [robot.name for robot in bench(station)]


def test_the_station_is_looked_for_where_experiments_look(
    station: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert [robot.name for robot in bench(folder=station.parent)] == ["left", "right", "odd", "toy"]
    monkeypatch.setenv("HIL_STATION", str(station))
    assert len(bench(folder=Path("/"))) == 4


def test_a_driver_that_fails_in_its_own_way_is_a_line_in_the_table(
    station: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(name: str, described: Any) -> Any:
        raise KeyError("vendor")

    monkeypatch.setattr(bench_module, "opened", broken)
    assert {robot.problem for robot in bench(station)} == {"KeyError: 'vendor'"}


def test_a_second_process_is_told_to_look_there(station: Path) -> None:
    about: Any = {"name": "left", "driver": "mock", "station": str(station)}
    with leased(AddressedRobot(), **about), pytest.raises(RobotConnectionError) as caught:
        leased(AddressedRobot(), **about)
    told, wait = caught.value.hint.split("; ")
    assert told == f"list the robots and their holders: hil robots --station {station}"
    assert "--wait" in wait
    with leased(AddressedRobot(), **about), pytest.raises(RobotConnectionError) as caught:
        leased(AddressedRobot(), **about, wait_s=0.05)
    assert "--wait" not in caught.value.hint  # it was waited for already
