"""A station's file, and whether its robots are there: each is asked, none is moved."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from hil.core import HilError
from hil.doctor.finding import Finding
from hil.planning import opened
from hil.robot import HasReach
from hil.spec import StationRobot, load_station

AT_ONCE = 8
MANY = 8
"""Robots that are all right and alike are told in one line from here on."""


def asked(path: Path) -> Iterator[Finding]:
    """The file, then a line per thing that a robot was asked; robots are asked at the same time.

    Args:
        path: The station file.
    """
    try:
        station = load_station(path)
    except (HilError, OSError) as error:
        yield Finding("station", str(error), "bad")
        return
    yield Finding("station", f"{path}: the file is valid")
    with ThreadPoolExecutor(AT_ONCE) as pool:
        told = list(pool.map(_ask, *zip(*station.robots.items(), strict=True)))
    inside = [name for name, found in zip(station.robots, told, strict=True) if not found]
    if inside:
        shown = ", ".join(inside) if len(inside) < MANY else f"{len(inside)} of them"
        yield Finding("mock robots", f"{shown}: within hil, nothing to reach")
    for found in told:
        yield from found


def _ask(name: str, described: StationRobot) -> list[Finding]:
    """What a robot says of itself; nothing for one that is private to this process."""
    try:
        # In this process: asking takes a second or two, with a limit of its own.
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
    except Exception as error:  # somebody else's driver may raise anything
        return [Finding(f"{name}: driver", f"{type(error).__name__}: {error}", "bad")]
    return [Finding(f"{name}: reach", f"the driver {described.driver} cannot be asked", "note")]
