"""Files with one value per line, the joints of a sample behind each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hil.core import DataError, FloatArray
from hil.importers.import_map import ImportMap
from hil.importers.raw import Raw


def read_interleaved(path: Path, layout: ImportMap) -> Raw:
    """Read one file per quantity, n values a sample (time: one).

    The samples of all files belong together by their number; a bad value spoils its sample.

    Raises:
        DataError: A file cannot be read or is empty.
    """
    folder = path if path.is_dir() else path.parent
    files = {
        name: (quantity.file, layout.n_joints) for name, quantity in layout.quantities().items()
    }
    if layout.columns.t.rate_hz is None:
        files["t"] = (layout.columns.t.file, 1)
    blocks: dict[str, FloatArray] = {}
    problems: list[tuple[int, str]] = []
    for name, (file, width) in files.items():
        source = path if file is None else folder / file
        blocks[name], found = _samples(source, width)
        problems += found
    longest = max(len(block) for block in blocks.values())
    raw = Raw({}, np.arange(1, longest + 1), "sample")
    for row, why in problems:
        raw.blame(row, why)
    for name, block in blocks.items():
        short = longest - len(block)
        for row in range(len(block), longest):
            raw.blame(row, f"{files[name][0] or path.name} ends before")
        padded = np.pad(block, ((0, short), (0, 0)), constant_values=np.nan)
        raw.columns[name] = padded[:, 0] if name == "t" else padded
    return raw


def _samples(path: Path, width: int) -> tuple[FloatArray, list[tuple[int, str]]]:
    """(N, width) values and the samples that are no good."""
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(
            f"cannot read {path}: {error}", hint="see whether it exists and may be read"
        ) from error
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        raise DataError(f"{path} holds no values", hint="is it the whole file?")
    values, problems = _numbers(path, lines, width)
    rest = len(values) % width
    if rest:
        problems.append((len(values) // width, f"{path.name} ends within a sample"))
        values = np.pad(values, (0, width - rest), constant_values=np.nan)
    return values.reshape(-1, width), problems


def _numbers(path: Path, lines: list[str], width: int) -> tuple[FloatArray, list[tuple[int, str]]]:
    try:
        return np.array(lines, dtype=np.float64), []
    except ValueError:
        pass
    values = np.full(len(lines), np.nan)
    problems = []
    for i, line in enumerate(lines):
        try:
            values[i] = float(line)
        except ValueError:
            problems.append((i // width, f"{path.name} line {i + 1} is no number: {line[:20]}"))
    return values, problems
