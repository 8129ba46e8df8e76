"""Does a finished recording still have its end? A look at a few bytes, not at the whole file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from mcap.opcode import Opcode

from hil.recording.mcap_records import FOOTER_BYTES, MAGIC, RECORD_HEADER
from hil.recording.recording_files import PARTIAL_SUFFIX


def has_its_end(path: Path) -> bool:
    """Whether a file begins and ends as an MCAP file does; False for one that cannot be read.

    What is between is for `hil.recording.mcap_records.scan` to see.
    """
    end = RECORD_HEADER.size + FOOTER_BYTES + len(MAGIC)
    try:
        with path.open("rb") as file:
            begins = file.read(len(MAGIC)) == MAGIC
            if file.seek(0, 2) < len(MAGIC) + end:
                return False
            file.seek(-end, 2)
            tail = file.read(end)
    except OSError:
        return False
    footer = RECORD_HEADER.pack(Opcode.FOOTER, FOOTER_BYTES)
    return begins and tail.startswith(footer) and tail.endswith(MAGIC)


def has_its_beginning(path: Path) -> bool:
    """Whether a file begins as an MCAP file does; without that, nothing of it can be saved.

    True for one that cannot be read: what is wrong then is something else.
    """
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return True


def torn_although_finished(recordings: Iterable[Path]) -> list[Path]:
    """Recordings that have their final name, but not their end: somebody cut them off."""
    finished = (path for path in recordings if not path.name.endswith(PARTIAL_SUFFIX))
    return [path for path in finished if not has_its_end(path)]
