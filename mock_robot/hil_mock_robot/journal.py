"""What a mock robot was told and what it did, line by line: an independent witness of a run.

One JSON object a line. Every line is one `write` to a file opened for appending: it survives the
death of the process, lines of several robots do not mix, and a signal handler may write one.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.core import DataError, RobotConnectionError


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
