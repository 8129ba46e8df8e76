"""Brings all axes through the states of CiA 402 at once, and stops all when one falters."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

from hil_drivers.cia402.contracts import Emergency, Inputs, News, Outputs


class Phase(Enum):
    """Where all axes together are."""

    OFF = "off"
    RESETTING = "resetting faults"
    MODE = "setting the mode"
    ENABLING = "enabling"
    ENABLED = "enabled"
    SWITCHING = "switching the mode"
    BRAKING = "quick stop"
    DISABLING = "switching off"


class Supervisor:
    """What the drives are told beside set-points: one `step` a cycle, by the cyclic thread.

    Args:
        nodes: Node ids, for messages; their number is that of the axes.
        period_s: Device time of a cycle [s].
        outputs: What it writes to: controlwords, modes, and preloaded targets.
        mode_mapped: Whether the process data hold 6060h and 6061h.
        late_cycles: Cycles in a row that an axis may not answer.
        said: An emergency in words.

    Attributes:
        phase: Where the axes are.
        mode: The mode asked for last.
    """

    def __init__(
        self,
        nodes: tuple[int, ...],
        period_s: float,
        outputs: Outputs,
        *,
        mode_mapped: bool = True,
        late_cycles: int = 3,
        said: Callable[[Emergency], str] = str,
    ) -> None: ...

    def enable(self, mode: int) -> None:
        """Begin to enable all axes in a mode."""

    def switch(self, mode: int) -> None:
        """Begin to switch the mode of enabled axes at rest."""

    def reset(self) -> None:
        """Begin to reset the faults of all axes."""

    def disable(self) -> None:
        """Begin to switch off axes at rest, one state at a time."""

    def quick_stop(self, why: str = "") -> None:
        """Brake all axes now, by the drives' own ramps, and switch them off."""

    def hear(self, news: News) -> None:
        """What came beside process data; before the `step` of the same cycle."""

    def step(self, inputs: Inputs, cycle: int) -> None:
        """Judge what the drives answered, and write what they are told next."""

    def take_problem(self) -> str:
        """What made it stop all axes, with all axes' states; told once, empty else."""
