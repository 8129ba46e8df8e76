"""The bus without anybody on it: `python -m benchmarks.can_bus.hub_alone CHANNEL [ordinary]`."""

from __future__ import annotations

import sys

from benchmarks.can_bus.ending import forbid_priority, until_over
from hil.can.hub import Hub
from hil_drivers.cia402.timing import realtime


def main(channel: str, *how: str) -> None:
    """Host it."""
    if "ordinary" in how:
        forbid_priority()
    with Hub(channel) as hub, realtime():
        until_over(hub.serve)


if __name__ == "__main__":
    main(*sys.argv[1:])
