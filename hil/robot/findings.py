"""What a robot has looked at before it moves: lines of a preflight that only it can write."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        name: Short and lower-case, such as `joint-limits`; a preflight calls it `robot-…`.
        passed: False when the robot should not move.
        message: One sentence with the figures in it.
        measured, limit: What was found and what would have been fine, in SI units.
        hint: What to do about a failure.
    """

    name: str
    passed: bool
    message: str
    measured: float | str | None = None
    limit: float | str | None = None
    hint: str = ""


@runtime_checkable
class HasChecks(Protocol):
    """What a robot also offers when its controller can be asked whether it may be moved.

    A preflight asks after `connect` and after the first load was declared; what did not pass keeps
    the robot from moving and cannot be waived.
    """

    def checks(self) -> Sequence[Finding]:
        """Look, now; moves nothing. Raises `RobotError` when the controller cannot be asked."""


@runtime_checkable
class HasReach(Protocol):
    """What a robot also offers when it can be asked from afar whether it is there.

    `hil doctor --station` asks without `connect` and without the lease: nothing is taken that
    another client may need, nothing moves, and every question has a limit of some seconds.
    """

    def reach(self) -> Sequence[Finding]:
        """Ask, now; never raises because nobody answers."""
