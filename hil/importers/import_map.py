"""Import map: a YAML file that describes the columns of a recording of a different tool.

An `ImportMap` assigns columns to quantities and joints, with unit and scale. An import map also
contains the information that is missing in the recording: robot, payload, drive gains, and the rows
of each trajectory. Import maps are validated as strictly as specs; every error in a map is reported
with its line and column (`load_map`).
"""

from __future__ import annotations

import re
from fnmatch import fnmatch
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    ValidationError,
    WithJsonSchema,
    model_validator,
)

from hil.arms import Payload
from hil.core import UNITS, Problem, Unit, read_source, refuse, shown
from hil.spec import (
    DIALECT,
    Finite,
    FormatVersion,
    Load,
    Positive,
    Strict,
    explain,
    findings_of,
    mistake,
)

FileFormat = Literal["csv", "ur_rtde", "interleaved", "mat", "ros2bag"]
Address: TypeAlias = int | str
"""Identifier of a column: number (starting at 1) or name."""

# Units


QUANTITY_DIMENSIONS = {
    "t": ("time",),
    "q": ("angle",),
    "qd": ("angular velocity",),
    "effort": ("current", "torque"),
    "temperature": ("temperature",),
    "q_target": ("angle",),
    "qd_target": ("angular velocity",),
    "qdd_target": ("angular acceleration",),
    "effort_target": ("current", "torque"),
    "torque_target": ("torque",),
}
"""Allowed physical dimensions of each quantity of a recording."""

QUANTITIES = tuple(name for name in QUANTITY_DIMENSIONS if name != "t")
"""Names of all quantities except time."""

SI_SYMBOL = {
    "time": "s",
    "angle": "rad",
    "angular velocity": "rad/s",
    "angular acceleration": "rad/s²",
    "current": "A",
    "torque": "N·m",
    "temperature": "°C",
}

_MORE = {
    "ns": Unit("ns", "time", 1e-9),
    "rev": Unit("rev", "angle", 6.283185307179586),
    "mrad": Unit("mrad", "angle", 1e-3),
    "mnm": Unit("mN·m", "torque", 1e-3),
    "knm": Unit("kN·m", "torque", 1e3),
}
_SPELLINGS = {"°": "deg", "°c": "c", "°f": "f", "µs": "us", "sec": "s", "amp": "a"}


def unit_named(text: str) -> Unit | None:
    """Return the unit that a text such as `deg/s`, `deg_s`, `N·m`, `Nm`, `mA` denotes.

    The function returns None if the unit is unknown.
    """
    plain = text.strip().casefold().replace("·", "").replace("*", "").replace("^", "")
    plain = plain.replace("²", "2")
    suffix = "_".join(_SPELLINGS.get(part, part) for part in plain.split("/"))
    return _MORE.get(suffix) or UNITS.get(suffix)


def units_of(dimensions: tuple[str, ...]) -> list[str]:
    """Return the symbols of all units that have one of these dimensions."""
    known = {**UNITS, **_MORE}.values()
    return [unit.symbol for unit in known if unit.dimension in dimensions]


# Columns and rows


MOST_COLUMNS = 10_000
"""Maximum number of columns in a range of columns; a larger range counts as a mistake."""

_SPAN = re.compile(r"([0-9]+):([0-9]+)")
_MOST_DIGITS = 15


def _expanded(value: Any) -> Any:
    """Return a list of column addresses: `7` → [7]; `"2:7"` → [2, …, 7]; a name → [name]."""
    if isinstance(value, bool) or not isinstance(value, int | str):
        return value
    if span := _SPAN.fullmatch(str(value).replace(" ", "")):
        # Python does not convert thousands of digits, and such numbers are too large in any case.
        first, last = (int(number[:_MOST_DIGITS]) for number in span.groups())
        if not first <= last < first + MOST_COLUMNS:
            raise mistake(f"a range must increase and contain at most {MOST_COLUMNS} columns")
        return list(range(first, last + 1))
    return [value]


def _counted_from_one(addresses: tuple[Address, ...]) -> tuple[Address, ...]:
    # Column 0 would silently select the last column.
    if any(isinstance(address, int) and address < 1 for address in addresses):
        raise mistake("columns are counted from 1")
    return addresses


def _as_list(value: Any) -> Any:
    return value if isinstance(value, list | tuple) else [value]


