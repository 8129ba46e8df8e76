"""Where marks of small charts stand; templates draw them as SVG, styles colour them.

Coordinates are those of a viewBox `WIDTH` wide. Whatever a chart shows is in a table, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import FloatArray
from hil.models import CHAMPION_EVENTS, Entry
from hil.report import number

WIDTH, LEFT, RIGHT = 720.0, 64.0, 16.0
ROW, TOP, BELOW = 30.0, 14.0, 44.0
HEIGHT = 240.0
MOST_DEEDS = 40
MOST_LABELS = 6
DATE = len("2026-11-22")

GLYPHS = {
    "registered": ("○", "registered"),
    "challenger": ("◇", "made challenger"),
    "promoted": ("▲", "promoted to champion"),
    "kept": ("✕", "compared, and not promoted"),
    "rolled-back": ("◀", "champion again"),
    "head-adopted": ("·", "head of the log adopted"),
    "repaired": ("✚", "log repaired"),
}


@dataclass(frozen=True, slots=True)
class Scale:
    """Values to coordinates.

    Attributes:
        low, high: Of the values.
        begin, end: Of the coordinates.
    """

    low: float
    high: float
    begin: float
    end: float

    def __call__(self, value: float) -> float:
        """The coordinate, rounded as a file needs it, within the picture."""
        share = (value - self.low) / (self.high - self.low)
        return round(self.begin + min(max(share, -0.02), 1.02) * (self.end - self.begin), 1)


def timeline(log: Sequence[Entry]) -> dict[str, Any]:
    """Who was champion, deed by deed: a row per version, a column per deed, newest ones only."""
    log = [entry for entry in log if entry.version]  # events of the log itself have no row
    deeds = list(enumerate(log))[-MOST_DEEDS:]
    versions = sorted({entry.version for _, entry in deeds}, reverse=True)
    x = Scale(0, max(len(deeds) - 1, 1), LEFT + 14, WIDTH - RIGHT - 14)
    y = {version: TOP + ROW * (i + 0.5) for i, version in enumerate(versions)}
    bottom = TOP + ROW * len(versions)
    marks = [
        {"x": x(i), "y": y[entry.version], "glyph": GLYPHS[entry.event][0], "event": entry.event,
         "text": f"v{entry.version} {GLYPHS[entry.event][1]}, {entry.at[:16]} UTC"}
        for i, (_, entry) in enumerate(deeds)
    ]  # fmt: skip
    return {
        "width": WIDTH, "height": bottom + BELOW, "left": LEFT, "right": WIDTH - RIGHT,
        "bottom": bottom, "marks": marks, "spans": list(_reigns(deeds, x, y)),
        "rows": [{"y": y[version], "label": f"v{version}"} for version in versions],
        "ticks": _ticks([x(i) for i in range(len(deeds))], [entry.at for _, entry in deeds]),
        "glyphs": [told for event, told in GLYPHS.items() if any(e.event == event for e in log)],
        "left_out": len(log) - len(deeds),
    }  # fmt: skip


def _reigns(
    deeds: Sequence[tuple[int, Entry]], x: Scale, y: dict[int, float]
) -> Iterator[dict[str, float]]:
    """From a promotion, or the way back, to the next."""
    crowned = [(i, e.version) for i, (_, e) in enumerate(deeds)
               if e.event in CHAMPION_EVENTS]  # fmt: skip
    ends = [*(i for i, _ in crowned), len(deeds)][1:]  # none where nobody was crowned
    for (begin, version), end in zip(crowned, ends, strict=True):
        last = WIDTH - RIGHT if end == len(deeds) else x(end)
        yield {"x": x(begin), "y": y[version], "width": round(last - x(begin), 1)}


def control_chart(
    values: FloatArray,
    expected: FloatArray,
    limit: FloatArray,
    at: Sequence[float],
    changed: Sequence[bool],
    champions: Sequence[int],
    labels: Sequence[str],
) -> dict[str, Any]:
    """One feature of all probes, with the limits that an unchanged robot would keep.

    Args:
        values: (P,) as shown.
        expected: (P,) of an unchanged robot.
        limit: (P,) how far from it is called changed.
        at: (P,) where each stands: Unix time, or its number.
        changed: (P,) whether this feature is called changed.
        champions: (P,) version each was compared with.
        labels: (P,) what is written below each.
    """
    x = Scale(min(at), max(at) if max(at) > min(at) else min(at) + 1, LEFT + 12, WIDTH - RIGHT - 12)
    low, high = _range(values, expected, limit)
    y = Scale(low, high, HEIGHT, TOP)
    marks = [
        {"x": x(where), "y": y(value), "changed": bad, "top": y(middle + room),
         "height": round(max(y(middle - room) - y(middle + room), 1.0), 1),
         "text": f"{label}: {number(float(value))}, expected {number(float(middle))} "
                 f"± {number(float(room))}"}
        for where, value, middle, room, bad, label
        in zip(at, values, expected, limit, changed, labels, strict=True)
    ]  # fmt: skip
    other = [
        {"x": round((x(at[i]) + x(at[i - 1])) / 2, 1), "label": f"v{champions[i]}"}
        for i in range(1, len(at)) if champions[i] != champions[i - 1]
    ]  # fmt: skip
    return {
        "width": WIDTH, "height": HEIGHT + BELOW, "left": LEFT, "right": WIDTH - RIGHT,
        "top": TOP, "bottom": HEIGHT, "marks": marks, "champions": other,
        "levels": [{"y": y(level), "label": f"{level:.6g}"} for level in _levels(low, high)],
        "ticks": _ticks([mark["x"] for mark in marks], labels),
    }  # fmt: skip


def _range(values: FloatArray, expected: FloatArray, limit: FloatArray) -> tuple[float, float]:
    """Every value, and limits that are not many times as wide: the first ones know nothing."""
    known = limit <= 4.0 * float(np.median(limit))
    every = np.concatenate([values, (expected - limit)[known], (expected + limit)[known]])
    every = every[np.isfinite(every)]
    low, high = (float(every.min()), float(every.max())) if len(every) else (0.0, 1.0)
    room = 0.08 * (high - low) or 1.0
    return low - room, high + room


def _levels(low: float, high: float) -> list[float]:
    """Round values, four or so of them."""
    rough = (high - low) / 4
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(one * power for one in (1, 2, 5, 10) if one * power >= rough)
    first = math.ceil(low / step)
    return [round(i * step, 12) for i in range(first, math.floor(high / step) + 1)]


def _ticks(x: Sequence[float], labels: Sequence[str]) -> list[dict[str, Any]]:
    """Days below the marks, of one day times; as many as there is room for, none twice."""
    one_day = len({label[:10] for label in labels}) == 1 and len(labels[0]) > DATE
    room, found, used = (WIDTH - LEFT - RIGHT) / MOST_LABELS, list[dict[str, Any]](), set[str]()
    for where, label in zip(x, labels, strict=True):
        text = label[DATE + 1 : 16] if one_day else label[:DATE]
        wide = 2 if one_day and len(found) == 1 else 1  # the first says the day, too
        free = not found or where >= found[-1]["x"] + wide * room
        if free and text not in used:
            used.add(text)
            shown = text if found or not one_day else f"{label[:DATE]} {text}"
            found.append({"x": where, "label": shown})
    return found
