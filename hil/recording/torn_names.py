"""The files around a torn recording: who may touch it, and how names change hands.

Every step is one rename (or link) followed by an fsync of the directory, in an order in which no
moment is without a complete set of data: the new file gets its name before the torn one loses its.
"""

from __future__ import annotations

import contextlib
import fcntl
import glob
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from hil.core import DataError, RecordingError, fsync_directory
from hil.recording.recording_files import PARTIAL_SUFFIX, TORN_SUFFIX


@dataclass(frozen=True, slots=True)
class Names:
    """What the files of one recovery are called.

    Attributes:
        source: The torn file.
        final: The whole one.
        kept: Where the torn file goes; None when it stays where it is.
    """

    source: Path
    final: Path
    kept: Path | None


def names_of(path: Path, out: Path | None) -> Names:
    """The names by those of the torn file and, where one is wished for, of the whole one."""
    if out is not None:
        return Names(path, out, None)
    for suffix in (PARTIAL_SUFFIX, TORN_SUFFIX):
        if path.name.endswith(suffix):
            final = path.with_name(path.name.removesuffix(suffix))
            return Names(path, final, final.with_name(final.name + TORN_SUFFIX))
    return Names(path, path, path.with_name(path.name + TORN_SUFFIX))


@contextlib.contextmanager
def held(path: Path) -> Iterator[IO[bytes]]:
    """The torn file, open, and for this process alone as far as writing and recovering go.

    Raises:
        DataError: It cannot be read, or somebody is writing or recovering it.
    """
    try:
        with path.open("rb") as file:
            _lock(file, path)
            if not os.path.samestat(os.fstat(file.fileno()), path.stat()):
                raise _busy(path)  # whoever had it a moment ago has given it another name
            yield file
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror or error}",
            hint="see whether it exists and may be read",
        ) from error


def _lock(file: IO[bytes], path: Path) -> None:
    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise _busy(path) from None
    except OSError:
        pass  # a file system without locks


def _busy(path: Path) -> DataError:
    return DataError(
        f"{path} is not torn: it is being written, or recovered, at this moment",
        hint="wait until that is over; a recording that still goes on needs no recovery",
    )


def install(draft: Path, names: Names) -> None:
    """Give a finished draft its name."""
    if names.source == names.final and names.kept is not None:
        # Both names for the torn file, then the final one for the new: it is never missing.
        if not names.kept.exists():
            os.link(names.source, names.kept)
            fsync_directory(names.final.parent)
        draft.replace(names.final)
    else:
        draft.rename(names.final)
    fsync_directory(names.final.parent)


def set_aside(names: Names, discard: bool) -> Path | None:
    """Give the torn file its last name, or delete it."""
    assert names.kept is not None
    torn = names.kept if names.source == names.final else names.source
    with disk_named(names):
        if discard:
            torn.unlink()
        elif torn != names.kept:
            torn.rename(names.kept)
        fsync_directory(names.final.parent)
    return None if discard else names.kept


def require_room(names: Names) -> None:
    """Refuse where the torn file would take the name of another. Raises `DataError`."""
    kept = names.kept
    if kept is None or kept == names.source or not kept.exists():
        return
    if names.source == names.final and kept.samefile(names.source):
        return
    raise DataError(
        f"{kept} exists already, and a torn file is never replaced",
        hint="move it away, or give another name: -o FILE",
    )


def remove_drafts(final: Path) -> None:
    """Those of recoveries that were killed: who holds the torn file is alone with its drafts."""
    for draft in final.parent.glob(f".{glob.escape(final.name)}.*.draft"):
        with contextlib.suppress(OSError):
            draft.unlink()


@contextlib.contextmanager
def disk_named(names: Names) -> Iterator[None]:
    """What the disk refuses inside, as a `RecordingError`."""
    try:
        yield
    except OSError as error:
        raise RecordingError(
            f"cannot recover {names.source} to {names.final}: {error.strerror or error}",
            hint="mend or free the disk, or recover to another one with -o FILE; "
            "the torn file is as it was",
        ) from error
