"""What to do about a recording of which nothing can be saved."""

from __future__ import annotations

from pathlib import Path

from hil.core import DataError
from hil.recording.recording_files import hint_of_lost, run_of


def no_mcap(path: Path) -> DataError:
    """Of a file that does not begin as MCAP files do: one of a run did once."""
    if run_of(path) is not None:
        message = f"{path} is not an MCAP file any more: its beginning is lost"
        return DataError(message, hint=hint_of_lost(path))
    return DataError(
        f"{path} is not an MCAP file: it does not begin with the MCAP magic bytes",
        hint="other formats are read by `hil import`",
    )
