"""Requests to a live run, as files dropped into `RUN/.control/`: whole, or not there.

The folder is there while the run listens. A request names the holder of the run's lock it is meant
for, so that one left behind by a crash is not obeyed by whoever resumes the run.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

from hil.core import DataError, RecordingError, fsync_directory, hold_run, json_document, plain
from hil.workflow.live_state import forget_live

FOLDER = ".control"
MOST_BYTES = 64 * 1024

What = Literal["pause", "resume", "stop", "answer"]


@dataclass(frozen=True, slots=True)
class ControlRequest:
    """What somebody asks of a run.

    Attributes:
        what: What to do.
        who: Who asks.
        holder: `id` of the lock of the run as it was seen.
        reason: Why, in words.
        prompt: For `answer`: the whole text that is answered.
        yes: For `answer`: whether it is done.
        asked: For `answer`: number of the prompt (`Standing.asked`); 0 where only its text is
            known.
    """

    what: What
    who: str
    holder: str
    reason: str = ""
    prompt: str = ""
    yes: bool = False
    asked: int = 0

    @property
    def words(self) -> str:
        """For example `asked by anna: lunch`."""
        return f"asked by {plain(self.who)}" + (f": {plain(self.reason)}" if self.reason else "")


_KINDS: dict[str, type] = {"yes": bool, "asked": int}
"""Of fields that are no texts."""


@contextlib.contextmanager
def hold_attempt(run: Path) -> Iterator[None]:
    """Hold a run while inside, and take requests from the first moment: a stop, above all.

    They wait until somebody listens (`hil.workflow.control.Control`). What an attempt has left
    that died, its live view and requests to it, is not of this one.

    Raises:
        DataError, RecordingError: See `hil.core.live_lock.hold_run`.
    """
    with hold_run(run):
        forget_live(run)
        with contextlib.suppress(OSError):  # on a full disk nobody can ask, but the run goes on
            (run / FOLDER).mkdir(exist_ok=True)
        try:
            yield
        finally:
            shutil.rmtree(run / FOLDER, ignore_errors=True)


def drop(run: Path, request: ControlRequest) -> Path:
    """Hand a request over; returns its file, which is gone as soon as the run has taken it.

    Raises:
        DataError: The run does not listen.
        RecordingError: Its directory cannot be written to.
    """
    path = run / FOLDER / f"{time.time_ns():020d}-{os.getpid()}.json"
    draft = path.with_name(f".{path.name}")
    try:
        with draft.open("xb") as file:
            file.write(json_document(asdict(request)))
            file.flush()
            os.fsync(file.fileno())
        draft.rename(path)
        fsync_directory(path.parent)
    except FileNotFoundError as error:
        raise DataError(
            f"{run} does not listen at the moment",
            hint="it is not moving yet, or not any more; see: hil watch",
        ) from error
    except OSError as error:
        raise RecordingError(
            f"cannot write to {run}: {error.strerror or error}",
            hint="ask as the user who started the run, or see who may write there",
        ) from error
    return path


def waiting(run: Path) -> list[Path]:
    """The requests there are, oldest first."""
    try:
        names = sorted(os.listdir(run / FOLDER))
    except OSError:
        return []
    return [run / FOLDER / name for name in names if not name.startswith(".")]


def take(path: Path) -> ControlRequest | str:
    """Remove a request; what it says, or what is wrong with it.

    Raises:
        OSError: It cannot be read or removed, so it must not be obeyed: it would be again.
    """
    with path.open("rb") as file:
        raw = file.read(MOST_BYTES)
    path.unlink()
    try:
        return _request(json.loads(raw))
    except (ValueError, RecursionError) as error:
        return f"not a request: {plain(error)}"


def _request(document: Any) -> ControlRequest:
    if not isinstance(document, dict) or document.get("what") not in get_args(What):
        raise ValueError("it does not say what to do")
    return ControlRequest(**dict(_values(document)))


def _values(document: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for field in fields(ControlRequest):
        value, kind = document.get(field.name), _KINDS.get(field.name, str)
        if value is None and field.name not in ("who", "holder"):
            continue
        if type(value) is not kind:  # a bool is an int as well
            raise ValueError(f"{field.name} is not a {kind.__name__}")
        yield field.name, value
