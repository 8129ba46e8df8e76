"""`hil recover`: torn MCAP files become whole, indexed ones, without risk to what is there.

The new file is written as a draft, made durable, read back with mcap's own reader and compared
with what was taken from the torn one; only then is it given its name, and only after that is the
torn file set aside as `NN.mcap.torn`. A kill at any point leaves the old state or the new one, and
doing it again goes on from there.
"""

from __future__ import annotations

import contextlib
import os
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO

from hil.core import DataError, RecordingError, fsync_directory, sha256_of
from hil.recording.mcap_records import Layout, scan
from hil.recording.recording_files import hint_of_lost
from hil.recording.recovery_result import Did, Recovery
from hil.recording.salvage import Salvage, never_got_a_message, rebuild, survey, tally_of
from hil.recording.torn_names import (
    Names,
    disk_named,
    held,
    install,
    names_of,
    remove_drafts,
    require_room,
    set_aside,
)


def recover_file(
    path: Path, out: Path | None = None, *, discard: bool = False, part: bool = False
) -> Recovery:
    """Make a torn or damaged MCAP file whole.

    Args:
        path: The file, of this package or any other writer.
        out: Where the whole file goes; nothing else is touched then. By default the whole file
            takes the final name, and the torn one is kept beside it with `.torn` behind its name.
        discard: Delete the torn file once what was made of it has been read back.
        part: It is part of a run: a kill before its first message leaves an empty recording, and
            that is what it becomes.

    Returns:
        What was kept and lost. A file that is whole is left as it is.

    Raises:
        DataError: It is missing or no MCAP file, not one message in it is whole, somebody is
            writing or recovering it, or a file of the final name is there and holds something else.
        RecordingError: The disk refuses, or what was written reads back different. The torn file
            is as it was then.
    """
    if out is not None and out.exists():
        raise DataError(
            f"{out} exists already, and no recording is replaced", hint="give another name: -o FILE"
        )
    names = names_of(Path(path), out)
    with held(names.source) as file:
        layout = scan(file, names.source, places=False)
        remove_drafts(names.final)
        if names.final != names.source and names.final.exists():
            return _finish_an_older_one(file, names, layout, discard)
        found = _sound(file, names, layout) if layout.complete else None
        if found is None:
            return _rebuilt(file, names, layout, discard, part)
    if discard and names.kept is not None and names.kept.exists():
        return recover_file(
            names.kept, discard=True, part=part
        )  # a kill came before it was deleted
    return found


def _finish_an_older_one(file: IO[bytes], names: Names, layout: Layout, discard: bool) -> Recovery:
    """The whole file is there: a recovery was killed before it had set the torn one aside."""
    require_room(names)
    salvage = survey(file, names.source, layout)
    try:
        difference = tally_of(names.final).difference(salvage.tally)
    except RecordingError as error:
        difference = error.message
    if difference:
        raise DataError(
            f"{names.final} is there beside {names.source} and holds something else: {difference}",
            hint="move one of the two away, or give another name: -o FILE",
        )
    torn = set_aside(names, discard)
    did: Did = "nothing" if torn == names.source else "rebuilt" if torn else "discarded"
    return Recovery(names.source, did, names.final, torn, *_lost(layout, salvage), salvage)


def _sound(file: IO[bytes], names: Names, layout: Layout) -> Recovery | None:
    """A file that has its end: is all of it right? None when it is not."""
    found = survey(file, names.source, layout)
    counted = layout.counts is None or sum(layout.counts.values()) == found.tally.messages
    if layout.spoilt or found.damaged or found.orphans or found.misindexed or not counted:
        return None
    if names.kept is None or names.source == names.final:
        return Recovery(names.source, "nothing", names.source, salvage=found)
    with disk_named(names):
        os.fsync(file.fileno())  # its writer may have died before it did that
        names.source.rename(names.final)
        fsync_directory(names.final.parent)
    return Recovery(names.source, "renamed", names.final, salvage=found)


def _rebuilt(file: IO[bytes], names: Names, layout: Layout, discard: bool, part: bool) -> Recovery:
    require_room(names)
    draft = names.final.with_name(f".{names.final.name}.{os.getpid()}.draft")
    try:
        with disk_named(names):
            salvage = _written(file, names, layout, draft, part)
        _compare(draft, names, salvage)
        with disk_named(names):
            install(draft, names)
    finally:
        with contextlib.suppress(OSError):
            draft.unlink(missing_ok=True)
    torn = names.source if names.kept is None else set_aside(names, discard)
    did: Did = "rebuilt" if salvage.tally.messages else "empty"
    return Recovery(names.source, did, names.final, torn, *_lost(layout, salvage), salvage)


def _lost(layout: Layout, salvage: Salvage) -> tuple[str, int]:
    """What was wrong with a file, and how much of it lies behind the tear [bytes]."""
    if not layout.complete:
        return layout.problem, layout.size - layout.good_bytes
    if salvage.damages:
        first = salvage.damages[0]
        return f"damaged: {first.what} at byte {first.offset}", 0
    return layout.problem or "damaged: its index leads elsewhere than to its messages", 0


def _written(file: IO[bytes], names: Names, layout: Layout, draft: Path, part: bool) -> Salvage:
    note = {
        "from": names.source.name,
        "from_sha256": sha256_of(names.source),
        "from_bytes": str(layout.size),
        "whole_bytes": str(layout.good_bytes),
        "problem": layout.problem,
        "recovered": datetime.now(UTC).isoformat(timespec="seconds"),
        "hil": _version(),
    }
    with draft.open("xb") as out:
        salvage = rebuild(file, names.source, layout, out, note)
        empty = part and never_got_a_message(file, layout, salvage)
        if not salvage.tally.messages and not empty:
            raise _nothing(names.source, layout, salvage)
        out.flush()
        os.fsync(out.fileno())
        # What is compared shall come from the disk, not from the kernel's memory.
        os.posix_fadvise(out.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    return salvage


@cache
def _version() -> str:
    try:
        return version("hil")
    except PackageNotFoundError:
        return ""


def _nothing(source: Path, layout: Layout, salvage: Salvage) -> DataError:
    told = [layout.problem] if layout.problem else []
    if salvage.damaged:
        told.append(f"{salvage.damaged} damaged records, the first {salvage.damages[0].what}")
    if salvage.orphans:
        told.append(f"{salvage.orphans} messages of which nothing says what they are")
    return DataError(
        f"there is nothing to rescue in {source}: no message in it is whole"
        + (f" ({'; '.join(told)})" if told else ""),
        hint=hint_of_lost(source),
    )


def _compare(draft: Path, names: Names, salvage: Salvage) -> None:
    """Refuse what does not read back as it was taken from the torn file."""
    with draft.open("rb") as file:
        problem = scan(file, draft, places=False).problem
    if problem or (problem := tally_of(draft).difference(salvage.tally)):
        raise RecordingError(
            f"what was written for {names.final} reads back different: {problem}",
            hint="the disk may be failing: recover to another one with -o FILE; "
            f"{names.source} is as it was",
        )
