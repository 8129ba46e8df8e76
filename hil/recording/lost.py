"""What to do about a recording of which nothing can be saved."""

from __future__ import annotations

from pathlib import Path

from hil.core import DataError
from hil.recording.parts import recordings_in

_MOST_NAMED = 3


def is_recording_of_a_run(path: Path) -> bool:
    """Whether a file lies where the recordings of a run do."""
    folder = path.resolve().parent
    return folder.name == "recording" and (folder.parent / "start.json").is_file()


def no_mcap(path: Path) -> DataError:
    """Of a file that does not begin as MCAP files do: one of a run did once."""
    if is_recording_of_a_run(path):
        message = f"{path} is not an MCAP file any more: its beginning is lost"
        return DataError(message, hint=hint_of_lost(path))
    return DataError(
        f"{path} is not an MCAP file: it does not begin with the MCAP magic bytes",
        hint="other formats are read by `hil import`",
    )


def hint_of_lost(path: Path) -> str:
    """That nothing can be saved, and which other recordings of the same run there are."""
    told = "hil can save nothing of it: take it from a copy"
    if not is_recording_of_a_run(path):
        return told
    names = [other.name for other in recordings_in(path.parent) if other.name != path.name]
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    listed = ", ".join(names[:_MOST_NAMED]) + more
    return f"{told}; usable by itself is {listed} beside it" if names else told
