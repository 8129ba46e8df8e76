"""Leases: one process per robot, told to others, freed by death."""

from __future__ import annotations

import json
import os
import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from hil.core.errors import RobotConnectionError, SpecError
from hil.robot import Capabilities, HasResource
from hil.robot.lease import (
    Lease,
    held_leases,
    lease_holder,
    lease_path,
    leased,
    leases_folder,
    resource_of,
)
from tests.support.in_time import InTime, measured_again
from tests.support.kinematic_robot import KinematicRobot
from tests.support.other_process import other_process

UR5: Any = {"name": "ur5", "driver": "ur", "station": "bench"}


class RealRobot(KinematicRobot):
    """Lives in wall time."""

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(("j1",), 125.0, "current", clock="wall")


class AddressedRobot(RealRobot):
    resource = "ur://192.168.0.5"


HOLDING = """
import sys, time
from pathlib import Path
from tests.robot.test_lease import RealRobot, UR5
from hil.robot.lease import leased
with leased(RealRobot(), **UR5) as lease:
    lease.note_run(Path("runs/2026-11-21/ur5/0042-dwell"))
    print("ready", flush=True)
    {then}
"""


def holding(then: str = "input()") -> str:
    return HOLDING.format(then=then)


@pytest.fixture(autouse=True)
def leases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HIL_LEASES", str(tmp_path / "leases"))
    return tmp_path / "leases"


def test_a_robot_is_held_while_inside_and_free_after(leases: Path) -> None:
    with leased(RealRobot(), **UR5) as lease:
        (holder,) = held_leases()
        assert holder.pid == os.getpid()
        assert holder.content["robot"] == "ur5"
        assert holder.content["resource"] == lease.resource == "ur:ur5@bench"
        assert {"station", "host", "user", "command", "run", "since"} <= holder.content.keys()
    assert held_leases() == []
    assert list(leases.iterdir()) == []


def test_a_robot_on_a_virtual_clock_needs_none(leases: Path) -> None:
    with leased(KinematicRobot(), **UR5) as first, leased(KinematicRobot(), **UR5):
        first.note_run(Path("run"))
        assert held_leases() == []
    assert not leases.exists()


def test_the_same_address_is_the_same_robot_whatever_it_is_called() -> None:
    robot = AddressedRobot()
    assert isinstance(robot, HasResource)
    assert not isinstance(RealRobot(), HasResource)
    with (
        leased(robot, name="left", driver="ur", station="one"),
        pytest.raises(RobotConnectionError, match="robot right is held"),
    ):
        leased(AddressedRobot(), name="right", driver="ur", station="two")


def test_a_station_is_the_same_file_from_every_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bench.yaml").touch()
    about = {"name": "ur5", "driver": "ur"}
    full = resource_of(RealRobot(), station=str(tmp_path / "bench.yaml"), **about)
    monkeypatch.chdir(tmp_path)
    assert resource_of(RealRobot(), station="bench.yaml", **about) == full


def test_a_station_file_that_is_not_there_is_no_station_of_that_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SpecError, match=r"no station file bench\.yaml in ") as caught:
        leased(RealRobot(), name="ur5", driver="ur", station="bench.yaml")
    assert "full path" in caught.value.hint
    assert held_leases() == []


def test_a_run_can_be_resumed_whose_station_file_is_gone(
    tmp_path: Path,
) -> None:
    gone = tmp_path / "bench.yaml"
    gone.touch()
    about = {"name": "ur5", "driver": "ur", "station": str(gone)}
    before = resource_of(RealRobot(), **about)
    gone.unlink()
    assert resource_of(RealRobot(), **about) == before


def test_every_resource_has_a_file_of_its_own() -> None:
    names = ["ur://192.168.0.5", "ur://192.168.0.51", "UR://192.168.0.5", "ur-192.168.0.5", "/"]
    assert len({lease_path(name) for name in names}) == len(names)
    assert all(lease_path(name).parent == leases_folder() for name in names)
    assert lease_path(names[0]).name.startswith("ur-192.168.0.5-")


