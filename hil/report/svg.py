"""A few words of SVG: scales, ticks, and paths that stay small however many samples there are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from hil.core import FloatArray


@dataclass(frozen=True, slots=True)
class Scale:
    """A linear map from values `low`…`high` to pixels `start`…`end`."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: FloatArray | float) -> FloatArray:
        """Pixels of one or many values."""
        share = (np.asarray(value, dtype=np.float64) - self.low) / ((self.high - self.low) or 1.0)
        return np.asarray(self.start + share * (self.end - self.start))

    def ticks(self, count: int = 6) -> list[float]:
        """About `count` round values within the range."""
        raw = (self.high - self.low) / max(count, 1) or 1.0
        power = 10.0 ** np.floor(np.log10(raw))
        step = next(power * factor for factor in (1, 2, 3, 5, 10) if power * factor >= raw * 0.999)
        first = np.ceil(self.low / step - 1e-9)
        last = np.floor(self.high / step + 1e-9)
        return [float(step * i) + 0.0 for i in np.arange(first, last + 1)]  # + 0.0: no "-0"


def tag(name: str, content: str = "", **attributes: object) -> str:
    """An element; underscores in attribute names stand for hyphens, a trailing one is dropped."""
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{_text(value)}"'
        for key, value in attributes.items()
    )
    return f"<{name}{written}>{content}</{name}>" if content else f"<{name}{written}/>"


def text(x: float, y: float, words: str, **attributes: object) -> str:
    """A line of text."""
    return tag("text", escape(words), x=float(x), y=float(y), **attributes)


def line(x: FloatArray, y: FloatArray) -> str:
    """Path data of a polyline through pixels `x`, `y` (N,)."""
    points = [f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True)]
    return "M" + "L".join(points) if points else ""


def dots(x: FloatArray, y: FloatArray) -> str:
    """Path data of round dots; needs `stroke-linecap: round`."""
    return "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x, y, strict=True))


def thinned(t: FloatArray, y: FloatArray, columns: int) -> tuple[FloatArray, FloatArray]:
    """Least and most of `y` (N,) in each of `columns` stretches of time: looks like all samples."""
    if len(t) <= 2 * columns:
        return t, y
    begins = np.unique(np.linspace(0, len(t), columns, endpoint=False).astype(int))
    least, most = np.minimum.reduceat(y, begins), np.maximum.reduceat(y, begins)
    return np.repeat(t[begins], 2), np.stack([least, most], axis=1).ravel()


def group(parts: Sequence[str], **attributes: object) -> str:
    """Several elements under common attributes."""
    return tag("g", "".join(parts), **attributes)


def _text(value: object) -> str:
    return f"{value:.1f}" if isinstance(value, float) else escape(str(value), quote=True)