def _one_or_list(one: dict[str, Any]) -> WithJsonSchema:
    """Return the JSON schema of a value that the file can give as a single value or as a list."""
    return WithJsonSchema({"anyOf": [one, {"type": "array", "items": one, "minItems": 1}]})


Addresses = Annotated[
    tuple[Address, ...],
    BeforeValidator(_expanded),
    AfterValidator(_counted_from_one),
    Field(min_length=1),
    _one_or_list({"anyOf": [{"type": "integer", "minimum": 1}, {"type": "string"}]}),
]
PerJoint = Annotated[
    tuple[Finite, ...],
    BeforeValidator(_as_list),
    Field(min_length=1),
    _one_or_list({"type": "number"}),
]


def _ascending(rows: str) -> str:
    span = _SPAN.fullmatch(rows)
    if span is None or len(rows) > 2 * _MOST_DIGITS or not 1 <= int(span[1]) <= int(span[2]):
        raise mistake(f"must be FIRST:LAST, counted from 1, such as 120:5000, not {shown(rows)}")
    return rows


Rows = Annotated[
    str,
    AfterValidator(_ascending),
    WithJsonSchema({"type": "string", "pattern": r"^[0-9]{1,15}:[0-9]{1,15}$"}),
]


# Import map


class Quantity(Strict):
    """Measured quantity of all joints of a recording.

    In the unit of the file, the value is `value = scale · number + offset`; then `matrix` combines
    the joints, and the combined value is converted to SI units.
    """

    columns: Addresses | None = Field(
        None,
        description="One column per joint: numbers from 1 (`2:7` or a list) or names from the "
        "header; in .mat files variables (`rec.q`, or `rec.q[1]` for its first row). Optional "
        "for formats whose column names are fixed.",
    )
    unit: str = Field(description="Unit in the file, such as rad, deg, rad/s, rpm, A, mA, N·m.")
    scale: PerJoint = Field((1.0,), description="Factor for all joints, or one factor per joint.")
    offset: PerJoint = Field((0.0,), description="Offset added after scaling, in the file's unit.")
    matrix: tuple[tuple[Finite, ...], ...] | None = Field(
        None, description="n × n matrix from values of the file to joint values (coupled wrists)."
    )
    file: str | None = Field(
        None, description="File beside the imported one, if every quantity has a separate file."
    )
    limit: PerJoint | None = Field(
        None, description="Limit in the unit of the file; larger magnitudes are invalid."
    )
    optional: bool = Field(False, description="Omit the quantity if the file lacks its columns.")


class Time(Strict):
    """Time stamps of the samples, which must increase but can be unevenly spaced."""

    columns: Addresses | None = Field(None, description="Time column, by number or name.")
    unit: str = Field("s", description="Unit of the time stamps: s, ms, us or ns.")
    rate_hz: Positive | None = Field(
        None, description="Sample rate, for files without time stamps."
    )
    file: str | None = Field(None, description="File with the time stamps, beside the other file.")


class Columns(Strict):
    """Assignment of columns to quantities; `q` and `effort` are required.

    The quantities `q` and `effort` must not be marked as optional.
    """

    t: Time = Time()
    q: Quantity
    effort: Quantity
    qd: Quantity | None = None
    temperature: Quantity | None = None
    q_target: Quantity | None = None
    qd_target: Quantity | None = None
    qdd_target: Quantity | None = None
    effort_target: Quantity | None = None
    torque_target: Quantity | None = None


class Window(Strict):
    """Range of rows of one trajectory; rows outside all ranges belong to other motions."""

    rows: Rows = Field(description="First and last row, counted from 1.")
    file: str = Field("*", description="Name or pattern of the files that the window applies to.")
    payload: Load | None = Field(
        None, description="Load of these rows; by default the load of the map."
    )

    @property
    def span(self) -> tuple[int, int]:
        """Numbers of the first and last row, counted from 1, both included."""
        first, last = self.rows.split(":")
        return int(first), int(last)