def test_a_held_robot_is_refused_with_who_has_it() -> None:
    with leased(RealRobot(), **UR5) as lease:
        lease.note_run(Path("runs/0042-dwell"))
        with pytest.raises(RobotConnectionError) as caught:
            leased(RealRobot(), **UR5)
    told = caught.value.message
    assert told.startswith(f"robot ur5 is held by pid {os.getpid()} (")
    assert "since" in told
    assert told.endswith("runs/0042-dwell)")
    assert "hil robots" in caught.value.hint


def test_others_see_the_run_once_it_is_known(tmp_path: Path) -> None:
    with leased(RealRobot(), **UR5) as lease:
        holder = lease_holder(lease.resource)
        assert holder is not None
        assert holder.content["run"] == ""
        lease.note_run(tmp_path / "0042-dwell")
        holder = lease_holder(lease.resource)
        assert holder is not None
        assert holder.content["run"] == str(tmp_path / "0042-dwell")
    assert lease_holder(lease.resource) is None


def test_what_a_dead_process_left_is_taken_over() -> None:
    path = lease_path("ur:ur5@bench")
    path.parent.mkdir()
    path.write_text(json.dumps({"pid": 4711, "host": os.uname().nodename}))
    with leased(RealRobot(), **UR5):
        (holder,) = held_leases()
        assert holder.pid == os.getpid()


def test_a_folder_for_several_users_lets_others_take_over(leases: Path) -> None:
    before = os.umask(0o077)
    try:
        with leased(RealRobot(), **UR5):
            (file,) = leases.iterdir()
            assert file.stat().st_mode & 0o777 == 0o666
    finally:
        os.umask(before)


def test_leases_are_private_by_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("HIL_LEASES")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    assert leases_folder() == Path(f"/tmp/hil-{os.getuid()}")
    monkeypatch.setattr("hil.robot.lease.leases_folder", lambda: tmp_path / "hil-1000")
    with leased(RealRobot(), **UR5):
        assert (tmp_path / "hil-1000").stat().st_mode & 0o777 == 0o700


def test_a_folder_of_somebody_else_is_not_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HIL_LEASES")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "hil-1000").symlink_to(tmp_path / "elsewhere")
    monkeypatch.setattr("hil.robot.lease.leases_folder", lambda: tmp_path / "hil-1000")
    with pytest.raises(RobotConnectionError, match="belongs to a different user") as caught:
        leased(RealRobot(), **UR5)
    assert "HIL_LEASES" in caught.value.hint


def test_a_folder_that_cannot_be_made_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("HIL_LEASES", str(tmp_path / "file"))
    with pytest.raises(RobotConnectionError, match="cannot store a lease"):
        leased(RealRobot(), **UR5)


@pytest.mark.wire
@measured_again
def test_kill_9_frees_the_robot_at_once() -> None:
    with other_process(holding()) as process:
        with pytest.raises(RobotConnectionError, match=f"pid {process.pid}") as caught:
            leased(RealRobot(), **UR5)
        assert "0042-dwell" in caught.value.message
        process.send_signal(signal.SIGKILL)
        process.wait()
        own = InTime()
        with leased(RealRobot(), **UR5):
            own.require(0.1)


@pytest.mark.wire
def test_who_waits_is_told_once_and_gets_the_robot() -> None:
    told: list[str] = []
    with other_process(holding("time.sleep(0.8)")) as process:
        with leased(RealRobot(), **UR5, wait_s=20.0, tell=told.append):
            assert held_leases()[0].pid == os.getpid()
        assert told == [text for text in told if f"pid {process.pid}" in text][:1]
        assert told[0].endswith("waiting up to 20 s")


@pytest.mark.wire
def test_who_has_waited_in_vain_is_refused() -> None:
    with (
        other_process(holding()),
        pytest.raises(RobotConnectionError, match=r"still after 0\.2 s"),
    ):
        leased(RealRobot(), **UR5, wait_s=0.2)


def test_one_of_many_contenders_gets_the_robot() -> None:
    def contend(_: int) -> Lease | None:
        try:
            return leased(RealRobot(), **UR5)
        except RobotConnectionError:
            return None

    with ThreadPoolExecutor(8) as pool:
        got = [lease for lease in pool.map(contend, range(8)) if lease is not None]
    for lease in got:
        lease.release()
    assert len(got) == 1
