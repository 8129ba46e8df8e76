"""Journal of a mock: an independent record of the commands and actions of a run.

The journal contains one JSON object per line. Every line of the journal is written by one `write`
to a file that is opened for appending. A line that has been written therefore survives a crash of
the process, lines of several robots do not mix, and a signal handler can write a line. `RestWatch`
adds the time at which a stopped arm really came to rest, according to the true speed of the arm.
"""

from __future__ import annotations

import json
import math
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import DataError, FloatArray, RobotConnectionError
from hil_mock_robot.server.faults import Fault


@dataclass(frozen=True, slots=True)
class Moment:
    """Time of an event, and the speed of the arm at that time.

    Attributes:
        monotonic_s: Monotonic clock of the computer, equal in all processes [s].
        device_time: Clock of the controller [s].
        speed_rad_s: True speed of the fastest joint [rad/s].
    """

    monotonic_s: float
    device_time: float
    speed_rad_s: float


class Journal:
    """Writer that appends lines to a file, or discards them if there is no file.

    Args:
        path: Path of the file; None for no journal.
        robot: Name of the robot, which every line contains.
    """

    def __init__(self, path: str | None, robot: str) -> None:
        self._path, self._robot = path, robot
        self._file: int | None = None
        self._lost = 0

    def open(self) -> None:
        """Open the file if it is not open; existing lines remain.

        Raises:
            RobotConnectionError: The file cannot be written, so the robot must not start.
        """
        if self._path is None or self._file is not None:
            return
        try:
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
            self._file = os.open(self._path, flags, 0o644)
        except OSError as error:
            raise RobotConnectionError(
                f"{self._robot}: cannot write the journal {self._path}: {error.strerror}",
                hint="give the mock option journal a path in a folder that can be written",
            ) from error

    def note(self, event: str, at: Moment, **details: Any) -> None:
        """Write one line; an error while writing does not disturb the robot."""
        if self._file is None:
            return
        line = {
            "event": event,
            "robot": self._robot,
            "pid": os.getpid(),
            "monotonic_s": round(at.monotonic_s, 6),
            "t": round(time.time() - (time.monotonic() - at.monotonic_s), 6),
            "device_time": round(at.device_time, 6),
            "speed_rad_s": round(at.speed_rad_s, 6) if math.isfinite(at.speed_rad_s) else None,
            **details,
        }
        if self._lost:
            line["lost_lines"] = self._lost
        try:
            os.write(self._file, (json.dumps(line, ensure_ascii=False) + "\n").encode())
            self._lost = 0
        except OSError:
            self._lost += 1

    def close(self) -> None:
        """Close the file; after a new call of `open`, further lines are appended."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def read_journal(path: Path | str) -> list[Mapping[str, Any]]:
    """Return the lines of a journal, in order.

    Raises:
        DataError: The file cannot be read, or a line is not a JSON object.
    """
    try:
        text = Path(path).read_text("utf-8")
        lines = [json.loads(line) for line in text.splitlines()]
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not a readable journal: {error}") from error
    if not all(isinstance(line, dict) for line in lines):
        raise DataError(f"{path}: a line of the journal is not a JSON object")
    return lines


REST_RAD_S = 0.01
"""Speed below which all joints must remain for an arm at rest [rad/s]."""

SURE_AFTER_S = 0.1
"""Device time without a faster joint after which an arm counts as at rest [s]."""


class RestWatch:
    """Observation of the arm from the first stop command until the arm remains at rest.

    Args:
        journal: Journal that receives one line when the arm has come to rest after a stop.

    Attributes:
        resting: Whether the arm is known to be at rest.
    """

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._cause = ""
        self._stopped = Moment(0.0, 0.0, 0.0)
        self._candidate: Moment | None = None
        self.resting = True
        self._told = False

    @property
    def waiting(self) -> bool:
        """Whether the arm was stopped and is not known to be at rest."""
        return bool(self._cause)

    def stopped(self, cause: str, at: Moment) -> None:
        """Begin the observation; further causes of the same stop are ignored."""
        if not self._cause and not self._told:
            self._cause, self._stopped, self._candidate = cause, at, None

    def moved(self) -> None:
        """Record the start of a motion: the arm is not at rest, and earlier stops are over."""
        self._cause, self.resting, self._told = "", False, False

    def see(
        self, device_time: FloatArray, qd: FloatArray, until_s: float, spacing_s: float
    ) -> None:
        """Search samples of a stopped arm for the time at which the arm came to rest.

        Args:
            device_time: Device time of each sample, (N,) [s].
            qd: True joint speeds, (N, n) [rad/s].
            until_s: Monotonic time at which the last sample was due [s].
            spacing_s: Wall time between samples [s].
        """
        if not self._cause or not len(qd):
            return
        fastest = np.abs(qd).max(axis=1)
        # NaN compares false and therefore counts as moving.
        fast = np.flatnonzero(~(fastest < REST_RAD_S))
        first = int(fast[-1]) + 1 if len(fast) else 0
        if len(fast):
            self._candidate = None
        if self._candidate is None and first < len(qd):
            monotonic = until_s - (len(qd) - 1 - first) * spacing_s
            self._candidate = Moment(monotonic, float(device_time[first]), float(fastest[first]))
        found = self._candidate
        if found is not None and device_time[-1] - found.device_time >= SURE_AFTER_S:
            self._tell(found)

    def locked(self, cause: str, at: Moment) -> None:
        """Record that the closed brakes keep the arm at rest from this time on."""
        self.stopped(cause, at)
        if self._cause:
            self._tell(at)

    def finish(self) -> None:
        """End the observation because the robot is closed; an apparent rest counts as rest."""
        if self._cause and self._candidate is not None:
            self._tell(self._candidate)

    def _tell(self, found: Moment) -> None:
        self._journal.note(
            "rest",
            found,
            after=self._cause,
            device_s=round(found.device_time - self._stopped.device_time, 6),
            wall_s=round(max(0.0, found.monotonic_s - self._stopped.monotonic_s), 6),
        )
        self._cause, self.resting, self._told = "", True, True


class Witness(ABC):
    """Writer of the journal of a mock; subclasses add the events of its clients and parts.

    The journal is independent of what clients report.

    Args:
        journal: Journal to write.
    """

    def __init__(self, journal: Journal) -> None:
        self._journal, self._rest = journal, RestWatch(journal)

    @abstractmethod
    def moment(self) -> Moment:
        """Return the present times and the speed of the arm."""

    def note(self, event: str, **details: Any) -> None:
        """Write one line about an event to the journal."""
        self._journal.note(event, self.moment(), **details)

    def struck(self, fault: Fault[Any], begins: bool) -> None:
        """Write to the journal that an injected fault begins or ends."""
        self.note("fault" if begins else "fault_over", kind=fault.kind)

    def stumbled(self, where: str, what: str) -> None:
        """Write that an internal error of the mock occurred and was contained."""
        self.note("mishap", where=where, what=what)

    def close(self, **details: Any) -> None:
        """Write the last line of the journal and close the journal."""
        self._rest.finish()
        self.note("closed", **details)
        self._journal.close()


def journal_of(path: Path | str | None, robot: str) -> Journal:
    """Return the open journal of a mock; a journal without a path discards all lines.

    Raises:
        RobotConnectionError: The file cannot be written.
    """
    journal = Journal(str(path) if path else None, robot)
    journal.open()
    return journal
