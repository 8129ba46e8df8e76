"""Every error `hil` raises on purpose, with its process exit code.

::

    HilError                     1   (never raised itself)
    ├── SpecError                2   a spec, station or map file says something that cannot be
    ├── PlanError                2   the spec is well formed, but no safe plan follows from it
    ├── PluginError              2   a driver, estimator or check is missing or broken
    ├── PreflightFailed          3   a check before motion failed
    │   └── NotConfirmed             the motion of a real robot was not confirmed
    ├── RobotError               4   the rig, not the result, is broken
    │   ├── RobotConnectionError     (also ConnectionError)
    │   ├── RobotTimeout             (also TimeoutError)
    │   ├── RobotFault               the controller reports a fault
    │   ├── CommandRefused           the controller said no
    │   └── StaleState               the driver gets no data, or data without a time
    ├── InterlockTripped         5   motion was stopped by an interlock
    ├── Stopped                  6   somebody stopped it (130 when by signal)
    ├── RecordingError           7   the recorder could not keep the data
    ├── DataError                8   a data file or run directory cannot be used
    │   └── CheckpointRefused        a training kept on disk is damaged, or another one
    ├── FitError                 9   an estimator cannot fit what it was given
    ├── Rejected                 10  the model missed its acceptance criteria
    └── RegistryError            11  the model registry cannot do what was asked

A bad *result* (10) is never confused with a broken *rig* (4, 5, 7).
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar


class HilError(Exception):
    """Base of all: a message that says what and where, and a hint that says how to mend it.

    Args:
        message: What went wrong and where, complete without the traceback.
        hint: The next thing to do, as a sentence or a command to type.
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.message}\n  → {self.hint}" if self.hint else self.message


class SpecError(HilError):
    """A spec, station or map file cannot be used; `message` holds one line per problem."""

    exit_code = 2


class PlanError(HilError):
    """The spec is well formed but no safe plan follows from it."""

    exit_code = 2


class PluginError(HilError):
    """A named driver, excitation, estimator, check or mock is missing or does not load."""

    exit_code = 2


class PreflightFailed(HilError):
    """At least one check before motion failed; the message lists all of them."""

    exit_code = 3


class NotConfirmed(PreflightFailed):
    """The motion of a real robot was not confirmed; the robot stands still."""


class RobotError(HilError):
    """The robot or the way to it is broken."""

    exit_code = 4


class RobotConnectionError(RobotError, ConnectionError):
    """The robot cannot be reached, or the connection was lost."""


class RobotTimeout(RobotError, TimeoutError):
    """The robot did not do in time what it had accepted to do."""


class RobotFault(RobotError):
    """The controller reports a fault (protective stop, drive fault, emergency stop)."""


class CommandRefused(RobotError):
    """The controller refused a command."""


class StaleState(RobotError):
    """A driver gets no state any more, or state without a time; state that repeats itself trips."""


class InterlockTripped(HilError):
    """An interlock stopped the motion."""

    exit_code = 5


class Stopped(HilError):
    """The run was stopped on request."""

    exit_code = 6

    def __init__(self, message: str, *, hint: str = "", by_signal: bool = False) -> None:
        super().__init__(message, hint=hint)
        self.by_signal = by_signal


class RecordingError(HilError):
    """The recorder cannot keep the data (disk full, writer dead, fallen behind)."""

    exit_code = 7


class DataError(HilError):
    """A data file or run directory is damaged, incomplete or from another version."""

    exit_code = 8


class CheckpointRefused(DataError):
    """A training kept in `folder` cannot be gone on with; without the folder it begins anew."""

    def __init__(self, message: str, *, folder: Path | None = None, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.folder = folder


class FitError(HilError):
    """An estimator cannot fit what it was given."""

    exit_code = 9


class Rejected(HilError):
    """The model missed the acceptance criteria of its spec."""

    exit_code = 10


class RegistryError(HilError):
    """The model registry cannot do what was asked."""

    exit_code = 11


def exit_code_of(error: BaseException) -> int:
    """The documented process exit code for an error (130 for a stop by signal)."""
    if isinstance(error, Stopped) and error.by_signal:
        return 130
    if isinstance(error, KeyboardInterrupt):
        return 130
    return error.exit_code if isinstance(error, HilError) else 1
