"""Import of a recording of a different tool into an MCAP file with complete metadata.

The function `import_recording` reads the file with its import map, converts it to SI units, rejects
or drops implausible rows, and writes the samples with their origin. If the import fails, no MCAP
file remains.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np

from hil.arms import AnyPayload, payload_of
from hil.core import (
    AnyPath,
    DataError,
    IntArray,
    RecordingError,
    SpecError,
    StructArray,
    did_you_mean,
    neighbour_of,
    no_file,
    path_of,
    sha256_of,
)
from hil.data import sample_rate
from hil.importers.foreign_samples import ForeignSamples, to_si
from hil.importers.import_map import FileFormat, ImportMap, Window, load_map
from hil.importers.matlab_files import read_matlab
from hil.importers.ros2_bags import read_bag
from hil.importers.series import TORQUE_TARGET
from hil.importers.sources import PAYLOAD_METADATA, ROBOT_METADATA, WINDOW_PAYLOAD
from hil.importers.text_files import read_interleaved, read_table
from hil.recording import McapWriter
from hil.robot import Topic, state_topic, torque_target_topic
from hil.spec import Load

READERS: dict[str, Callable[[Path, ImportMap], ForeignSamples]] = {
    "csv": read_table,
    "ur_rtde": read_table,
    "interleaved": read_interleaved,
    "mat": read_matlab,
    "ros2bag": read_bag,
}


def import_recording(
    file: AnyPath,
    *,
    map_file: AnyPath | ImportMap,
    out: AnyPath,
    format_: str | None = None,
    rows: tuple[int, int] | None = None,
    drop_bad_rows: bool = False,
    payload: AnyPayload | None = None,
) -> dict[str, Any]:
    """Convert a recording of a different tool into an MCAP file of `hil`.

    Args:
        file: Path of the input: a file, or the folder of a bag or of files that belong together.
        map_file: Path of the YAML file that describes the columns, or an `ImportMap`.
        out: Path of the MCAP file to write.
        format_: Input format that overrides the format in the map.
        rows: Numbers of the first and last row, counted from 1 without the header, both included;
            the windows of the map are then ignored.
        drop_bad_rows: Whether to omit implausible rows instead of rejecting the file.
        payload: Payload that is mounted: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a
            `Payload`; 0 for no payload; by default the payload in the map.

    Returns:
        Report of the import with the keys `out`, `source`, `samples`, `dropped` (number of rows),
        positions of the dropped rows (`dropped_lines`, `dropped_messages` or `dropped_samples`) and
        `notes`.

    Raises:
        SpecError: The import map or the payload is invalid.
        DataError: The file contains implausible rows (the message lists their line numbers).
        RecordingError: The output file exists already, its folder does not exist, or it cannot be
            written.
    """
    path, out = path_of(file), path_of(out)
    load = payload_of(payload)
    layout = map_file if isinstance(map_file, ImportMap) else load_map(path_of(map_file))
    layout = _with_format(layout, format_)
    layout = layout if load is None else layout.with_payload(load)
    if not path.exists():
        raise DataError(no_file(path), hint=neighbour_of(path, [path.suffix.casefold()]))
    _require_place(out)
    whole = READERS[layout.format](path, layout)
    numbered = np.arange(1, len(whole) + 1)
    chosen = whole.window(rows) if rows else whole
    samples = to_si(chosen, layout)
    dropped = _dropped_lines(path, samples, drop_bad_rows)
    windows = () if rows else layout.windows_of(path.name)
    first, last = rows or (1, len(whole))
    kept = numbered[first - 1 : last][samples.good]
    good = samples.without_bad_rows()
    segments = _segments(kept, windows)
    origin = _origin(path, layout, rows, samples.place, dropped)
    _write_recording(out, good, segments, layout, origin, windows)
    notes = [*_dropped_notes(samples, dropped), *_load_notes(layout, windows)]
    if rows is None:
        notes += _window_notes(path.name, layout, windows, int(np.sum(segments >= 0)))
    return {
        "out": str(out),
        "source": str(path),
        "samples": len(good),
        "dropped": len(dropped),
        f"dropped_{samples.place}s": dropped,
        "notes": notes,
    }


def _require_place(out: Path) -> None:
    """Raise if the output cannot be created or exists, before a long input is read."""
    if out.exists():
        hint = "choose a different file for -o, or remove that file"
        raise RecordingError(f"{out} exists already", hint=hint)
    if not out.parent.is_dir():
        raise RecordingError(
            f"cannot create {out}: there is no folder {out.parent}",
            hint=f"create it first: mkdir -p {out.parent}",
        )


def _with_format(layout: ImportMap, format_: str | None) -> ImportMap:
    if format_ is None or format_ == layout.format:
        return layout
    if format_ not in get_args(FileFormat):
        raise SpecError(
            f"unknown import format {format_!r}",
            hint=did_you_mean(format_, get_args(FileFormat)),
        )
    return layout.model_copy(update={"format": format_})


def _dropped_lines(path: Path, samples: ForeignSamples, drop_bad_rows: bool) -> list[int]:
    """Return the positions of the implausible rows if they can be dropped.

    Raises:
        DataError: Dropping rows is not allowed, or fewer than two valid rows remain.
    """
    bad = len(samples.problems)
    if bad and not drop_bad_rows:
        listing = "\n".join(samples.listing())
        raise DataError(
            f"{path}: {bad} of {len(samples)} rows are invalid:\n{listing}",
            hint="check the file, or exclude these rows with --drop-bad-rows",
        )
    if len(samples) - bad < 2:
        listing = "\n".join(samples.listing())
        raise DataError(
            f"{path}: only {len(samples) - bad} of {len(samples)} rows are valid:\n{listing}",
            hint="check that the map describes this file",
        )
    return samples.bad_lines


def _segments(rows: IntArray, windows: tuple[Window, ...]) -> IntArray:
    """Return the window index (N,) of each row; −1 for rows outside all windows.

    The row numbers in the argument `rows` start at 1. If there are no windows, all rows form one
    segment.
    """
    if not windows:
        return np.zeros(len(rows), dtype=np.int64)
    segments = np.full(len(rows), -1, dtype=np.int64)
    for number, window in enumerate(windows):
        first, last = window.span
        segments[(rows >= first) & (rows <= last)] = number
    return segments


LISTED_LINES = 1000
"""Maximum number of dropped lines whose positions are stored in the output; the total number of
dropped lines is always stored."""


def _origin(
    path: Path,
    layout: ImportMap,
    rows: tuple[int, int] | None,
    place: str,
    dropped: list[int],
) -> dict[str, str]:
    """Return the origin of the samples as metadata of the output; every value is text."""
    return {
        "source": path.name,
        "source_sha256": json.dumps({file.name: sha256_of(file) for file in _files(path, layout)}),
        "format": layout.format,
        "map": layout.model_dump_json(),
        "rows": f"{rows[0]}:{rows[1]}" if rows else "",
        "dropped": str(len(dropped)),
        f"dropped_{place}s": json.dumps(dropped[:LISTED_LINES]),
    }


def _files(path: Path, layout: ImportMap) -> list[Path]:
    """Return the paths of all files that were read."""
    if layout.format == "ros2bag" and path.is_dir():
        return sorted(file for file in path.iterdir() if file.is_file())
    folder = path if path.is_dir() else path.parent
    named = [layout.columns.t.file, *(q.file for q in layout.quantities().values())]
    read = {folder / name if name else path for name in named}
    return sorted(file for file in read if file.is_file())


def _write_recording(
    out: Path,
    samples: ForeignSamples,
    segments: IntArray,
    layout: ImportMap,
    origin: Mapping[str, str],
    windows: tuple[Window, ...] = (),
) -> None:
    """Write the MCAP file; if writing fails, no file remains.

    Args:
        out: Path of the file to write.
        samples: Valid rows in SI units.
        segments: (N,) window number of each row, −1 outside all windows.
        layout: Import map.
        origin: Metadata that describe the origin of the samples.
        windows: Windows of the segments, in order; the payload of a window is stored if the window
            has a separate payload.

    Raises:
        RecordingError: The output file exists already or cannot be written.
    """
    unit = "A" if layout.effort_kind == "current" else "N·m"
    rate = sample_rate(samples.columns["t"])
    topics = [state_topic(layout.n_joints, rate, clock="file", effort_unit=unit)]
    if TORQUE_TARGET in samples.columns:
        topics.append(torque_target_topic(layout.n_joints, rate, clock="file"))
    metadata: dict[str, Mapping[str, str]] = {
        ROBOT_METADATA: _robot_metadata(layout),
        PAYLOAD_METADATA: _payload_metadata(layout.payload),
        "import": origin,
    }
    for number, window in enumerate(windows):
        if window.payload is not None:
            metadata[WINDOW_PAYLOAD.format(number)] = _payload_metadata(window.payload)
    writer = McapWriter(out, topics, metadata=metadata, joint_names=layout.joint_names)
    try:
        with writer:
            for topic in topics:
                writer.write(topic.name, _rows(topic, samples, segments))
    except BaseException:
        writer.partial_path.unlink(missing_ok=True)
        raise


def _robot_metadata(layout: ImportMap) -> dict[str, str]:
    """Return the robot description and the kind of its efforts, with lists as JSON text."""
    gains = layout.drive_gains_nm_a
    return {
        "model": layout.robot,
        "joint_names": json.dumps(layout.joint_names),
        "effort_kind": layout.effort_kind,
        "drive_gains": json.dumps(gains) if gains else "",
        "drive_gains_source": layout.drive_gains_source,
        "serial": layout.serial,
    }


def _payload_metadata(load: Load) -> dict[str, str]:
    """Return a payload as metadata, with every value as JSON text."""
    return {
        "mass_kg": repr(load.mass_kg),
        "com_m": json.dumps(load.com_m),
        "inertia_kgm2": json.dumps(load.inertia_kgm2),
    }


def _rows(topic: Topic, samples: ForeignSamples, segments: IntArray) -> StructArray:
    block = topic.blank(len(samples))
    block["device_time"] = samples.columns["t"]
    for name, values in (samples.columns | {"segment": segments}).items():
        if name in (topic.dtype.names or ()):
            block[name] = values
    return block


def _dropped_notes(samples: ForeignSamples, dropped: list[int]) -> Iterator[str]:
    if dropped:
        yield f"dropped {len(dropped)} of {len(samples)} rows:"
        yield from samples.listing()


def _window_notes(
    file: str, layout: ImportMap, windows: tuple[Window, ...], inside: int
) -> Iterator[str]:
    if windows:
        yield f"{inside} rows are inside the map's windows; other rows have no trajectory"
    elif layout.windows:
        # Rows outside windows belong to other motions, and a renamed file no longer matches its
        # window.
        yield f"no window of the map matches {file}: all rows used"


def _load_notes(layout: ImportMap, windows: tuple[Window, ...]) -> Iterator[str]:
    """Yield the payloads that are declared for the rows.

    An undeclared payload distorts a fit.
    """
    declared = "payload" in layout.model_fields_set
    own = [(window, window.payload) for window in windows if window.payload is not None]
    for window, load in own:
        yield f"declared load of rows {window.rows}: {load.mass_kg:g} kg"
    if declared:
        yield f"declared load{' of the other rows' if own else ''}: {layout.payload.mass_kg:g} kg"
    elif len(own) < max(1, len(windows)):
        yield (
            f"no load declared{' for the other rows' if own else ''}: 0 kg assumed; "
            "declare one with --payload MASS_KG[,X_M,Y_M,Z_M]"
        )
