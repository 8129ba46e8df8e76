"""The mode of operation by object (6060h, 6061h), where the process data do not carry it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Protocol

from hil.core import CommandRefused
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.contracts import Acyclic
from hil_drivers.cia402.judging import mode_text
from hil_drivers.cia402.mapping import Mapping

SHOWN_WITHIN_S = 2.0
LOOK_S = 0.01


class Named(Acyclic, Protocol):
    """What is asked of the way to the drives."""

    def name_of(self, axis: int) -> str:
        """An axis for messages."""


def carries_mode(mapping: Mapping) -> bool:
    """Whether 6060h and 6061h travel with every cycle."""
    carried = {entry for pdo in mapping.pdos for entry in pdo.entries}
    return {od.MODE, od.MODE_DISPLAY} <= carried


def set_mode(
    acyclic: Named, axes: Sequence[int], mode: int, within_s: float = SHOWN_WITHIN_S
) -> None:
    """Write 6060h of all axes, and wait until 6061h of each shows it; none is enabled.

    A drive that was left in another mode would take our positions for nothing, or its old torque
    target for a command.

    Args:
        acyclic: To the drives.
        axes: From 0.
        mode: Of operation.
        within_s: How long a drive may take to show it [s].

    Raises:
        CommandRefused: A drive does not take or show it; with axis.
        RobotTimeout: A drive does not answer.
    """
    for axis in axes:
        acyclic.download(axis, od.MODE, mode)
    until = time.monotonic() + within_s
    for axis in axes:
        while (shown := acyclic.upload(axis, od.MODE_DISPLAY)) != mode:
            if time.monotonic() > until:
                raise CommandRefused(
                    f"{acyclic.name_of(axis)}: mode {mode_text(mode)} was written to 6060h, 6061h "
                    f"shows {mode_text(shown)} after {within_s:g} s",
                    hint="see what the drive's manual says of its modes, or use mapping: position",
                )
            time.sleep(LOOK_S)