class ImportMap(Strict):
    """Description of a file of a different tool, with the same information as a `hil` recording."""

    hil_map: FormatVersion = Field(description="Version of the map format.")
    description: str = ""
    format: FileFormat
    robot: str = Field(description="Built-in arm, URDF file, or a free label.")
    joint_names: tuple[str, ...] = Field(min_length=1, description="Names from base to flange.")
    effort_kind: Literal["current", "torque"]
    drive_gains_nm_a: tuple[Positive, ...] | None = None
    drive_gains_source: str = ""
    serial: str = Field(
        "", description="Serial number; recordings of different arms are not pooled."
    )
    payload: Load = Load()
    header: bool = Field(False, description="Whether the first line contains column names.")
    delimiter: str = Field(
        ",", description="Delimiter between columns; `whitespace` for spaces and tabs."
    )
    decimal: Literal[".", ","] = "."
    topic: str = Field("/joint_states", description="ROS 2 bags: topic of the joint states.")
    stamp: Literal["header", "log"] = Field(
        "header", description="ROS 2 bags: time stamp of the message header, or of the logging."
    )
    columns: Columns
    windows: tuple[Window, ...] = ()

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    def with_payload(self, payload: Payload) -> ImportMap:
        """Return a copy of the map in which this payload applies to every row.

        The payload overrides the payloads of the map and its windows.
        """
        load = Load(mass_kg=payload.mass, com_m=payload.com, inertia_kgm2=payload.inertia)
        windows = tuple(window.model_copy(update={"payload": None}) for window in self.windows)
        return self.model_copy(update={"payload": load, "windows": windows})

    def quantities(self) -> dict[str, Quantity]:
        """Return the quantities by field name.

        The names are fields of the base robot record or `torque_target`.
        """
        named = ((name, getattr(self.columns, name)) for name in QUANTITIES)
        return {name: quantity for name, quantity in named if quantity is not None}

    def windows_of(self, file: str) -> tuple[Window, ...]:
        """Return the windows of rows that apply to a file of this name."""
        return tuple(window for window in self.windows if fnmatch(file, window.file))

    @model_validator(mode="after")
    def _fits_the_joints(self) -> ImportMap:
        n = self.n_joints
        if self.drive_gains_nm_a is not None and len(self.drive_gains_nm_a) != n:
            raise mistake(f"needs {n} values, one per joint", "drive_gains_nm_a")
        for name, quantity in self.quantities().items():
            if quantity.optional and name in ("q", "effort"):
                raise mistake("is required and cannot be optional", "columns", name, "optional")
            _check_lengths(name, quantity, n)
            _check_unit(name, quantity.unit)
        _check_unit("t", self.columns.t.unit)
        _check_effort(self)
        return self


def _check_lengths(name: str, quantity: Quantity, n: int) -> None:
    for key in ("scale", "offset", "limit"):
        values = getattr(quantity, key)
        if values is not None and len(values) not in (1, n):
            raise mistake(f"needs one value or {n}, one per joint", "columns", name, key)
    matrix = quantity.matrix
    if matrix is not None and (len(matrix) != n or any(len(row) != n for row in matrix)):
        raise mistake(f"must be {n} × {n}", "columns", name, "matrix")


def _check_unit(name: str, text: str) -> None:
    dimensions = QUANTITY_DIMENSIONS[name]
    unit = unit_named(text)
    if unit is None or unit.dimension not in dimensions:
        known = ", ".join(units_of(dimensions))
        raise mistake(f"{text!r} is not a unit of {name}: use {known}", "columns", name, "unit")


def _check_effort(layout: ImportMap) -> None:
    for name in ("effort", "effort_target"):
        quantity = getattr(layout.columns, name)
        unit = unit_named(quantity.unit) if quantity else None
        if unit and unit.dimension != layout.effort_kind:
            raise mistake(
                f"{quantity.unit} is a {unit.dimension}, but effort_kind is {layout.effort_kind}",
                "columns", name, "unit",
            )  # fmt: skip


def load_map(path: str | Path) -> ImportMap:
    """Return the import map that is stored in a file.

    Raises:
        SpecError: The map is invalid; the message contains one line `file:line:column: path:
            message` for every problem.
    """
    source = read_source(path)
    if not isinstance(source.data, dict) or "hil_map" not in source.data:
        message = "an import map is a mapping that begins with `hil_map: 1`"
        raise refuse([Problem(source.mark(()), (), message)])
    try:
        layout = ImportMap.model_validate(source.data)
    except ValidationError as error:
        findings = findings_of(error.errors(include_url=False), ImportMap, source)
        problems = [explain(finding, ImportMap, source) for finding in findings]
        raise refuse(source.problems + problems) from None
    if source.problems:
        raise refuse(source.problems)
    return layout


def map_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of import maps for editors: `hil schema map`."""
    head = {"$schema": DIALECT, "$id": "urn:hil:schema:map:1", "title": "hil map"}
    schema = ImportMap.model_json_schema()
    return head | {key: value for key, value in schema.items() if key not in head}
