"""The one description of a figure: panels of curves with titled axes, and nothing about drawing.

Whoever has something to show builds a `Figure`; `hil.report` draws it with plotly in a page and
with matplotlib in a file. A curve without a `Look` gets one by the order of its name in the figure,
so that the same name looks the same in every panel; pages whose colours have a meaning (measured,
predicted, joint 3) give the look. The legend is not described: it follows from names and looks.

Studies store their figures in `study.json` (`to_dict`, `figure_from_dict`). A field that was added
later than the file format is stored only where it is not its default: older files can be read, and
figures that do not use it are stored as before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import partial
from typing import Any, ClassVar, Literal, TypeAlias, TypeVar, get_args

import numpy as np

from hil.core import FloatArray

Style = Literal["line", "points", "marked", "bars", "ticks", "ranges", "identity"]
"""`marked` is a line with a mark at every point, `ticks` a stroke across a bar, `ranges` a broad
bar of ± `y_error` behind the data. `identity` is the line y = x over the range of the panel; its x
and y stay empty."""

Scale = Literal["linear", "log", "date"]
Numbers: TypeAlias = Sequence[float] | FloatArray


@dataclass(frozen=True, slots=True)
class Look:
    """How a curve is drawn, in plotly's words; each part alone tells neighbours apart.

    Attributes:
        colour: Of the report's palette, `#RRGGBB`.
        dash, symbol, pattern: Of a line, of points, of bars.
        width: Of a line [px].
        size: Of a mark [px]; 0 for one that suits the number of points.
        opacity: Of marks.
    """

    colour: str
    dash: str = "solid"
    symbol: str = "circle"
    pattern: str = ""
    width: float = 1.6
    size: float = 0.0
    opacity: float = 0.7


@dataclass(frozen=True, slots=True)
class Curve:
    """One series of a panel.

    Attributes:
        name: For the legend; neighbours in other panels with the same name look the same.
        x: Numbers; names for bars, ISO times for dates.
        y: As many numbers.
        style: How it is drawn.
        y_error: Half-widths of error bars, or empty.
        look: By default one by the order of names.
        hover: A word for each point, shown under the pointer.
    """

    name: str
    x: Sequence[float | str] | FloatArray = ()
    y: Numbers = ()
    style: Style = "line"
    y_error: Numbers = ()
    look: Look | None = None
    hover: Sequence[str] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Counts over two quantities.

    Attributes:
        x, y: Centres of the cells, (M,) and (N,).
        log_count: (N, M) decimal logarithms of the counts; NaN where nothing was counted.
    """

    x: FloatArray
    y: FloatArray
    log_count: FloatArray


@dataclass(frozen=True, slots=True)
class Axis:
    """How values stand along an axis.

    Attributes:
        scale: `date` for ISO times.
        limits: From and to; by default what the curves need.
        from_zero: Begin at zero.
        whole: Numbers that are counted: no ticks between them.
    """

    scale: Scale = "linear"
    limits: tuple[float, float] | None = None
    from_zero: bool = False
    whole: bool = False


@dataclass(frozen=True, slots=True)
class Band:
    """An area of ± `half` about zero behind the curves."""

    name: str
    half: float


@dataclass(frozen=True, slots=True)
class Mark:
    """A dotted vertical line with a word at its upper end; `name` is for the legend."""

    x: float | str
    text: str = ""
    name: str = ""


