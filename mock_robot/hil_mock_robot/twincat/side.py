"""Requests to a mock PLC that runs: lines of JSON at the end of a file.

`echo '{"kind": "emergency_stop", "for_s": 1}' >> side` begins a fault, `{"clear": true}` ends all,
`{"speed": 10}` lets device time pass ten times as fast.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from hil.core import SpecError
from hil_mock_robot.server.faults import Faults
from hil_mock_robot.server.options import factor_of
from hil_mock_robot.twincat.faults import Target


class SideFile:
    """Reads what is appended to a file; lines that were there at the start count, too.

    Args:
        path: The file; it may not exist yet.

    Attributes:
        speed: Device seconds per second that were asked for last; None for no change.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._read = path, 0
        self.speed: float | None = None

    def look(self, faults: Faults[Target]) -> None:
        """Do what was asked for since the last look."""
        try:
            if self._path.stat().st_size == self._read:
                return
            with self._path.open("rb") as file:
                file.seek(self._read)
                whole = file.read().rpartition(b"\n")[0]
        except OSError:
            return
        self._read += len(whole) + 1 if whole else 0
        for number, line in enumerate(whole.splitlines()):
            self._do(f"{self._path}, line {number + 1} of the new ones", line, faults)

    def _do(self, where: str, line: bytes, faults: Faults[Target]) -> None:
        try:
            request = json.loads(line)
            if request == {"clear": True}:
                faults.clear()
            elif isinstance(request, dict) and set(request) == {"speed"}:
                self.speed = factor_of(str(request["speed"]))
            else:
                faults.add(request, where)
        except (ValueError, SpecError) as error:
            print(f"{where}: {error}", file=sys.stderr, flush=True)  # noqa: T201
