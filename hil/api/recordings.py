"""Recordings: their samples in, out, and from other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hil.api.arguments import AnyPath
from hil.data.dataset import Dataset


def dataset(*sources: AnyPath) -> Dataset:
    """The samples of run directories or MCAP files, with their conditions."""
    from hil.data.load import load_source

    return Dataset.concatenate([load_source(Path(source)) for source in sources])


def export_data(source: AnyPath, out: AnyPath) -> dict[str, Any]:
    """Write the samples of a run for other programs: one row each, nothing rounded.

    Args:
        source: Run directory or MCAP file.
        out: `….parquet`, `….csv` or `….npz`.

    Returns:
        `files`, `samples`, `series`, `columns`, `notes`.

    Raises:
        DataError: The source cannot be read, or no format is called so.
        PluginError: Parquet without pyarrow.
        RecordingError: A file is there already, or cannot be written.
    """
    from hil.data.exporting import export_data as exported

    return exported(Path(source), Path(out)).to_dict()


def import_recording(
    file: AnyPath,
    *,
    map_file: AnyPath,
    out: AnyPath,
    format_: str | None = None,
    rows: tuple[int, int] | None = None,
    drop_bad_rows: bool = False,
    payload: str | None = None,
) -> dict[str, Any]:
    """Turn a recording of another tool into our MCAP.

    Args:
        file: What to import.
        map_file: YAML that says what its columns are.
        out: The MCAP to be made.
        format_: Overrides the map's format.
        rows: First and last row, counted from 1, both included; the map's windows do not apply.
        drop_bad_rows: Leave rows out that make no sense instead of refusing.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m] that was mounted; by default what the map says.

    Raises:
        SpecError: The map or the payload is not valid.
        DataError: The file holds rows that make no sense (with their line numbers).
    """
    from hil.data.importing import import_file
    from hil.fitting import parse_payload

    report = import_file(
        Path(file),
        Path(map_file),
        out=Path(out),
        format_=format_,
        rows=rows,
        drop_bad_rows=drop_bad_rows,
        payload=parse_payload(payload) if payload else None,
    )
    return report.to_dict()
