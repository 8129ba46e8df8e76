"""Description of figures: panels of curves with titled axes, independent of a plotting library.

Reports and studies describe their figures by the class `Figure`. `hil.report` draws a `Figure` with
plotly in an HTML page and with matplotlib in a file. A curve without a `Look` gets a look from the
order of the curve names in the figure. Curves with the same name therefore look the same in every
panel of a figure. Pages whose colours have a meaning (measured, predicted, joint 3) set the look of
each curve explicitly. The legend of a figure is derived from the names and looks of the curves.

Studies store their figures in the file `study.json` (`to_dict`, `figure_from_dict`). A field that
was added to the file format after the first version is stored only if its value differs from its
default. Older figure files therefore remain readable, and figures that do not use an added field
are stored unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import partial
from typing import Any, ClassVar, Literal, TypeAlias, TypeVar, get_args

import numpy as np

from hil.core import FloatArray

Style = Literal["line", "points", "marked", "bars", "ticks", "ranges", "identity"]
"""Drawing style of a curve.

The style `marked` draws a line with a marker at every point. The style `ticks` draws a short stroke
across a bar. The style `ranges` draws a wide bar of ± `y_error` behind the data. The style
`identity` draws the line y = x over the range of the panel; x and y of the curve are empty.
"""

Scale = Literal["linear", "log", "date"]
Numbers: TypeAlias = Sequence[float] | FloatArray


@dataclass(frozen=True, slots=True)
class Look:
    """Colour, line style and markers of a curve, named as in plotly.

    Each of the properties colour, dash, symbol and pattern alone distinguishes a curve from its
    neighbours.

    Attributes:
        colour: Colour from the palette of the report, `#RRGGBB`.
        dash, symbol, pattern: Names of the line style, of the marker symbol and of the fill pattern
            of bars.
        width: Width of the line [px].
        size: Marker size [px]; 0 selects a size that suits the number of points.
        opacity: Opacity of the markers, from 0 to 1.
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
    """Data series of a panel: one curve, point cloud or set of bars.

    Attributes:
        name: Name of the curve in the legend; curves with the same name look the same in every
            panel.
        x: Values of x: numbers, category names for bars, or ISO times on a date axis.
        y: Values of y: numbers, one per value of x.
        style: Drawing style.
        y_error: Half-widths of the error bars; empty for a curve without error bars.
        look: Look of the curve; None selects a look according to the order of the curve names.
        hover: Texts shown under the mouse pointer, one per point.
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
    """Two-dimensional histogram.

    Attributes:
        x, y: (M,) and (N,) coordinates of the cell centres.
        log_count: (N, M) decimal logarithms of the counts; NaN for an empty cell.
    """

    x: FloatArray
    y: FloatArray
    log_count: FloatArray


@dataclass(frozen=True, slots=True)
class Axis:
    """Scale and limits of one axis of a panel.

    Attributes:
        scale: Scale of the axis: `linear`, `log`, or `date` for ISO times.
        limits: Lower and upper limit of the axis; None selects the range of the curves.
        from_zero: Whether the axis starts at zero.
        whole: Whether the values are counts, so that ticks are placed only at whole numbers.
    """

    scale: Scale = "linear"
    limits: tuple[float, float] | None = None
    from_zero: bool = False
    whole: bool = False


@dataclass(frozen=True, slots=True)
class Band:
    """Shaded area of ± `half` around zero, behind the curves."""

    name: str
    half: float


@dataclass(frozen=True, slots=True)
class Mark:
    """Dotted vertical line with a label at its upper end; `name` appears in the legend."""

    x: float | str
    text: str = ""
    name: str = ""


@dataclass(frozen=True, slots=True)
class Span:
    """Shaded interval of x values, such as the time of a dwell.

    For a dwell, `approach` is the approach direction: +1 for an approach from below, −1 for an
    approach from above.
    """

    begin: float
    end: float
    approach: int = 0


@dataclass(frozen=True, slots=True)
class Panel:
    """Panel of a figure: one pair of axes with curves.

    Attributes:
        title: Title above the axes.
        x_title, y_title: Axis titles with units.
        curves: Curves of the panel in drawing order.
        corner: Text inside the panel, such as `R = 0.998`.
        alt: Alternative text for readers who cannot see the figure; the default text states the
            ranges of y.
        wide: Whether the panel takes the whole width of a page.
        x_axis, y_axis: Scales and limits of the two axes.
        band, marks, spans: Shaded band, vertical lines and shaded intervals drawn behind the
            curves.
        grid: Two-dimensional histogram that is drawn instead of curves.
        square: Whether the x axis and the y axis have the same scale.
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
    """Group of panels with a common legend.

    Attributes:
        key: Short stable identifier of the figure, such as `fig-7`; also the name of the exported
            file.
        title: Title of the figure.
        caption: Text below the title that explains the figure.
        panels: Panels of the figure in reading order.
        per_row: Number of panels side by side; 0 selects as many panels as fit.
    """

    key: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    per_row: int = 2
    kind: ClassVar = "figure"

    def to_dict(self) -> dict[str, Any]:
        """Return the figure as a dictionary for JSON.

        Arrays and NaN remain unchanged in the dictionary; `hil.core.json_value` converts them to
        JSON values.
        """
        stored: dict[str, Any] = _stored(self)
        return stored


ALWAYS_STORED = frozenset({"per_row", "corner", "x", "y", "style", "y_error"})
"""Fields that have a default and are nevertheless contained in every file since the first version
of the format.
"""


def _stored(value: Any) -> Any:
    """Return the fields of a dataclass by name, recursively; return any other value unchanged."""
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
    """Create an object of a figure class from JSON; a missing field gets its default value."""
    return kind(**{name: read(raw[name]) for name, read in readers.items() if name in raw})


def figure_from_dict(raw: Mapping[str, Any]) -> Figure:
    """Create a figure from the output of `Figure.to_dict` or from JSON; sequences become tuples.

    Raises:
        KeyError, TypeError, ValueError: A field of the figure is missing or invalid.
    """
    return _read(Figure, _FIGURE, raw)


def _number(raw: Any) -> float:
    """Return a number read from a file, in which null stands for NaN."""
    return float("nan") if raw is None else float(raw)


def _name_or_number(raw: Any) -> str | float:
    return raw if isinstance(raw, str) else _number(raw)


def _each(read: Callable[[Any], Made]) -> Callable[[Any], tuple[Made, ...]]:
    return lambda raw: tuple(read(item) for item in raw)


def _array(raw: Any) -> FloatArray:
    return np.array(raw, dtype=float)  # null becomes NaN


def _one_of(words: tuple[str, ...], raw: Any) -> Any:
    if raw not in words:
        raise ValueError(f"{raw!r:.40} must be one of {', '.join(words)}")
    return raw


# Converters per class and field. Unknown fields, written by a newer hil, are ignored.
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
