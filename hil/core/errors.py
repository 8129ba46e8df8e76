"""Errors that `hil` raises on purpose, with their process exit codes.

::

    HilError                     1   (base class, never raised itself)
    ├── SpecError                2   a spec, station or map file is not valid
    ├── PlanError                2   the spec is well formed, but no safe plan exists for it
    ├── PluginError              2   a driver, estimator or check is missing or broken
    ├── PreflightFailed          3   a check before motion failed
    │   └── NotConfirmed             the motion of a real robot was not confirmed
    ├── RobotError               4   the robot or its connection has a fault
    │   ├── RobotConnectionError     (also ConnectionError)
    │   ├── RobotTimeout             (also TimeoutError)
    │   ├── RobotFault               the controller reports a fault
    │   ├── CommandRefused           the controller refused a command
    │   └── StaleState               the driver receives no data, or data without a time stamp
    ├── InterlockTripped         5   motion was stopped by an interlock
    ├── Stopped                  6   the run was stopped on request (130 if by signal)
    ├── RecordingError           7   the recorder could not store the data
    ├── DataError                8   a data file or run directory is not usable
    │   └── CheckpointRefused        a training checkpoint is damaged or of a different training
    ├── FitError                 9   an estimator cannot fit the data
    ├── Rejected                 10  the model violates its acceptance criteria
    └── RegistryError            11  the model registry cannot complete a request

A rejected *result* (10) has a different exit code than a fault of the *setup* (4, 5, 7).
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar


class HilError(Exception):
    """Base class of all errors of hil, with a message and a hint.

    Args:
        message: Description and location of the problem, complete without the traceback.
        hint: Next action of the user, as a sentence or as a command to type.
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.message}\n  → {self.hint}" if self.hint else self.message


class SpecError(HilError):
    """A spec, station or map file is not usable; `message` contains one line per problem."""

    exit_code = 2


class PlanError(HilError):
    """No safe plan exists for a well-formed spec."""

    exit_code = 2


class PluginError(HilError):
    """A driver, excitation, estimator, check or mock is missing or cannot be loaded."""

    exit_code = 2


class PreflightFailed(HilError):
    """At least one preflight check failed; the message lists all failed checks."""

    exit_code = 3


class NotConfirmed(PreflightFailed):
    """The motion of a real robot was not confirmed; the robot does not move."""


class RobotError(HilError):
    """The robot or the connection to it has a fault."""

    exit_code = 4


class RobotConnectionError(RobotError, ConnectionError):
    """The robot cannot be reached, or the connection was lost."""


class RobotTimeout(RobotError, TimeoutError):
    """The robot did not complete an accepted action in time."""


class RobotFault(RobotError):
    """The controller reports a fault (protective stop, drive fault, emergency stop)."""


class CommandRefused(RobotError):
    """The controller refused a command."""


class StaleState(RobotError):
    """The driver receives no state, or a state without a time stamp.

    If the same state is received repeatedly, an interlock trips, and this error is not raised.
    """


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
    """The recorder cannot store the data (disk full, writer dead, backlog too large)."""

    exit_code = 7


class DataError(HilError):
    """A data file or run directory is damaged, incomplete or from a different version."""

    exit_code = 8


class CheckpointRefused(DataError):
    """The training of a network cannot be continued from the checkpoint in `folder`.

    If the folder of the checkpoint is removed, the training restarts from the beginning.
    """

    def __init__(self, message: str, *, folder: Path | None = None, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.folder = folder


class FitError(HilError):
    """An estimator cannot fit the data."""

    exit_code = 9


class Rejected(HilError):
    """The model violates the acceptance criteria of its spec."""

    exit_code = 10


class RegistryError(HilError):
    """The model registry cannot complete the request."""

    exit_code = 11


def exit_code_of(error: BaseException) -> int:
    """Return the documented process exit code for an error (130 for a stop by signal)."""
    if isinstance(error, Stopped) and error.by_signal:
        return 130
    if isinstance(error, KeyboardInterrupt):
        return 130
    return error.exit_code if isinstance(error, HilError) else 1
