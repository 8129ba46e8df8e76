"""Which run holds the robot that a start did not get, by the words it ended with."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from hil.dashboard.places import address_of, name_of
from hil.dashboard.settings import Settings

_HELD = re.compile(
    r"RobotConnectionError: robot (.+?) is held by pid .*, run (.+)\)(?:, still after .*)?"
)
"""What `hil.robot.lease.leased` says of a holder that has a run."""


def held_by(last_words: Sequence[str], settings: Settings) -> dict[str, str] | None:
    """`robot`, `name` and `address` of the run; None where none of ours is said to hold it."""
    for line in last_words:
        if (said := _HELD.fullmatch(line.strip())) is None:
            continue
        run = Path(said[2])
        try:
            if run.is_dir():
                address, name = address_of(run, settings), name_of(run, settings)
                return {"robot": said[1], "name": name, "address": address}
        except (ValueError, OSError):  # in another folder of runs; no path at all
            continue
    return None
