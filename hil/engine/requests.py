"""What people, signals and interlocks ask of a run; obeyed by the control thread."""

from __future__ import annotations

from dataclasses import dataclass

from hil.errors import HilError, Stopped


@dataclass(slots=True)
class Requests:
    """Set from any thread or a signal handler, looked at before every block.

    Attributes:
        ended_by: What the watchdog has ended the run for; None while it has not.
        stop: Why somebody wants the run to stop; empty while nobody does.
        by_signal: Whether a signal asked for that.
        pause: Why somebody wants the run to pause; empty while nobody does.
        held: The violation of an interlock that only pauses; empty while there is none.
        resumed_by: Who let it go on last.
    """

    ended_by: HilError | None = None
    stop: str = ""
    by_signal: bool = False
    pause: str = ""
    held: str = ""
    resumed_by: str = ""

    def obey_stop(self) -> None:
        """Raise `Stopped` when a stop was requested, or what the watchdog has found."""
        if self.ended_by is not None:
            raise self.ended_by
        if self.stop:
            raise Stopped(self.stop, by_signal=self.by_signal)

    @property
    def why_paused(self) -> str:
        """Every reason to pause, empty when there is none."""
        return "; ".join(reason for reason in (self.pause, self.held) if reason)
