"""The robots of a station, and which processes hold them."""

from __future__ import annotations

from collections.abc import Sequence
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
    """One robot, and who holds it.

    Attributes:
        name: In its station.
        driver, model: As the station says; the model is empty for a robot of another station.
        station: Where it is described.
        resource: What no two processes may drive at once; empty when it is private to its process.
        holder: Who holds it, None when nobody does.
        problem: Why its driver could not be asked, else empty.
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
        """The run it is busy with, empty when not known."""
        return plain(self.holder.content.get("run", ""), most=1000) if self.holder else ""

    @property
    def state(self) -> str:
        """State of that run, such as `paused`; empty when not known."""
        if not self.run or not is_live(Path(self.run)):
            return ""
        return plain(read_live(Path(self.run)).get("state", ""))

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil robots --json`."""
        said = self.holder.content if self.holder else {}
        keys = ("pid", "user", "host", "command", "since")
        holder = {key: said.get(key) for key in keys} if self.holder else None
        if holder is not None and self.holder is not None:
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
    """Every robot of a station, then those of other stations that somebody holds.

    Args:
        station: Its file; by default the one experiments in `folder` would use.
        folder: Where `station.yaml` is looked for.

    Raises:
        SpecError: The station file has problems.
    """
    described, _, source = find_station(folder.resolve(), station)
    own = [_robot(name, robot, source) for name, robot in described.robots.items()]
    return [*own, *_elsewhere(own)]


def _robot(name: str, described: StationRobot, source: str) -> BenchRobot:
    driver, model = described.driver, described.model
    try:
        # Constructing a driver touches neither network nor bus.
        with opened(name, described) as robot:
            resource = resource_of(robot, name=name, driver=driver, station=source)
    except HilError as error:
        return BenchRobot(name, driver, model, source, problem=error.message)
    except Exception as error:  # a driver may fail in any way it likes
        told = f"{type(error).__name__}: {error}"
        return BenchRobot(name, driver, model, source, problem=told)
    holder = lease_holder(resource) if resource else None
    return BenchRobot(name, driver, model, source, resource, holder)


def _elsewhere(own: Sequence[BenchRobot]) -> list[BenchRobot]:
    known = {robot.resource for robot in own}
    held = [h for h in held_leases() if h.content.get("resource") not in known]
    return [
        BenchRobot(
            name=plain(holder.content.get("robot", "?")),
            driver=plain(holder.content.get("driver", "?")),
            model="",
            station=plain(holder.content.get("station", "?")),
            resource=plain(holder.content.get("resource", "?")),
            holder=holder,
        )
        for holder in held
    ]
