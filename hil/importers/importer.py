"""Import a recording of another tool: read, check, convert, write; all of it or nothing."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from hil.arms import Payload
from hil.core import DataError, RecordingError, SpecError, did_you_mean, neighbour_of, no_file
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


@dataclass(frozen=True, slots=True)
class ImportReport:
    """What an import did.

    Attributes:
        out: The MCAP written.
        source: What was imported.
        samples: Rows written.
        dropped: Where the rows that were left out stand in the file.
        place: What `dropped` counts: `line`, `message` or `sample`.
        notes: For people.
    """

    out: Path
    source: Path
    samples: int
    dropped: tuple[int, ...]
    place: str
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "out": str(self.out),
            "source": str(self.source),
            "samples": self.samples,
            "dropped": len(self.dropped),
            f"dropped_{self.place}s": list(self.dropped),
            "notes": list(self.notes),
        }


def import_file(
    path: Path,
    map_: ImportMap | Path,
    *,
    out: Path,
    format_: str | None = None,
    rows: tuple[int, int] | None = None,
    drop_bad_rows: bool = False,
    payload: Payload | None = None,
) -> ImportReport:
    """Turn a file into an MCAP with the base robot record.

    Args:
        path: The file (or the folder of a bag or of files that belong together).
        map_: What its columns are: an `ImportMap` or the path of its YAML.
        out: The MCAP to be made.
        format_: Overrides the map's format.
        rows: First and last row, counted from 1 without the header, both included; the map's
            windows then do not apply.
        drop_bad_rows: Leave bad rows out, with a note in the output, instead of refusing.
        payload: What was mounted, instead of what the map says.

    Raises:
        SpecError: The map is not valid.
        DataError: The file cannot be read, or rows make no sense.
        RecordingError: The output exists already, its folder does not, or it cannot be written.
    """
    layout = map_ if isinstance(map_, ImportMap) else load_map(map_)
    layout = _with_format(layout, format_)
    layout = layout if payload is None else layout.with_payload(payload)
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
    return ImportReport(out, path, len(good), tuple(dropped), samples.place, tuple(notes))


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
