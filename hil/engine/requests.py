"""What people, signals and interlocks ask of a run; obeyed by the control thread."""

from __future__ import annotations

from dataclasses import dataclass

from hil.core import HilError, Stopped


@dataclass(slots=True)
class Requests:
    """Set from any thread or a signal handler, looked at before every block.

    Attributes:
        ended_by: Error for which the watchdog ended the run; None if it did not.
        stop: Stop reason; empty if none.
        by_signal: Whether a signal requested the stop.
        pause: Pause reason; empty if none.
        held: The violation of an interlock that only pauses; empty if none.
        resumed_by: Who let it go on last.
    """

    ended_by: HilError | None = None
    stop: str = ""
    by_signal: bool = False
    pause: str = ""
    held: str = ""
    resumed_by: str = ""

    def obey_stop(self) -> None:
        """Raise `Stopped` if a stop was requested, or the error of the watchdog."""
        if self.ended_by is not None:
            raise self.ended_by
        if self.stop:
            raise Stopped(self.stop, by_signal=self.by_signal)

    @property
    def why_paused(self) -> str:
        """Every reason to pause, empty when there is none."""
        return "; ".join(reason for reason in (self.pause, self.held) if reason)
