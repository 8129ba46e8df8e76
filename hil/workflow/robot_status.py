"""`hil robots`: the robots of a station, and which processes hold them."""

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
    """One robot, and the process that holds it.

    Attributes:
        name: In its station.
        driver, model: As the station says; the model is empty for a robot of another station.
        station: File that describes it.
        resource: Identifies what one process at a time may drive; empty if each process has its
            own, as with the embedded mock.
        holder: The process that holds it; None if it is free.
        problem: Why its driver could not be constructed, else empty.
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
        """The run that it is moved by; empty if not known."""
        return plain(self.holder.content.get("run", ""), most=1000) if self.holder else ""

    @property
    def state(self) -> str:
        """State of that run, such as `paused`; empty if not known."""
        if not self.run or not is_live(Path(self.run)):
            return ""
        return plain(read_live(Path(self.run)).get("state", ""))

    def to_dict(self) -> dict[str, Any]:
        """Return the contract of `hil robots --json`."""
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
    """Return every robot of a station, then the robots of other stations that are held.

    Args:
        station: Its file; by default the one experiments in `folder` would use.
        folder: Where `station.yaml` is looked for.

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
