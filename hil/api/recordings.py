"""Recordings: their samples in, out, and from other tools."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from hil.api.arguments import AnyPath, AnyPayload, path, payload_of, sources_of
from hil.data.dataset import Dataset


def dataset(*sources: AnyPath | Iterable[AnyPath]) -> Dataset:
    """The samples of run directories or MCAP files, with their conditions.

    Args:
        sources: One or more, or lists of them, of one robot and one kind of effort.

    Returns:
        Columns of N rows by name: `t` (N,) [s]; `q` (N, n) [rad], `qd` (N, n) [rad/s], `effort`
        (N, n) [A or N·m] and what else was recorded.

    Raises:
        DataError: None was given, one cannot be read, or they are of different robots.
        SpecError: One is no path.
    """
    from hil.importers.load import load_source

    return Dataset.concatenate([load_source(source) for source in sources_of(*sources)])


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
    from hil.importers.exporting import export_data as exported

    return exported(path(source), path(out)).to_dict()


def import_recording(
    file: AnyPath,
    *,
    map_file: AnyPath,
    out: AnyPath,
    format_: str | None = None,
    rows: tuple[int, int] | None = None,
    drop_bad_rows: bool = False,
    payload: AnyPayload | None = None,
) -> dict[str, Any]:
    """Turn a recording of another tool into our MCAP.

    Args:
        file: What to import.
        map_file: YAML that says what its columns are.
        out: The MCAP to be made.
        format_: Overrides the map's format.
        rows: First and last row, counted from 1, both included; the map's windows do not apply.
        drop_bad_rows: Leave rows out that make no sense instead of refusing.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a `Payload` that was mounted; 0
            for nothing; by default what the map says.

    Raises:
        SpecError: The map or the payload is not valid.
        DataError: The file holds rows that make no sense (with their line numbers).
    """
    from hil.importers import import_file

    report = import_file(
        path(file),
        path(map_file),
        out=path(out),
        format_=format_,
        rows=rows,
        drop_bad_rows=drop_bad_rows,
        payload=payload_of(payload),
    )
    return report.to_dict()
