"""Status of the robots of a station and of the processes that use them (`hil robots`)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.core import HilError, Holder, is_live, plain
from hil.planning import find_station, opened
from hil.robot import held_leases, lease_holder, resource_of
from hil.spec import StationRobot
from hil.workflow.live_state import read_live


@dataclass(frozen=True, slots=True)
class BenchRobot:
    """Robot and the process that uses the robot.

    Attributes:
        name: Name of the robot in its station.
        driver, model: Driver and model of the robot in the station file; `model` is empty for a
            robot of a different station.
        station: Path of the station file that describes the robot.
        resource: Identifier of the hardware that only one process at a time may drive; empty if
            each process has a separate instance, as with the embedded mock.
        holder: Process that holds the lease of the robot; None if the robot is free.
        problem: Reason why the driver could not be constructed; empty if there was no error.
    """

    name: str
    driver: str
    model: str
    station: str
    resource: str = ""
    holder: Holder | None = None
    problem: str = ""

    @property
    def run(self) -> str:
        """Directory of the run that uses the robot; empty if unknown."""
        return plain(self.holder.content.get("run", ""), most=1000) if self.holder else ""

    @property
    def state(self) -> str:
        """State of the run that uses the robot, such as `paused`; empty if unknown."""
        if not self.run or not is_live(Path(self.run)):
            return ""
        return plain(read_live(Path(self.run)).get("state", ""))

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON output of `hil robots --json`."""
        holder: dict[str, Any] | None = None
        if self.holder is not None:
            keys = ("pid", "user", "host", "command", "since")
            holder = {key: self.holder.content.get(key) for key in keys}
            holder |= {"heartbeat_s": self.holder.heartbeat_s, "run": self.run, "state": self.state}
        return {
            "name": self.name,
            "driver": self.driver,
            "model": self.model,
            "station": self.station,
            "resource": self.resource or None,
            "holder": holder,
            "problem": self.problem,
        }


def bench(station: Path | None = None, folder: Path = Path()) -> list[BenchRobot]:
    """Return the status of every robot of a station, then of the leased robots of other stations.

    Args:
        station: Station file; by default the station that experiments in `folder` would use.
        folder: Folder in which `station.yaml` is searched for.

    Raises:
        SpecError: The station file has problems.
    """
    description, _, source = find_station(folder.resolve(), station)
    own = [_robot(name, robot, source) for name, robot in description.robots.items()]
    known = {robot.resource for robot in own}
    others = [
        BenchRobot(
            name=plain(holder.content.get("robot", "?")),
            driver=plain(holder.content.get("driver", "?")),
            model="",
            station=plain(holder.content.get("station", "?")),
            resource=plain(holder.content.get("resource", "?")),
            holder=holder,
        )
        for holder in held_leases()
        if holder.content.get("resource") not in known
    ]
    return [*own, *others]


def _robot(name: str, entry: StationRobot, source: str) -> BenchRobot:
    driver, model = entry.driver, entry.model
    try:
        # Constructing a driver touches neither network nor bus.
        with opened(name, entry) as robot:
            resource = resource_of(robot, name=name, driver=driver, station=source)
    except HilError as error:
        return BenchRobot(name, driver, model, source, problem=error.message)
    except Exception as error:  # drivers are plug-ins, which may raise anything
        problem = f"{type(error).__name__}: {error}"
        return BenchRobot(name, driver, model, source, problem=problem)
    holder = lease_holder(resource) if resource else None
    return BenchRobot(name, driver, model, source, resource, holder)
