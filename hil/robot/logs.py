"""Logs of a robot's bus: drivers whose wire tells everything can make the recording again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from hil.core import StructArray

if TYPE_CHECKING:
    from hil.robot.topic import Topic


class RecordedLog(Protocol):
    """A log, opened."""

    @property
    def topics(self) -> Sequence[Topic]:
        """The further topics that its blocks may hold rows of."""

    def blocks(self) -> Iterator[tuple[StructArray, Mapping[str, StructArray]]]:
        """State rows and rows of further topics, in order, as the driver gave them when it ran.

        Raises:
            DataError: The log is damaged, or was not written on this robot's bus.
        """


@runtime_checkable
class ReadsLogs(Protocol):
    """What a driver's class also offers when a log of its bus holds all that a recording holds."""

    @classmethod
    def read_log(
        cls, log: Path, model: str, options: Mapping[str, Any], robot: Mapping[str, Any]
    ) -> RecordedLog:
        """Open a log; nothing is connected to.

        Args:
            log: The file.
            model: The station's.
            options: The station's, as for the driver itself.
            robot: `start.json: robot` of the run that the log is of: who answered, and what the
                drives had told about themselves.

        Raises:
            DataError: It cannot be read, or the run says too little about the robot.
        """
