"""Import a recording of another tool: read, check, convert, write; all of it or nothing."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np

from hil.arms import AnyPayload, payload_of
from hil.core import (
    AnyPath,
    DataError,
    RecordingError,
    SpecError,
    did_you_mean,
    neighbour_of,
    no_file,
    path_of,
)
from hil.importers.bag import read_bag
from hil.importers.convert import convert
from hil.importers.import_map import FileFormat, ImportMap, Window, load_map
from hil.importers.interleaved import read_interleaved
from hil.importers.mat import read_mat
from hil.importers.raw import Raw
from hil.importers.recording import segments_of, write_recording
from hil.importers.text import read_text

READERS: dict[str, Callable[[Path, ImportMap], Raw]] = {
    "csv": read_text,
    "ur_rtde": read_text,
    "interleaved": read_interleaved,
    "mat": read_mat,
    "ros2bag": read_bag,
}

KEPT_LINE_NUMBERS = 1000
"""Dropped lines that are listed in the output; their number is always given."""


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
    """Turn a recording of another tool into our MCAP.

    Args:
        file: What to import: a file, or the folder of a bag or of files that belong together.
        map_file: YAML that says what its columns are, or an `ImportMap`.
        out: The MCAP to be made.
        format_: Overrides the map's format.
        rows: First and last row, counted from 1 without the header, both included; the map's
            windows do not apply.
        drop_bad_rows: Leave rows out that make no sense instead of refusing.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a `Payload` that was mounted; 0
            for nothing; by default what the map says.

    Returns:
        `out`, `source`, `samples`, `dropped` (how many rows), where these stand
        (`dropped_lines`, `dropped_messages` or `dropped_samples`), `notes`.

    Raises:
        SpecError: The map or the payload is not valid.
        DataError: The file holds rows that make no sense (with their line numbers).
        RecordingError: The output exists already, its folder does not, or it cannot be written.
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
    samples = convert(chosen, layout)
    dropped = _judge(path, samples, drop_bad_rows)
    windows = () if rows else layout.windows_of(path.name)
    first, last = rows or (1, len(whole))
    kept = numbered[first - 1 : last][samples.good]
    good = samples.without_bad_rows()
    segments = segments_of(kept, windows)
    origin = _origin(path, layout, rows, samples.place, dropped)
    write_recording(out, good, segments, layout, origin, windows)
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
    """Before a long file is read: the output can be made there and hides nothing."""
    if out.exists():
        raise RecordingError(f"{out} exists already", hint="choose another -o, or remove that file")
    if not out.parent.is_dir():
        raise RecordingError(
            f"{out} cannot be made: there is no folder {out.parent}",
            hint=f"make it first: mkdir -p {out.parent}",
        )


def _with_format(layout: ImportMap, format_: str | None) -> ImportMap:
    if format_ is None or format_ == layout.format:
        return layout
    if format_ not in get_args(FileFormat):
        raise SpecError(
            f"there is no import format {format_!r}",
            hint=did_you_mean(format_, get_args(FileFormat)),
        )
    return layout.model_copy(update={"format": format_})


def _judge(path: Path, samples: Raw, drop_bad_rows: bool) -> list[int]:
    """Where the bad rows stand, if they may be dropped.

    Raises:
        DataError: They may not, or fewer than two good ones are left.
    """
    bad = len(samples.problems)
    if bad and not drop_bad_rows:
        listing = "\n".join(samples.listing())
        raise DataError(
            f"{path}: {bad} of {len(samples)} rows make no sense:\n{listing}",
            hint="look at the file, or leave these rows out with --drop-bad-rows",
        )
    if len(samples) - bad < 2:
        listing = "\n".join(samples.listing())
        raise DataError(
            f"{path}: only {len(samples) - bad} of {len(samples)} rows make sense:\n{listing}",
            hint="is this the right map for the file?",
        )
    return samples.bad_lines


def _origin(
    path: Path,
    layout: ImportMap,
    rows: tuple[int, int] | None,
    place: str,
    dropped: list[int],
) -> dict[str, str]:
    """What the output says about where it came from; everything as text."""
    return {
        "source": path.name,
        "source_sha256": json.dumps({file.name: _sha256(file) for file in _files(path, layout)}),
        "format": layout.format,
        "map": layout.model_dump_json(),
        "rows": f"{rows[0]}:{rows[1]}" if rows else "",
        "dropped": str(len(dropped)),
        f"dropped_{place}s": json.dumps(dropped[:KEPT_LINE_NUMBERS]),
    }


def _files(path: Path, layout: ImportMap) -> list[Path]:
    """Every file that was read."""
    if layout.format == "ros2bag" and path.is_dir():
        return sorted(file for file in path.iterdir() if file.is_file())
    folder = path if path.is_dir() else path.parent
    named = [layout.columns.t.file, *(q.file for q in layout.quantities().values())]
    found = {folder / name if name else path for name in named}
    return sorted(file for file in found if file.is_file())


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _dropped_notes(samples: Raw, dropped: list[int]) -> Iterator[str]:
    if dropped:
        yield f"dropped {len(dropped)} of {len(samples)} rows:"
        yield from samples.listing()


def _window_notes(
    file: str, layout: ImportMap, windows: tuple[Window, ...], inside: int
) -> Iterator[str]:
    if windows:
        yield f"{inside} rows lie in the map's windows; the others belong to no trajectory"
    elif layout.windows:
        # The arm does other things around a window, and a renamed file loses its own.
        yield f"no window of the map matches {file}: all rows used"


def _load_notes(layout: ImportMap, windows: tuple[Window, ...]) -> Iterator[str]:
    """What every row counts as recorded with: a load nobody declared spoils a fit unnoticed."""
    declared = "payload" in layout.model_fields_set
    own = [(window, window.payload) for window in windows if window.payload is not None]
    for window, load in own:
        yield f"declared load of rows {window.rows}: {load.mass_kg:g} kg"
    if declared:
        yield f"declared load{' elsewhere' if own else ''}: {layout.payload.mass_kg:g} kg"
    elif len(own) < max(1, len(windows)):
        yield (
            f"no load declared{' for the other rows' if own else ''}: 0 kg assumed; "
            "declare one with --payload MASS_KG[,X_M,Y_M,Z_M]"
        )
