"""Observation of a run from a different process (`hil watch`): growing event log and live view."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hil.core import DataError, Rejected, is_live
from hil.evaluation import verdict_word
from hil.recording import RunDirectory
from hil.runs import run_listings
from hil.workflow.live_state import read_live

LOOK_EVERY_S = 0.2


class EventTail:
    """Incremental reader of a growing event log; a line is returned as soon as it is complete.

    Args:
        path: Path of the event log, which possibly does not exist yet.
        from_start: Whether the lines that already exist are also read.
    """

    def __init__(self, path: Path, *, from_start: bool = False) -> None:
        self._path = path
        self._rest = b""
        self._offset = 0 if from_start or not path.exists() else path.stat().st_size

    def read(self) -> list[dict[str, Any]]:
        """Return the events that were added to the log since the last call."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                new = file.read()
        except OSError:
            return []
        self._offset += len(new)
        *lines, self._rest = (self._rest + new).split(b"\n")
        return [event for line in lines if (event := _event(line))]


def _event(line: bytes) -> dict[str, Any] | None:
    try:
        event = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return event if isinstance(event, dict) and "kind" in event else None


def follow(
    run: Path, *, every_s: float = LOOK_EVERY_S, sleep: Callable[[float], object] = time.sleep
) -> Iterator[dict[str, Any]]:
    """Yield the events and live views of a run until the run ends.

    Args:
        run: Run directory; the run may have ended, and its process may have died.
        every_s: Polling interval [s].
        sleep: Function that waits for a number of seconds.

    Yields:
        Documents in the order of time: `{"kind": "event", "event": …}` for every new line of the
        event log, `{"kind": "live", …}` whenever the live view has changed, and last `{"kind":
        "end"}` with `status`, `reason`, `verdict` and `exit_code`.

    Raises:
        DataError: The path is not a run directory.
    """
    directory = RunDirectory.open(run)
    log, seen = EventTail(directory.events_path), 0.0
    while True:
        live = is_live(run)  # checked before reading, so that the last lines are read
        yield from ({"kind": "event", "event": event} for event in log.read())
        view = read_live(run)
        if live and view.get("t", seen) != seen:
            seen = view["t"]
            yield {"kind": "live", **view}
        if not live:
            break
        sleep(every_s)
    yield {"kind": "end", **how_it_ended(directory)}


EXIT_CODES = {"completed": 0, "failed": 4, "tripped": 5, "stopped": 6}
"""Exit code of `hil run` by outcome, for stop documents without an exit code; 1 for other
outcomes."""


def how_it_ended(run: RunDirectory) -> dict[str, Any]:
    """Return status, reason, verdict and exit code of a run that is not live.

    Raises:
        DataError: The documents of the run are damaged.
    """
    stop, status = run.stop or {}, run.status
    verdict = verdict_word(run.path)
    code = stop.get("exit_code", EXIT_CODES.get(status, 1))
    if status == "completed" and verdict == "rejected":
        code = Rejected.exit_code
    reason = str(stop.get("reason", ""))
    if status == "interrupted":
        view = read_live(run.path)
        reached = f" at step {view['step'] + 1} of {view['steps']}" if "step" in view else ""
        reason = f"the process died{reached}; the recorded data are kept"
    return {
        "run": str(run.path),
        "status": status,
        "reason": reason,
        "verdict": verdict,
        "exit_code": code,
    }


def newest_live(runs: Path) -> Path:
    """Return the directory of the live run with the highest number.

    Raises:
        DataError: No run is live.
    """
    live = [listing.path for listing in run_listings(runs) if listing.status == "running"]
    if not live:
        raise DataError(
            f"no run is active under {runs}", hint=f"list all runs: hil runs --runs {runs}"
        )
    return live[-1]


def only_live(runs: Path) -> Path:
    """Return the directory of the only live run.

    Raises:
        DataError: No run is live, or several runs are live.
    """
    live = [listing.path for listing in run_listings(runs) if listing.status == "running"]
    if len(live) > 1:
        named = ", ".join(path.name for path in live)
        raise DataError(f"{len(live)} runs are active: {named}", hint="name one of these runs")
    return newest_live(runs)
