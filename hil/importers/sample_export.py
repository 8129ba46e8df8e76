"""Export of the samples of a run for other programs: Parquet, CSV and npz files.

Every exported file contains the rows of `hil.dataset`, one row per sample, with their units and
their origin. A CSV file cannot contain the origin of the samples, so that a JSON file with the
origin and an import map for `hil import` are written next to the CSV file.
"""

from __future__ import annotations

import contextlib
import csv
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hil.arms import Payload
from hil.core import (
    AnyPath,
    DataError,
    RecordingError,
    did_you_mean,
    fsync_directory,
    json_document,
    json_line,
    path_of,
    plugins,
    read_json,
    sha256_of,
    write_once,
    yaml_text,
)
from hil.data import UPRIGHT, Dataset
from hil.importers.import_map import QUANTITIES
from hil.importers.sources import load_source, serial_of
from hil.recording import package_versions, utc_now

Values: TypeAlias = NDArray[Any]


def export_data(source: AnyPath, out: AnyPath) -> dict[str, Any]:
    """Write the samples of a run for other programs: one row per sample, without rounding.

    The exported rows are the usable rows of `hil.dataset`, with the last recording of each step.

    Args:
        source: Path of a run directory or MCAP file.
        out: Path of the output: `….parquet`, `….csv` or `….npz`. Two files are written next to a
            CSV file: `….json` with the origin, and `….map.yaml`, an import map for `hil import`.

    Returns:
        Report of the export with the keys `files`, `samples`, `series`, `columns` and `notes`.

    Raises:
        DataError: The source cannot be read, or the file name extension is unknown.
        PluginError: The format is Parquet, and pyarrow is not installed.
        RecordingError: An output file exists already or cannot be written.
    """
    source, out = path_of(source), path_of(out)
    write = WRITERS.get(out.suffix.lower())
    if write is None:
        raise DataError(
            f"{out} has no known file name extension: {did_you_mean(out.suffix, WRITERS)}",
            hint=f"use one of {', '.join(WRITERS)}",
        )
    files = [out]
    if write is _write_csv:
        files += [out.with_suffix(".json"), out.with_suffix(".map.yaml")]
    for file in files:
        if file.exists():
            raise RecordingError(f"{file} exists already", hint="choose a different name")
    dataset = load_source(source, any_arm=True)
    table = _table_of(dataset, source)
    write(out, table)
    notes: list[str] = []
    if write is _write_csv:
        write_once(files[1], json_document(table.about))
        if why := _why_no_map(dataset):
            notes, files = [f"no map for hil import: {why}"], files[:2]
        else:
            write_once(files[2], _import_map(dataset, table).encode())
    return {
        "files": [str(file) for file in files],
        "samples": len(dataset),
        "series": len(dataset.conditions),
        "columns": [name for name, _, _ in table.flat()],
        "notes": notes,
    }


# Table of samples


