"""All examinations, one after another."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from hil.doctor import can, clock, machine, packages, permissions, ports, robots
from hil.doctor.finding import Finding

CHECKS: tuple[Callable[[], Iterator[Finding]], ...] = (
    machine.python, machine.blas, packages.core, packages.extras, packages.constraints,
    packages.torch, packages.plugins_load, machine.disk, permissions.folders, permissions.serial,
    ports.free, clock.resolution, clock.date, clock.synchronised, machine.real_time, can.interfaces,
)  # fmt: skip


def examine(station: Path | None = None) -> list[Finding]:
    """Look at everything.

    Args:
        station: Also check this station file, and ask whether its robots are there; none is moved.
    """
    found = [finding for check in CHECKS for finding in check()]
    return found + (list(robots.asked(station)) if station else [])