@dataclass(frozen=True, slots=True)
class Span:
    """A shaded stretch of x; of a dwell with its approach, +1 from below and −1 from above."""

    begin: float
    end: float
    approach: int = 0


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes.

    Attributes:
        title: Above it.
        x_title, y_title: With units.
        curves: In drawing order.
        corner: Text inside it, such as `R = 0.998`.
        alt: What it shows, in words, for those who do not see it; by default the ranges of y.
        wide: Takes the whole width of a page.
        x_axis, y_axis: How values stand along them.
        band, marks, spans: Behind the curves.
        grid: Instead of curves.
        square: The same scale along both axes.
    """

    title: str
    x_title: str
    y_title: str
    curves: tuple[Curve, ...]
    corner: str = ""
    alt: str = ""
    wide: bool = False
    x_axis: Axis = Axis()
    y_axis: Axis = Axis()
    band: Band | None = None
    marks: tuple[Mark, ...] = ()
    spans: tuple[Span, ...] = ()
    grid: Grid | None = None
    square: bool = False


@dataclass(frozen=True, slots=True)
class Figure:
    """Panels that belong together, under one legend.

    Attributes:
        key: Short and stable, e.g. `fig-7`; names the file it is exported to.
        title: What it shows.
        caption: How to read it.
        panels: In reading order.
        per_row: Panels side by side; 0 for as many as there is room for.
    """

    key: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    per_row: int = 2
    kind: ClassVar = "figure"

    def to_dict(self) -> dict[str, Any]:
        """JSON form, but for arrays and NaN; `hil.core.json_value` converts those."""
        stored: dict[str, Any] = _stored(self)
        return stored


ALWAYS_STORED = frozenset({"per_row", "corner", "x", "y", "style", "y_error"})
"""Fields with a default that every file has had since the first version of the format."""


def _stored(value: Any) -> Any:
    """The fields of a dataclass by name, all the way down; anything else as it is."""
    if isinstance(value, list | tuple) and value and is_dataclass(value[0]):
        return [_stored(item) for item in value]
    if not is_dataclass(value):
        return value
    return {
        field.name: _stored(part)
        for field in fields(value)
        for part in (getattr(value, field.name),)
        if field.name in ALWAYS_STORED or field.default is MISSING or part != field.default
    }


Made = TypeVar("Made")
Readers: TypeAlias = Mapping[str, Callable[[Any], Any]]


def _read(kind: Callable[..., Made], readers: Readers, raw: Any) -> Made:
    """Make one of the classes above; a field that is not in the file has its default."""
    return kind(**{name: read(raw[name]) for name, read in readers.items() if name in raw})


def figure_from_dict(raw: Mapping[str, Any]) -> Figure:
    """Inverse of `Figure.to_dict`, from JSON as well; sequences come back as tuples.

    Raises:
        KeyError, TypeError, ValueError: Something is missing or garbled.
    """
    return _read(Figure, _FIGURE, raw)


def _number(raw: Any) -> float:
    """A number of a file, where NaN is null."""
    return float("nan") if raw is None else float(raw)


def _name_or_number(raw: Any) -> str | float:
    return raw if isinstance(raw, str) else _number(raw)


def _each(read: Callable[[Any], Made]) -> Callable[[Any], tuple[Made, ...]]:
    return lambda raw: tuple(read(item) for item in raw)


def _array(raw: Any) -> FloatArray:
    return np.array(raw, dtype=float)  # null becomes NaN


def _one_of(words: tuple[str, ...], raw: Any) -> Any:
    if raw not in words:
        raise ValueError(f"{raw!r:.40} is none of {', '.join(words)}")
    return raw


# How each field is read, class by class; what a file has besides is for a newer hil.
_NUMBERS = _each(_number)
_LOOK: Readers = {
    **dict.fromkeys(("colour", "dash", "symbol", "pattern"), str),
    **dict.fromkeys(("width", "size", "opacity"), float),
}
_CURVE: Readers = {
    "name": str,
    "x": _each(_name_or_number),
    "y": _NUMBERS,
    "style": partial(_one_of, get_args(Style)),
    "y_error": _NUMBERS,
    "look": partial(_read, Look, _LOOK),
    "hover": _each(str),
}
_AXIS: Readers = {
    "scale": partial(_one_of, get_args(Scale)),
    "limits": _NUMBERS,
    "from_zero": bool,
    "whole": bool,
}
_BAND: Readers = {"name": str, "half": float}
_MARK: Readers = {"x": _name_or_number, "text": str, "name": str}
_SPAN: Readers = {"begin": float, "end": float, "approach": int}
_GRID: Readers = {"x": _array, "y": _array, "log_count": _array}
_PANEL: Readers = {
    "title": str,
    "x_title": str,
    "y_title": str,
    "curves": _each(partial(_read, Curve, _CURVE)),
    "corner": str,
    "alt": str,
    "wide": bool,
    "x_axis": partial(_read, Axis, _AXIS),
    "y_axis": partial(_read, Axis, _AXIS),
    "band": partial(_read, Band, _BAND),
    "marks": _each(partial(_read, Mark, _MARK)),
    "spans": _each(partial(_read, Span, _SPAN)),
    "grid": partial(_read, Grid, _GRID),
    "square": bool,
}
_FIGURE: Readers = {
    "key": str,
    "title": str,
    "caption": str,
    "panels": _each(partial(_read, Panel, _PANEL)),
    "per_row": int,
}
