"""How a run ended."""

from __future__ import annotations

from dataclasses import dataclass

from hil.core import HilError, InterlockTripped, Stopped
from hil.engine.reading import Progress
from hil.engine.states import Outcome


@dataclass(frozen=True, slots=True)
class RunResult:
    """How a run ended.

    Attributes:
        outcome: `completed`, `stopped`, `tripped` or `failed`.
        reason: In words, empty when completed.
        error: What ended it early, None when completed.
        steps_done: Plan steps that were executed to their end.
        unsettled: Steps whose dwell ran into its time-out.
        samples: State rows read.
        device_s: Device time from the first to the last sample [s].
        wall_s: Wall time of the run [s].
        notes: What else went wrong on the way out.
    """

    outcome: Outcome
    reason: str
    error: HilError | None
    steps_done: int
    unsettled: tuple[int, ...]
    samples: int
    device_s: float
    wall_s: float
    notes: tuple[str, ...] = ()


def result_of(
    error: HilError | None, progress: Progress, wall_s: float, notes: tuple[str, ...]
) -> RunResult:
    """The result of a run that was ended by `error`, or came to its end."""
    return RunResult(
        outcome=outcome_of(error),
        reason=error.message if error else "",
        error=error,
        steps_done=progress.steps_done,
        unsettled=tuple(progress.unsettled),
        samples=progress.samples,
        device_s=progress.last - progress.first if progress.samples else 0.0,
        wall_s=wall_s,
        notes=notes,
    )


def outcome_of(error: HilError | None) -> Outcome:
    """Which end an error means; none is the good one."""
    if error is None:
        return Outcome.COMPLETED
    if isinstance(error, InterlockTripped):
        return Outcome.TRIPPED
    return Outcome.STOPPED if isinstance(error, Stopped) else Outcome.FAILED
