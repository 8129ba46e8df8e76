"""Reset drive faults after a manual check: `python -m hil_drivers.cia402 reset STATION ROBOT`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from hil.arms import load_arm
from hil.core import HilError, SpecError
from hil.robot import leased
from hil.spec import StationRobot, load_station
from hil_drivers.cia402.bus import pumping
from hil_drivers.cia402.can_bus import CanBus
from hil_drivers.cia402.commissioning import faults_left, reset, unwatch
from hil_drivers.cia402.options import options_of
from hil_drivers.cia402.robot import Cia402Robot


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the drives in fault with their errors, reset their faults, return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m hil_drivers.cia402", description=__doc__)
    parser.add_argument("do", choices=["reset"], help="reset the faults of all drives")
    parser.add_argument("station", type=Path, help="station file")
    parser.add_argument("robot", help="name of the robot in the station file")
    options = parser.parse_args(arguments)
    try:
        return _reset(options.station, options.robot)
    except HilError as error:
        print(error, file=sys.stderr)  # noqa: T201
        return error.exit_code


def _reset(station: Path, name: str) -> int:
    """Reset the faults of all drives; return exit code 1 if a fault is still present, else 0."""
    entry = _entry(station, name)
    robot = Cia402Robot(name, entry.model, **entry.options)
    options, names = options_of(entry.options, entry.model), load_arm(entry.model).joint_names
    with (
        leased(robot, name=name, driver=entry.driver, station=str(station)),
        closing(CanBus(options, names)) as bus,
        pumping(bus.cyclic),
    ):
        faults = faults_left(bus.acyclic)
        left = [fault for fault in faults if not reset(bus.acyclic, fault)]
        unwatch(bus.acyclic)  # else the lost heartbeat is a new fault
    for fault in faults:
        print(f"{fault}: {'still active' if fault in left else 'reset'}")  # noqa: T201
    if not faults:
        print("no drive is in fault")  # noqa: T201
    return 1 if left else 0


def _entry(station: Path, name: str) -> StationRobot:
    robots = load_station(station).robots
    if name not in robots or robots[name].driver != "cia402":
        known = [each for each, robot in robots.items() if robot.driver == "cia402"]
        raise SpecError(
            f"{station} has no robot {name!r} on CiA 402 drives",
            hint=f"robots on CiA 402 drives: {', '.join(known) or 'none'}",
        )
    return robots[name]


if __name__ == "__main__":
    sys.exit(main())
