"""The files themselves; each is whole or not there."""

from __future__ import annotations

import contextlib
import csv
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hil.core import RecordingError, fsync_directory, json_line, plugins
from hil.importers.exporting.table import Table

_ROWS = 20_000
"""Rows that are text at a time."""

METADATA = "hil"
"""Key of where the samples come from, in Parquet and npz alike."""


def csv_file(out: Path, table: Table) -> None:
    """Numbers as short as they can be without losing a bit; nothing where none is known."""
    columns = table.flat()
    with _whole(out) as draft, draft.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(name for name, _, _ in columns)
        for first in range(0, len(columns[0][2]), _ROWS):
            parts = (values[first : first + _ROWS] for _, _, values in columns)
            writer.writerows(zip(*(_known(part.tolist()) for part in parts), strict=True))


def _known(values: list[object]) -> list[object]:
    return ["" if value != value else value for value in values]


def npz_file(out: Path, table: Table) -> None:
    """Columns as in a dataset, (N, n); `hil` is where they come from, JSON. Nothing is pickled."""
    arrays = {**table.columns, **table.labels, METADATA: np.array(json_line(table.about))}
    with _whole(out) as draft, draft.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def parquet_file(out: Path, table: Table) -> None:
    """Flat columns with their units; `hil` in the metadata of the schema, JSON.

    Raises:
        PluginError: pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise plugins.not_installed(
            "Parquet", ["pyarrow"], "parquet", otherwise="export to .csv or .npz"
        ) from None
    columns = [(name, unit, pa.array(values)) for name, unit, values in table.flat()]
    fields = [
        pa.field(name, values.type, metadata={"unit": unit} if unit else None)
        for name, unit, values in columns
    ]
    schema = pa.schema(fields, metadata={METADATA: json_line(table.about)})
    whole = pa.table([values for _, _, values in columns], schema=schema)
    # Opened here: pyarrow takes no path that is not UTF-8.
    with _whole(out) as draft, draft.open("wb") as file:
        pq.write_table(whole, file, compression="zstd")


@contextlib.contextmanager
def _whole(out: Path) -> Iterator[Path]:
    """A draft that becomes the file when all is well.

    Raises:
        RecordingError: The disk refuses.
    """
    draft = out.with_name(f".{out.name}.{os.getpid()}.draft")
    try:
        yield draft
        with draft.open("rb") as file:
            os.fsync(file.fileno())
        draft.rename(out)
        fsync_directory(out.parent)
    except OSError as error:
        raise RecordingError(
            f"cannot write {out}: {error.strerror or error}", hint="choose another place for it"
        ) from error
    finally:
        draft.unlink(missing_ok=True)
