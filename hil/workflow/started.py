"""Runs that were started, which need not have a run directory yet; kept in `RUNS/.started/`.

`ID.json` says what was started, `ID.log` is what it prints. A run that dies before it has a run
directory is heard of nowhere else.
"""

from __future__ import annotations

import contextlib
import os
import platform
import signal
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from hil.core import DataError, HilError, read_json, run_holder
from hil.runs import known_runs
from hil.workflow.detached import is_ours, last_lines, ticks_of
from hil.workflow.live_state import read_live
from hil.workflow.steering import stop_run

FOLDER = ".started"


@dataclass(frozen=True, slots=True)
class Started:
    """A run that was started, which need not have a run directory yet.

    Attributes:
        id: Names it below its folder of runs.
        runs: The folder of runs.
        spec, station: What was started; the station is empty for the usual one. Instead of a spec
            the directory of a run that is gone on with.
        operator: Who asked for it.
        pid: Its process.
        ticks: When that began, in the kernel's own count: other processes may get its pid.
        time: When it was started [s, Unix time].
        host: On which computer.
    """

    id: str
    runs: str
    spec: str
    station: str
    operator: str
    pid: int
    ticks: int
    time: float
    host: str

    @property
    def log(self) -> Path:
        """What it prints."""
        return Path(self.runs) / FOLDER / f"{self.id}.log"

    @property
    def alive(self) -> bool:
        """Whether its process still runs."""
        return self.host == platform.node() and 0 < self.ticks == ticks_of(self.pid)

    @property
    def made(self) -> list[Path]:
        """Its run directories: none while it plans, several for a series."""
        if (again := self.again) is not None:
            return [again] if self._holds(again) or self._went_on_with(again) else []
        return known_runs(Path(self.runs)).started_as(self.id)

    @property
    def again(self) -> Path | None:
        """The run that it goes on with; None where it makes one."""
        run, root = Path(self.spec), Path(self.runs).resolve()
        return run if run.is_dir() and run.resolve().is_relative_to(root) else None

    @property
    def last_words(self) -> list[str]:
        """The last lines it printed."""
        return last_lines(self.log)

    def cancel(self, who: str = "") -> None:
        """End it: as `hil stop` where it is live by now, else as Ctrl-C would.

        Does nothing when it has ended.

        Args:
            who: Who asks; recorded. By default whoever started it.

        Raises:
            DataError: Its process is not one that was started here, whatever its record says.
        """
        for run in self.made if self.alive else ():
            if not read_live(run):
                continue  # it plans or connects, which may hang: nobody would take the request
            with contextlib.suppress(HilError):  # its motion is over
                stop_run(run, who=who or self.operator, wait_s=0)
                return
        if not self.alive:
            return
        if not is_ours(self.pid, self.id) and self.alive:  # it has not ended just now
            raise DataError(
                f"process {self.pid} is left alone: it is not what was started as {self.id}",
                hint=f"look at it: ps -fp {self.pid}",
            )
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGTERM)

    def _holds(self, run: Path) -> bool:
        """Held before the way back is planned, and thus before anything is written."""
        holder = run_holder(run)
        return holder is not None and holder.pid == self.pid and self.alive

    def _went_on_with(self, run: Path) -> bool:
        for resumed in run.glob("resume*.json"):
            with contextlib.suppress(DataError):
                if read_json(resumed).get("started_as") == self.id:
                    return True
        return False


def started_runs(runs: Path) -> list[Started]:
    """What was started, the newest first; damaged records are left out."""
    return list(_records(runs))


def _records(runs: Path) -> Iterator[Started]:
    for path in sorted((runs / FOLDER).glob("*.json"), reverse=True):
        with contextlib.suppress(DataError):
            said = read_json(path) | {"id": path.stem, "runs": str(runs)}
            if _is_record(said):
                yield Started(**said)


def _is_record(said: Mapping[str, Any]) -> bool:
    """Whether a document is what was written here: others may have been at it."""
    if said.keys() != {field.name for field in fields(Started)}:
        return False
    texts = [said[key] for key in ("spec", "station", "operator", "host")]
    counts, time_s = [said[key] for key in ("pid", "ticks")], said["time"]
    return (
        all(isinstance(text, str) and "\0" not in text for text in texts)
        and all(isinstance(count, int) and 0 <= count < 2**63 for count in counts)
        and isinstance(time_s, int | float)
        and 0 <= time_s < 2**53
    )
