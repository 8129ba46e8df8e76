"""Print the station file of a simulated fleet: a hundred mock UR5s from one to ten years old.

    python experiments/scripts/fleet_station.py > experiments/stations/fleet_mock.yaml
    python experiments/scripts/fleet_station.py --as-new > fleet_as_new.yaml

Friction of every joint grows with the years in service, each joint at a rate of its own. Three
robots have one joint with 30 % more on top. `--as-new` is the same fleet on its first day.
"""

from __future__ import annotations

import argparse
from datetime import date, timedelta

import numpy as np

ROBOTS, FIRST_SEED, FIRST_DAY = 100, 2001, 7
TODAY = date(2026, 11, 1)
YEARS = (1.0, 10.0)
A_YEAR, SPREAD = 0.02, 0.25
"""Friction that is added by a year in service, and how far a joint's own rate is from it."""

ROOM_C = (18.0, 26.0)
WORN = {"ur5-017": 1, "ur5-048": 2, "ur5-083": 4}
"""Robot → joint (from 0) with so much more friction than its age explains."""

MORE = 1.30
HEAD = """\
# yaml-language-server: $schema=../schema/station.schema.json
#
# A simulated fleet: a hundred mock UR5s, each another individual (seeds 2001 to 2100), one to ten
# years in service in rooms of 18 to 26 °C. Friction has grown with the years (`wear`); three have
# one joint with 30 % more: ur5-017 (J2), ur5-048 (J3), ur5-083 (J5).
#
# Made by experiments/scripts/fleet_station.py.
hil_station: 1
name: fleet-mock

robots:"""


def robot_lines(k: int, dice: np.random.Generator, *, as_new: bool) -> list[str]:
    """One robot of the station."""
    name, years = f"ur5-{k + 1:03d}", float(dice.uniform(*YEARS))
    rates = A_YEAR * (1.0 + SPREAD * dice.uniform(-1.0, 1.0, 6))
    wear = 1.0 + years * rates
    if name in WORN:
        wear[WORN[name]] *= MORE
    room = float(dice.uniform(*ROOM_C))
    options = [f"seed: {FIRST_SEED + k}", f"room_c: {room:.1f}"]
    if as_new:
        options.append(f"day: {k}")
    else:
        day = FIRST_DAY + k + round(365 * years)
        told = ", ".join(f"{factor:.3f}" for factor in wear)
        options += [f"day: {day}", f"wear: [{told}]"]
    since = TODAY - timedelta(days=round(365.25 * years))
    return [
        f"  {name}:",
        "    driver: mock",
        "    model: ur5",
        f"    in_service: {since.isoformat()}",
        f"    options: {{{', '.join(options)}}}",
    ]


def main() -> None:
    """Print the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--as-new", action="store_true", help="the fleet on its first day")
    as_new = parser.parse_args().as_new
    dice = np.random.default_rng(20)
    print(HEAD)
    for k in range(ROBOTS):
        print("\n".join(robot_lines(k, dice, as_new=as_new)))


if __name__ == "__main__":
    main()
