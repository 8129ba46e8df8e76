"""The thread that owns the bus: cycles at their time, answers judged, set-points sent, all kept."""

from __future__ import annotations

from hil.typing import StructArray
from hil_drivers.cia402.player import Player, Track
from hil_drivers.cia402.supervisor import Phase, Supervisor


class Core:
    """The cyclic exchange of all axes, in a thread of its own.

    Until `run`, and after `rest`, it only takes what comes (`Cyclic.pump`), so that SDO requests of
    other threads are answered; between them cycles go on, enabled or not.

    Args:
        cyclic: The drives.
        supervisor, player: Write to the same outputs.
        schedule: When cycles begin.
        capacity: Cycle records that may wait to be taken.

    Attributes:
        temperature: (n,) [°C], written by whoever asks the drives for it; goes into every record.
    """

    @property
    def phase(self) -> Phase:
        """Where the axes are."""

    def open(self) -> None:
        """Start the thread, which pumps. Idempotent."""

    def run(self) -> None:
        """Begin with cycles; the drives are operational. Returns after the first answers.

        Raises:
            RobotTimeout: A drive does not answer.
        """

    def rest(self) -> None:
        """End the cycles, all axes off, and pump again."""

    def enable(self, mode: int, within_s: float = 10.0) -> None:
        """Enable all axes in a mode, all targets preloaded; blocks.

        Raises:
            RobotTimeout, RobotFault: With axis and state.
        """

    def switch(self, mode: int, within_s: float = 5.0) -> None:
        """Switch the mode of the enabled axes at rest; blocks, raises as `enable`."""

    def reset_faults(self, within_s: float = 5.0) -> None:
        """Reset faults that somebody has looked at; blocks, raises as `enable`."""

    def disable(self, within_s: float = 5.0) -> None:
        """Switch all axes off, at rest; blocks."""

    def prepare(self, track: Track) -> None:
        """Keep the next motion. Raises `CommandRefused`."""

    def start(self) -> None:
        """Begin the prepared motion with the next cycle. Raises `CommandRefused`."""

    def stop(self, deceleration_rad_s2: float) -> None:
        """Brake on the way with the next cycle, or leave off enabling; never raises or blocks."""

    def quick_stop(self, why: str = "") -> None:
        """Controlword quick stop to all axes with the next cycle; never raises or blocks."""

    def take_problem(self) -> str:
        """What ended a motion or enabling, told once; empty when nothing did."""

    def take(self, timeout_s: float) -> StructArray:
        """All cycle records (`mapping.cycle_dtype`) since the last call, in order, at least one.

        Raises:
            RobotTimeout: None came in time.
            RobotConnectionError: The bus is gone, and what came before that is taken.
        """

    def close(self) -> None:
        """End the thread. Idempotent."""