UNITS = {
    "t": "s", "q": "rad", "qd": "rad/s", "qdd": "rad/s²", "temperature": "°C", "q_target": "rad",
    "qd_target": "rad/s", "qdd_target": "rad/s²", "torque_target": "N·m",
}  # fmt: skip
_UNITS_IN_NAMES = {
    "s": "s", "rad": "rad", "rad/s": "rad_s", "rad/s²": "rad_s2", "°C": "c", "A": "a", "N·m": "nm",
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """Samples with labels, units and origin.

    Attributes:
        columns: Arrays (N,) or (N, n) by name of the dataset column.
        labels: Arrays (N,) by label; a label describes the step of each row.
        units: Unit of each dataset column, by column name.
        about: Origin of the samples as strict JSON data.
    """

    columns: Mapping[str, Values]
    labels: Mapping[str, Values]
    units: Mapping[str, str]
    about: Mapping[str, Any]

    def flat(self) -> list[tuple[str, str, Values]]:
        """Return name, unit and values of one-dimensional columns.

        The column names are `t_s`, `q_1_rad`, … `kind`.
        """
        columns: list[tuple[str, str, Values]] = []
        for name, values in self.columns.items():
            unit = self.units[name]
            if values.ndim == 1:
                columns.append((_flat_name(name, unit), unit, values))
            else:
                columns += [
                    (_flat_name(name, unit, j + 1), unit, values[:, j])
                    for j in range(values.shape[1])
                ]
        return columns + [(name, "", values) for name, values in self.labels.items()]


def _flat_name(column: str, unit: str, joint: int = 0) -> str:
    """Return the name of the column of one joint (counted from 1), or of a single column."""
    return "_".join(filter(None, (column, str(joint or ""), _UNITS_IN_NAMES[unit])))


def _table_of(dataset: Dataset, source: Path) -> _Table:
    units = UNITS | dict.fromkeys(("effort", "effort_target"), dataset.effort_unit)
    columns = {name: dataset[name] for name in ("t", *sorted(set(dataset.columns) - {"t"}))}
    units = {name: units[name] for name in columns}
    about = _about(dataset, source) | {"units": units}
    return _Table(columns, _labels(dataset), units, about)


def _labels(dataset: Dataset) -> dict[str, Values]:
    series = dataset.series_index()
    labels: dict[str, list[Any]] = {
        name: [getattr(one, name) for one in dataset.conditions]
        for name in ("kind", "trajectory", "pose", "approach", "load", "attempt")
    }
    labels["settled"] = [int(one.settled) for one in dataset.conditions]
    labels["load_mass_kg"] = [one.payload.mass for one in dataset.conditions]
    return {"series": series} | {name: np.array(each)[series] for name, each in labels.items()}


EXPORT_FORMAT = 1

_KEYS_OF_START = (
    "uid", "started", "operator", "host", "experiment", "robot_name", "seed", "spec_hash",
    "plan_hash", "git", "packages", "occasion",
)  # fmt: skip


def _about(dataset: Dataset, source: Path) -> dict[str, Any]:
    """Return the origin of the samples of a run or file.

    Raises `DataError` if a document of the source cannot be read.
    """
    recordings, run = [source], None
    if source.is_dir():
        recordings = sorted(source.glob("recording/*.mcap*"))
        start = read_json(source / "start.json")
        run = {key: start[key] for key in _KEYS_OF_START if key in start}
    return {
        "hil_export": EXPORT_FORMAT,
        "hil": package_versions().get("hil", ""),
        "exported": utc_now(),
        "source": source.resolve().name,
        "recordings_sha256": {file.name: sha256_of(file) for file in recordings},
        "run": run,
        "robot": dataset.robot,
        "serial": serial_of(source),
        "joint_names": list(dataset.joint_names),
        "effort_kind": dataset.effort_kind,
        "drive_gains_nm_a": None if dataset.drive_gains is None else dataset.drive_gains.tolist(),
        "drive_gains_source": dataset.drive_gains_source,
        "gravity_m_s2": list(dataset.gravity),
        "series": [
            {"id": one.id, "rows": [rows.start, rows.stop], "payload": _load_of(one.payload)}
            for one, rows in dataset.slices()
        ],
    }


def _load_of(load: Payload) -> dict[str, Any]:
    """Return a payload in the form that documents and import maps use."""
    return {"mass_kg": load.mass, "com_m": list(load.com), "inertia_kgm2": list(load.inertia)}


# Files; an interrupted export leaves no incomplete file


_METADATA = "hil"
"""Key under which Parquet and npz files store the origin of the samples."""

_ROWS = 20_000
"""Number of rows that are converted to text in one step."""


def _write_csv(out: Path, table: _Table) -> None:
    """Write the shortest text of each number that preserves all bits; NaN becomes empty text."""
    columns = table.flat()
    with _whole(out) as draft, draft.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(name for name, _, _ in columns)
        for first in range(0, len(columns[0][2]), _ROWS):
            parts = (values[first : first + _ROWS].tolist() for _, _, values in columns)
            known = (["" if value != value else value for value in part] for part in parts)
            writer.writerows(zip(*known, strict=True))


def _write_npz(out: Path, table: _Table) -> None:
    """Write the columns of a dataset (N, n) to an npz file without pickle.

    The array `hil` contains the origin as JSON text.
    """
    arrays = {**table.columns, **table.labels, _METADATA: np.array(json_line(table.about))}
    with _whole(out) as draft, draft.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _write_parquet(out: Path, table: _Table) -> None:
    """Write one-dimensional columns with their units to a Parquet file.

    The key `hil` of the schema metadata contains the origin as JSON text.

    Raises:
        PluginError: The package pyarrow is not installed.
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
    schema = pa.schema(fields, metadata={_METADATA: json_line(table.about)})
    whole = pa.table([values for _, _, values in columns], schema=schema)
    # The file is opened here, because pyarrow does not support paths that are not UTF-8.
    with _whole(out) as draft, draft.open("wb") as file:
        pq.write_table(whole, file, compression="zstd")


@contextlib.contextmanager
def _whole(out: Path) -> Iterator[Path]:
    """Yield the path of a draft, which gets the final name after the block.

    Raises:
        RecordingError: The draft cannot be written.
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
            f"cannot write {out}: {error.strerror or error}", hint="choose a different folder"
        ) from error
    finally:
        draft.unlink(missing_ok=True)


WRITERS: dict[str, Callable[[Path, _Table], None]] = {
    ".parquet": _write_parquet,
    ".csv": _write_csv,
    ".npz": _write_npz,
}


# Import map of a CSV file, with trajectories as windows


def _why_no_map(dataset: Dataset) -> str:
    """Return why an import map cannot describe a dataset; empty if the map can describe it."""
    if not any(one.kind == "trajectory" for one in dataset.conditions):
        return "imported rows must be trajectories, and the samples contain none"
    if tuple(dataset.gravity) != UPRIGHT:
        return "an import map describes upright arms only"
    if np.any(np.diff(dataset["t"]) <= 0):
        return "the device clock restarted when the run was resumed"
    return ""


def _import_map(dataset: Dataset, table: _Table) -> str:
    """Return the import map as YAML text, for `hil import FILE.csv --map FILE.map.yaml`."""
    windows = [
        {"rows": f"{rows.start + 1}:{rows.stop}", "payload": _load_of(one.payload)}
        for one, rows in dataset.slices()
        if one.kind == "trajectory"
    ]
    document: dict[str, Any] = {
        "hil_map": 1,
        "description": f"samples of {table.about['source']}, written by hil export-data",
        "format": "csv",
        "header": True,
        "robot": dataset.robot,
        "joint_names": list(dataset.joint_names),
        "effort_kind": dataset.effort_kind,
        "serial": table.about["serial"],
        "columns": {"t": {"columns": [_flat_name("t", "s")]}, **_quantities(dataset, table)},
        "windows": windows,
    }
    if dataset.drive_gains is not None:
        document["drive_gains_nm_a"] = dataset.drive_gains.tolist()
        document["drive_gains_source"] = dataset.drive_gains_source
    return yaml_text(document, block=True, width=120)


def _quantities(dataset: Dataset, table: _Table) -> dict[str, Any]:
    """Return the quantities that have no unknown values."""
    known = {}
    for name in QUANTITIES:
        if name in table.columns and np.all(np.isfinite(table.columns[name])):
            unit = table.units[name]
            names = [_flat_name(name, unit, j + 1) for j in range(dataset.n_joints)]
            known[name] = {"columns": names, "unit": unit}
    return known
