"""Samples of a run for other programs: Parquet, CSV and numpy files, with where they come from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from hil.core import (
    AnyPath,
    DataError,
    RecordingError,
    did_you_mean,
    json_document,
    path_of,
    write_once,
)
from hil.importers.exporting.files import csv_file, npz_file, parquet_file
from hil.importers.exporting.import_map import import_map, why_no_map
from hil.importers.exporting.table import Table, table_of
from hil.importers.load import load_source

__all__ = ["export_data"]

WRITERS: dict[str, Callable[[Path, Table], None]] = {
    ".parquet": parquet_file,
    ".csv": csv_file,
    ".npz": npz_file,
}


def export_data(source: AnyPath, out: AnyPath) -> dict[str, Any]:
    """Write the samples of a run for other programs: one row each, nothing rounded.

    The rows are those that `hil.dataset` gives: usable ones, each step as it was recorded last.

    Args:
        source: Run directory or MCAP file.
        out: `….parquet`, `….csv` or `….npz`; a CSV file gets `….json`, where it comes from, and
            `….map.yaml`, with which `hil import` reads it, beside it.

    Returns:
        `files`, `samples`, `series`, `columns`, `notes`.

    Raises:
        DataError: The source cannot be read, or no format is called so.
        PluginError: Parquet without pyarrow.
        RecordingError: A file is there already, or cannot be written.
    """
    source, out = path_of(source), path_of(out)
    write = WRITERS.get(out.suffix.lower())
    if write is None:
        raise DataError(
            f"{out} does not say in which format: {did_you_mean(out.suffix, WRITERS)}",
            hint=f"end its name with {', '.join(WRITERS)}",
        )
    files = [out]
    if write is csv_file:
        files += [out.with_suffix(".json"), out.with_suffix(".map.yaml")]
    for file in files:
        if file.exists():
            raise RecordingError(f"{file} exists already", hint="choose another name")
    dataset = load_source(source, any_arm=True)
    table = table_of(dataset, source)
    write(out, table)
    notes: list[str] = []
    if write is csv_file:
        write_once(files[1], json_document(table.about))
        if why := why_no_map(dataset):
            notes, files = [f"no map for hil import: {why}"], files[:2]
        else:
            write_once(files[2], import_map(dataset, table).encode())
    return {
        "files": [str(file) for file in files],
        "samples": len(dataset),
        "series": len(dataset.conditions),
        "columns": [name for name, _, _ in table.flat()],
        "notes": notes,
    }
