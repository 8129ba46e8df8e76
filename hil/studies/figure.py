"""The one description of a figure: panels of curves with titled axes, and nothing about drawing.

Whoever has something to show builds a `Figure`; `hil.report` draws it with plotly in a page and
with matplotlib in a file. A curve without a `Look` gets one by the order of its name in the figure,
so that the same name looks the same in every panel; pages whose colours have a meaning (measured,
predicted, joint 3) give the look. The legend is not described: it follows from names and looks.

Studies store their figures in `study.json` (`to_dict`, `figure_from_dict`). They use names, numbers
and styles only; looks, bands and marks are not stored.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, TypeAlias

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
        """JSON form of what studies store."""
        return {
            "key": self.key,
            "title": self.title,
            "caption": self.caption,
            "panels": [_panel_to_dict(panel) for panel in self.panels],
            "per_row": self.per_row,
        }


def figure_from_dict(raw: Mapping[str, Any]) -> Figure:
    """Inverse of `Figure.to_dict`, from JSON as well.

    Raises:
        KeyError, TypeError, ValueError: Something is missing or garbled.
    """
    panels = tuple(
        Panel(
            str(panel["title"]),
            str(panel["x_title"]),
            str(panel["y_title"]),
            tuple(_curve(curve) for curve in panel["curves"]),
            str(panel["corner"]),
        )
        for panel in raw["panels"]
    )
    key, title, caption = (str(raw[name]) for name in ("key", "title", "caption"))
    return Figure(key, title, caption, panels, int(raw["per_row"]))


def _panel_to_dict(panel: Panel) -> dict[str, Any]:
    curves = [
        {name: getattr(curve, name) for name in ("name", "x", "y", "style", "y_error")}
        for curve in panel.curves
    ]
    titles = {"title": panel.title, "x_title": panel.x_title, "y_title": panel.y_title}
    return {**titles, "curves": curves, "corner": panel.corner}


def _curve(raw: Mapping[str, Any]) -> Curve:
    x = tuple(value if isinstance(value, str) else _number(value) for value in raw["x"])
    y = tuple(_number(value) for value in raw["y"])
    error = tuple(_number(value) for value in raw["y_error"])
    style = raw["style"]
    if style not in ("line", "points", "bars", "identity"):
        raise ValueError(f"style: {style!r:.40}")
    return Curve(str(raw["name"]), x, y, style, error)


def _number(value: Any) -> float:
    """A number of a file, where NaN is null."""
    return float("nan") if value is None else float(value)
