"""Reading of text files: tables (CSV, ur_rtde recordings) and files with one value per line.

A table can have any delimiter, and it can have a header. The columns of a table are addressed by
name or number, and the quantities can be distributed over several parallel files (`read_table`).
Some loggers do not write tables: they write one file per quantity, with one value per line and the
joints of a sample on consecutive lines (`read_interleaved`).
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from hil.core import DataError, FloatArray, IntArray, did_you_mean
from hil.importers.foreign_samples import ForeignSamples
from hil.importers.import_map import Address, ImportMap

# Tables


RTDE_NAMES = {
    "q": "actual_q_{}",
    "qd": "actual_qd_{}",
    "effort": "actual_current_{}",
    "temperature": "joint_temperatures_{}",
    "q_target": "target_q_{}",
    "qd_target": "target_qd_{}",
    "qdd_target": "target_qdd_{}",
    "effort_target": "target_current_{}",
    "torque_target": "target_moment_{}",
}
"""Column names that `startFileRecording` of ur_rtde and record.py of UR write, with joints
counted from 0."""

RTDE_TIME = "timestamp"


def read_table(path: Path, layout: ImportMap) -> ForeignSamples:
    """Return the columns that are named in a map, from one or several parallel files.

    Raises:
        DataError: A file cannot be read, or a column is missing.
    """
    wanted = _wanted_columns(layout)
    by_file: dict[str | None, list[str]] = {}
    for name, (file, _) in wanted.items():
        by_file.setdefault(file, []).append(name)
    parts = []
    optional = _optional(layout)
    for file, names in by_file.items():
        lines = _open(_beside(path, file), layout)
        known = [n for n in names if n not in optional or _is_there(wanted[n][1], lines)]
        addresses = [a for name in known for a in wanted[name][1]]
        parts.append((known, _parse(lines, [_index(a, lines) for a in addresses])))
    return _joined(parts, {name: len(columns) for name, (_, columns) in wanted.items()})


def _wanted_columns(layout: ImportMap) -> dict[str, tuple[str | None, tuple[Address, ...]]]:
    """Return the file that contains each quantity, and its columns."""
    out: dict[str, tuple[str | None, tuple[Address, ...]]] = {}
    rtde = layout.format == "ur_rtde"
    time = layout.columns.t
    if time.rate_hz is None:
        columns = time.columns or ((RTDE_TIME,) if rtde else ())
        out["t"] = (time.file, _required("t", columns, 1))
    for name, quantity in layout.quantities().items():
        default = tuple(RTDE_NAMES[name].format(j) for j in range(layout.n_joints)) if rtde else ()
        columns = quantity.columns or default
        out[name] = (quantity.file, _required(name, columns, layout.n_joints))
    return out


def _required(name: str, columns: tuple[Address, ...], count: int) -> tuple[Address, ...]:
    if len(columns) != count:
        raise DataError(
            f"the map gives {len(columns)} columns for {name}, but {count} are needed",
            hint="set one column per joint (or t.rate_hz if the file has no time stamps)",
        )
    return columns


@dataclass(frozen=True)
class _Lines:
    """Data lines of a text file without blank lines, and the header of the file."""

    path: Path
    text: list[str]
    numbers: IntArray
    names: list[str] | None
    delimiter: str | None

    @cached_property
    def counts(self) -> list[int]:
        """Numbers of fields of the data lines."""
        if self.delimiter is None:
            return [len(line.split()) for line in self.text]
        return [line.count(self.delimiter) + 1 for line in self.text]

    @cached_property
    def width(self) -> int:
        """Number of columns of the header; without a header, the most frequent number of fields."""
        return len(self.names) if self.names else Counter(self.counts).most_common(1)[0][0]


def _beside(path: Path, file: str | None) -> Path:
    if file is None:
        return path
    return (path if path.is_dir() else path.parent) / file


def _open(path: Path, layout: ImportMap) -> _Lines:
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror or error}",
            hint="check that the file exists and is readable",
        ) from error
    except UnicodeDecodeError as error:
        raise DataError(
            f"{path} is not a text file: byte {error.start} is not UTF-8",
            hint="check `format` in the map",
        ) from error
    lines = text.splitlines()
    delimiter = None if layout.delimiter == "whitespace" else layout.delimiter
    filled = [i for i, line in enumerate(lines) if line.strip()]
    names = None
    if layout.header or layout.format == "ur_rtde":
        if not filled:
            raise DataError(f"{path} is empty", hint="check that the file is complete")
        names = _fields(lines[filled.pop(0)], delimiter)
    if not filled:
        raise DataError(f"{path} contains no rows", hint="check that the file is complete")
    data = [lines[i] for i in filled]
    if layout.decimal == ",":
        data = [line.replace(",", ".") for line in data]
    return _Lines(path, data, np.array(filled, dtype=np.int64) + 1, names, delimiter)


def _fields(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    return [name.strip() for name in next(csv.reader([line], delimiter=delimiter))]


def _optional(layout: ImportMap) -> set[str]:
    """Return the quantities that can be missing.

    A recording of ur_rtde contains only the selected quantities.
    """
    if layout.format == "ur_rtde":
        return set(layout.quantities()) - {"q", "effort"}
    return {name for name, quantity in layout.quantities().items() if quantity.optional}


def _is_there(addresses: tuple[Address, ...], lines: _Lines) -> bool:
    names = lines.names or ()
    return all(
        address <= lines.width if isinstance(address, int) else address in names
        for address in addresses
    )


def _index(address: Address, lines: _Lines) -> int:
    """Return the index of a column, counted from 0."""
    if isinstance(address, int):
        return address - 1
    if lines.names is None:
        raise DataError(
            f"the map uses the column {address!r}, but states that {lines.path.name} has no header",
            hint="set header: true, or give column numbers",
        )
    if address not in lines.names:
        raise DataError(
            f"{lines.path} has no column {address!r}", hint=did_you_mean(address, lines.names)
        )
    return lines.names.index(address)


@dataclass(eq=False)
class _Table:
    """Columns of one text file that were requested.

    Attributes:
        values: (N, C) numbers in the order of the requested columns, NaN if unreadable.
        lines: (N,) line number of each row in the file, starting at 1.
        problems: Map from row (starting at 0) to the description of its problem.
    """

    values: FloatArray
    lines: IntArray
    problems: dict[int, str] = field(default_factory=dict)


def _parse(lines: _Lines, columns: Sequence[int]) -> _Table:
    expected = lines.width
    if max(columns, default=0) >= expected:
        raise DataError(
            f"the map reads column {max(columns) + 1}, but the rows of {lines.path} have "
            f"{expected} columns",
            hint="check that the map describes this file",
        )
    if all(count == expected for count in lines.counts):
        try:
            values = np.loadtxt(
                lines.text,
                delimiter=lines.delimiter,
                usecols=columns,
                comments=None,
                quotechar='"',
                ndmin=2,
            )
        except ValueError:
            pass
        else:
            return _Table(values, lines.numbers)
    return _parse_row_by_row(lines, columns)


def _parse_row_by_row(lines: _Lines, columns: Sequence[int]) -> _Table:
    """Return the columns of a file and the problems of its invalid rows; slow."""
    table = _Table(np.full((len(lines.text), len(columns)), np.nan), lines.numbers)
    for row, (line, count) in enumerate(zip(lines.text, lines.counts, strict=True)):
        # The field count of a line includes delimiters in quotes, so parse the line again.
        fields = _fields(line, lines.delimiter) if count == lines.width else []
        if len(fields) != lines.width:
            table.problems[row] = f"has {len(fields) or count} fields instead of {lines.width}"
            continue
        for i, column in enumerate(columns):
            try:
                table.values[row, i] = float(fields[column])
            except ValueError:
                text = fields[column][:20] or "nothing"
                table.problems.setdefault(row, f"column {column + 1} is not a number: {text}")
    return table


def _joined(parts: list[tuple[list[str], _Table]], widths: dict[str, int]) -> ForeignSamples:
    """Return the combined columns of parallel files.

    A row that is missing in one of the files is invalid.
    """
    longest = max(parts, key=lambda part: len(part[1].lines))[1]
    samples = ForeignSamples({}, longest.lines)
    for names, table in parts:
        missing = len(longest.lines) - len(table.lines)
        values = np.pad(table.values, ((0, missing), (0, 0)), constant_values=np.nan)
        for row in range(len(table.lines), len(longest.lines)):
            samples.blame(row, f"{names[0]} ends earlier, after {len(table.lines)} rows")
        for row, why in table.problems.items():
            samples.blame(row, why)
        start = 0
        for name in names:
            block = values[:, start : start + widths[name]]
            samples.columns[name] = block[:, 0] if name == "t" else block
            start += widths[name]
    return samples


# One value per line


def read_interleaved(path: Path, layout: ImportMap) -> ForeignSamples:
    """Return the samples in files with one quantity each and n values per sample.

    The time file has one value per sample.

    The samples of the files are matched by sample number; an invalid value makes its sample
    invalid.

    Raises:
        DataError: A file cannot be read or contains no value.
    """
    files = {
        name: (quantity.file, layout.n_joints) for name, quantity in layout.quantities().items()
    }
    if layout.columns.t.rate_hz is None:
        files["t"] = (layout.columns.t.file, 1)
    blocks: dict[str, FloatArray] = {}
    problems: list[tuple[int, str]] = []
    for name, (file, width) in files.items():
        blocks[name], bad = _samples_of(_beside(path, file), width)
        problems += bad
    longest = max(len(block) for block in blocks.values())
    samples = ForeignSamples({}, np.arange(1, longest + 1), "sample")
    for row, why in problems:
        samples.blame(row, why)
    for name, block in blocks.items():
        short = longest - len(block)
        for row in range(len(block), longest):
            samples.blame(row, f"{files[name][0] or path.name} ends earlier")
        padded = np.pad(block, ((0, short), (0, 0)), constant_values=np.nan)
        samples.columns[name] = padded[:, 0] if name == "t" else padded
    return samples


def _samples_of(path: Path, width: int) -> tuple[FloatArray, list[tuple[int, str]]]:
    """Return the values (N, width), and the invalid samples with their problems."""
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(
            f"cannot read {path}: {error}", hint="check that the file exists and is readable"
        ) from error
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        raise DataError(f"{path} contains no values", hint="check that the file is complete")
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
            problems.append((i // width, f"{path.name} line {i + 1} is not a number: {line[:20]}"))
    return values, problems
