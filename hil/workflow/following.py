"""Following a run from another process (`hil watch`): event log and live view, as they grow."""

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
    """Reads an event log as it grows; a line counts once it is whole.

    Args:
        path: The log; need not exist yet.
        from_start: Whether the lines that are there already are read, too.
    """

    def __init__(self, path: Path, *, from_start: bool = False) -> None:
        self._path = path
        self._rest = b""
        self._offset = 0 if from_start or not path.exists() else path.stat().st_size

    def read(self) -> list[dict[str, Any]]:
        """Return the events since the last call."""
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
    """Follow a run to its end.

    Args:
        run: The run directory; the run may have ended, or its process died.
        every_s: Time between two looks [s].
        sleep: Waits for that long.

    Yields:
        `{"kind": "event", "event": …}` for every line of the event log from now on,
        `{"kind": "live", …}` whenever the live view has changed, and last `{"kind": "end"}` with
        `status`, `reason`, `verdict` and `exit_code`.

    Raises:
        DataError: It is no run directory.
    """
    directory = RunDirectory.open(run)
    log, seen = EventTail(directory.events_path), 0.0
    while True:
        live = is_live(run)  # before reading: what was written until the end is not missed
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
"""Exit code of `hil run` by outcome, for stop documents without one; 1 for others."""


def how_it_ended(run: RunDirectory) -> dict[str, Any]:
    """Return status, reason, verdict and exit code of a run that is not live.

    Raises:
        DataError: Its documents are damaged.
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
        reason = f"its process died{reached}; what was recorded is kept"
    return {
        "run": str(run.path),
        "status": status,
        "reason": reason,
        "verdict": verdict,
        "exit_code": code,
    }


def newest_live(runs: Path) -> Path:
    """Return the live run with the highest number.

    Raises:
        DataError: No run is live.
    """
    live = [listing.path for listing in run_listings(runs) if listing.status == "running"]
    if not live:
        raise DataError(f"no run is live under {runs}", hint=f"list them: hil runs --runs {runs}")
    return live[-1]


def only_live(runs: Path) -> Path:
    """Return the one live run.

    Raises:
        DataError: No run is live, or several are.
    """
    live = [listing.path for listing in run_listings(runs) if listing.status == "running"]
    if len(live) > 1:
        named = ", ".join(path.name for path in live)
        raise DataError(f"{len(live)} runs are live: {named}", hint="say which one")
    return newest_live(runs)
