"""The journal of a mock: its commands and actions, an independent record of a run.

One JSON object a line. Every line is one `write` to a file opened for appending: it survives the
death of the process, lines of several robots do not mix, and a signal handler may write one.
`RestWatch` adds when a stopped arm truly came to rest, judged by its true speed.
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
    """When something happened, and how fast the arm was.

    Attributes:
        monotonic_s: The machine's monotonic clock, the same in all processes [s].
        device_time: The controller's clock [s].
        speed_rad_s: True speed of the fastest joint.
    """

    monotonic_s: float
    device_time: float
    speed_rad_s: float


class Journal:
    """Appends lines to a file, or does nothing.

    Args:
        path: The file; None for no journal.
        robot: The robot's name, in every line.
    """

    def __init__(self, path: str | None, robot: str) -> None:
        self._path, self._robot = path, robot
        self._file: int | None = None
        self._lost = 0

    def open(self) -> None:
        """Open the file, if it is not; older lines stay.

        Raises:
            RobotConnectionError: It cannot be written: a robot without its witness stays off.
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
        """Write one line; a disk that refuses does not disturb the robot."""
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
        """Close the file; `open` goes on where it ended."""
        if self._file is not None:
            os.close(self._file)
            self._file = None


def read_journal(path: Path | str) -> list[Mapping[str, Any]]:
    """The lines of a journal, in order.

    Raises:
        DataError: There is no such file, or a line is not a JSON object.
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
"""An arm whose joints are all slower than this, and stay so, is at rest."""

SURE_AFTER_S = 0.1
"""Device time without a faster joint after which an arm counts as staying at rest."""


class RestWatch:
    """Follows the arm from the first command to stop to the first moment it stays at rest.

    Args:
        journal: Gets a line once after each motion.

    Attributes:
        resting: Whether it is known to be at rest.
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
        """Begin; later causes of the same stop change nothing."""
        if not self._cause and not self._told:
            self._cause, self._stopped, self._candidate = cause, at, None

    def moved(self) -> None:
        """A motion begins: whatever came before, the arm is not at rest."""
        self._cause, self.resting, self._told = "", False, False

    def see(
        self, device_time: FloatArray, qd: FloatArray, until_s: float, spacing_s: float
    ) -> None:
        """Look for rest in samples, once the arm was stopped.

        Args:
            device_time: (N,) of each sample [s].
            qd: (N, n) true joint speeds [rad/s].
            until_s: Monotonic time of the last sample.
            spacing_s: Wall time between samples.
        """
        if not self._cause or not len(qd):
            return
        fastest = np.abs(qd).max(axis=1)
        # NaN is no rest, and compares false.
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
        """The mechanical brakes hold the arm from this moment on."""
        self.stopped(cause, at)
        if self._cause:
            self._tell(at)

    def finish(self) -> None:
        """End the watch, because the robot is closed: apparent rest counts as rest."""
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
    """Writes the journal of a mock; subclasses add the events of its clients and parts.

    It does not know what a client believes to have done.

    Args:
        journal: Where it is written.
    """

    def __init__(self, journal: Journal) -> None:
        self._journal, self._rest = journal, RestWatch(journal)

    @abstractmethod
    def moment(self) -> Moment:
        """Return the present time and speed."""

    def note(self, event: str, **details: Any) -> None:
        """Write a line."""
        self._journal.note(event, self.moment(), **details)

    def struck(self, fault: Fault[Any], begins: bool) -> None:
        """A fault on request begins or is over."""
        self.note("fault" if begins else "fault_over", kind=fault.kind)

    def stumbled(self, where: str, what: str) -> None:
        """The mock itself has made a mistake, and goes on."""
        self.note("mishap", where=where, what=what)

    def close(self, **details: Any) -> None:
        """The last line."""
        self._rest.finish()
        self.note("closed", **details)
        self._journal.close()


def journal_of(path: Path | str | None, robot: str) -> Journal:
    """The journal of a mock, open; one without a file does nothing.

    Raises:
        RobotConnectionError: It cannot be written.
    """
    journal = Journal(str(path) if path else None, robot)
    journal.open()
    return journal
