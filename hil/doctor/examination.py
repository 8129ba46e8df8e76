"""Checks of a computer and of the robots of a station; these checks move no robot."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from hil.core import HilError
from hil.doctor import computer, packages
from hil.doctor.finding import Finding
from hil.planning import opened
from hil.robot import HasReach
from hil.spec import StationRobot, load_station

CHECKS: tuple[Callable[[], Iterator[Finding]], ...] = (
    computer.python, computer.blas_threads,
    packages.core, packages.extras, packages.constraints, packages.torch, packages.plug_ins,
    computer.disk_space, computer.folders, computer.serial_adapters, computer.ports,
    computer.clock_resolution, computer.date, computer.time_service, computer.real_time,
    computer.socketcan,
)  # fmt: skip


def examine(station: Path | None = None) -> list[Finding]:
    """Return the findings of all checks of this computer and of a station.

    Args:
        station: Station file to check, including the reachability of its robots; None for no
            station.
    """
    findings = [finding for check in CHECKS for finding in check()]
    return findings + (list(station_robots(station)) if station else [])


AT_ONCE = 8
"""Maximum number of robots that are queried at the same time."""

MANY = 8
"""Number of simulated robots from which on the robots are counted instead of listed by name."""


def station_robots(path: Path) -> Iterator[Finding]:
    """Yield whether a station file is valid, and the findings about each of its robots.

    Args:
        path: Path of the station file.
    """
    try:
        station = load_station(path)
    except (HilError, OSError) as error:
        yield Finding("station", str(error), "bad")
        return
    yield Finding("station", f"{path}: the file is valid")
    with ThreadPoolExecutor(AT_ONCE) as pool:
        answers = list(pool.map(_ask, *zip(*station.robots.items(), strict=True)))
    inside = [name for name, answer in zip(station.robots, answers, strict=True) if not answer]
    if inside:
        shown = ", ".join(inside) if len(inside) < MANY else f"{len(inside)} of them"
        yield Finding("mock robots", f"{shown}: simulated within hil, no connection to check")
    for findings in answers:
        yield from findings


def _ask(name: str, described: StationRobot) -> list[Finding]:
    """Return the findings about a robot; an empty list for a robot simulated in this process."""
    try:
        # Run in this process, because a query takes only a second or two and has its own time
        # limit.
        with opened(name, described.model_copy(update={"own_process": False})) as robot:
            if isinstance(robot, HasReach):
                return [
                    Finding(
                        f"{name}: {one.name}",
                        one.message if one.passed or not one.hint else f"{one.message}: {one.hint}",
                        "ok" if one.passed else "bad",
                    )
                    for one in robot.reach()
                ]
            if robot.capabilities.clock == "virtual":
                return []
    except HilError as error:
        hint = f": {error.hint}" if error.hint else ""
        return [Finding(f"{name}: driver", f"{error.message}{hint}", "bad")]
    except Exception as error:  # a driver of a different package can raise any exception
        return [Finding(f"{name}: driver", f"{type(error).__name__}: {error}", "bad")]
    return [
        Finding(
            f"{name}: reach", f"the driver {described.driver} cannot check the connection", "note"
        )
    ]
