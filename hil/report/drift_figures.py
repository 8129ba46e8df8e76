"""Figures of drift: what probes say over time and over temperature, beside what was expected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from hil.core import FloatArray
from hil.models import Banded
from hil.report import colours
from hil.report.blocks import Panel
from hil.report.traces import Trace, axes, line, markers
from hil.report.words import joint_title, number, when

SHARES = ("friction", "gain")
"""Features that are shares: shown in percent."""

LEGEND = (
    ("probe", colours.MEASURED, "●"),
    ("probe: this has changed", colours.PREDICTED, "◆"),
    ("where an unchanged robot's would lie", colours.NEUTRAL, "band"),
    ("another champion", colours.NEUTRAL, "dot"),
)

FEWEST = 3
"""Limits that fewer probes have told are wider than the picture."""


ROOM = 0.15
"""Of the height of a picture, for words above its marks."""

WHOLE = 20
"""Up to so many probes each has a number on the axis."""


@dataclass(frozen=True, slots=True)
class Along:
    """What the probes stand along: time, weeks, or their number.

    Attributes:
        x: Of every probe; text is a date.
        title: Of the axis, with its unit.
        word: What a place is called in a table, before its number.
        changes: Where another champion came, and which.
    """

    x: tuple[str | float, ...]
    title: str
    word: str = ""
    changes: tuple[tuple[str | float, str], ...] = ()

    def layout(self, y_title: str, **more: Any) -> dict[str, Any]:
        """Titled axes with the champions marked."""
        layout = axes(self.title, y_title, **more)
        if any(isinstance(x, str) for x in self.x):
            layout["xaxis"] |= {"type": "date", "nticks": 4}
        elif len(self.x) <= WHOLE:
            layout["xaxis"] |= {"dtick": 1}
        dots = {"color": colours.NEUTRAL, "width": 1.5, "dash": "dot"}
        mark = {"type": "line", "yref": "paper", "y0": 0, "y1": 1, "line": dots}
        word = {"yref": "paper", "y": 1, "yanchor": "top", "xanchor": "left", "showarrow": False}
        layout["shapes"] = [{"x0": x, "x1": x} | mark for x, _ in self.changes]
        layout["annotations"] = [{"x": x, "text": escape(text)} | word for x, text in self.changes]
        return layout

    def place(self, row: int) -> str:
        """Of a probe, for a table."""
        x = self.x[row]
        return when(f"{x}+00:00") if isinstance(x, str) else f"{self.word} {x:g}".strip()

    def placed(self, trace: Trace, rows: Sequence[int]) -> Trace:
        """A trace of some of the probes, at their places."""
        return trace | {"x": [self.x[row] for row in rows]}


def unit_of(name: str, effort_unit: str) -> str:
    """Unit in which a feature is shown."""
    what = name.rsplit(" ", 1)[1]
    if what in SHARES:
        return "%"
    return effort_unit if what == "offset" else "kg" if what == "mass" else "kg·m"


def over_time(told: Sequence[Banded], k: int, along: Along, effort_unit: str) -> Panel:
    """Feature `k` of every probe, and where it would lie if nothing had changed."""
    name = told[0].probe.features.names[k]
    values, expected, limit = _shown(told, k)
    unit = unit_of(name, effort_unit)
    layout = along.layout(f"{_what(name)} [{unit}]")
    layout["yaxis"] |= {"range": _range(told, values, expected, limit)}
    every = range(len(told))
    bars = [along.placed(trace, every) for trace in _bars(expected, limit)]
    data = [*bars, *_marks(told, values, along, _blamed(told, name))]
    said = f"{name} [{unit}] of {len(told)} probes: {_span(values)}; {_outside(told, k)}"
    return Panel(panel_title(told, k), {"data": data, "layout": layout}, said)


def over_temperature(told: Sequence[Banded], k: int, effort_unit: str) -> Panel:
    """Feature `k` against the joint's temperature, with what the newest charts say of the two."""
    name = told[0].probe.features.names[k]
    values, expected, _ = _shown(told, k)
    warm = np.array([one.probe.features.temperature[k] for one in told])
    along = Along(tuple(float(x) for x in warm), "joint temperature [°C]")
    same = [i for i, one in enumerate(told) if one.probe.champion == told[-1].probe.champion]
    rows = sorted((i for i in same if told[i].chart.reference >= FEWEST), key=lambda i: warm[i])
    unit = unit_of(name, effort_unit)
    data = _marks(told, values, along, _blamed(told, name))
    if len(rows) > 1:
        rows_ = np.array(rows)
        data.append(line(warm[rows_], expected[rows_], "expected", colours.NEUTRAL, dash="dash"))
    layout = axes("joint temperature [°C]", f"{_what(name)} [{unit}]")
    said = f"{name} [{unit}] from {_span(warm)} °C: {_span(values)}"
    return Panel(panel_title(told, k), {"data": data, "layout": layout}, said)


def chances(told: Sequence[Banded], along: Along) -> Panel:
    """How probable each probe is of an unchanged robot, on a logarithmic scale."""
    # Below that a normal distribution says nothing of a real robot.
    values = np.maximum([one.chance for one in told], 1e-12)
    layout = along.layout("probability [1]")
    lowest = float(np.log10(values.min()))
    bottom = min(-3.0, lowest - 0.5)
    # Above a probability of 1 there is room for the names of champions, less than to a next tick.
    layout["yaxis"] |= {"type": "log", "range": [bottom, -ROOM * bottom]}
    layout["yaxis"] |= {"exponentformat": "power", "dtick": max(1, int(np.ceil(-lowest / 6)))}
    rate = np.array([one.probe.false_alarm for one in told])
    every = range(len(told))
    limit = along.placed(line(rate, rate, "false alarm rate", colours.LIMIT, dash="dash"), every)
    said = f"probability of {len(told)} probes if nothing has changed: {_span(values)}"
    changed = [one.probe.changed for one in told]
    data = [limit, *_marks(told, values, along, changed)]
    return Panel("Could this be an unchanged robot?", {"data": data, "layout": layout}, said, True)


def errors(told: Sequence[Banded], along: Along, joints: Sequence[str], unit: str) -> Panel:
    """The champion's error on each probe, per joint."""
    rms = np.array([one.probe.features.rms for one in told])
    return joints_over("The champion's error", rms, along, joints, f"RMSE [{unit}]", log=True)


def temperatures(told: Sequence[Banded], along: Along, joints: Sequence[str]) -> Panel:
    """Mean temperature of each joint in each probe."""
    celsius = np.array([one.probe.features.temperature for one in told])[:, : 3 * len(joints) : 3]
    return joints_over("Joint temperatures", celsius, along, joints, "temperature [°C]")


def joints_over(
    title: str,
    values: FloatArray,
    along: Along,
    joints: Sequence[str],
    y_title: str,
    *,
    log: bool = False,
    more: Sequence[Trace] = (),
) -> Panel:
    """(P, n) one line per joint, with marks; names in the legend above the plots."""
    data = []
    for j, name in enumerate(joints):
        trace = line(values[:, j], values[:, j], joint_title(j, name), colours.of_joint(j))
        trace |= {"mode": "lines+markers", "showlegend": False}
        trace["line"] = trace["line"] | {"dash": colours.dash_of_joint(j)}
        trace["marker"] = {"symbol": colours.symbol_of_joint(j), "size": 6}
        data.append(along.placed(trace, range(len(values))))
    layout = along.layout(y_title)
    if log:
        layout["yaxis"] |= {"type": "log", "dtick": "D2"}
    said = ", ".join(f"{name} {_span(values[:, j])}" for j, name in enumerate(joints))
    return Panel(
        title, {"data": [*data, *more], "layout": layout}, f"{title}, {y_title}: {said}", True
    )


def joint_legend(joints: Sequence[str]) -> tuple[tuple[str, str, str], ...]:
    """As `joints_over` draws them."""
    glyph: Mapping[str, str] = {
        "circle": "●", "square": "■", "diamond": "◆", "triangle-up": "▲", "triangle-down": "▼",
        "cross": "✚", "x": "✖",
    }  # fmt: skip
    return tuple(
        (joint_title(j, name), colours.of_joint(j), glyph[colours.symbol_of_joint(j)])
        for j, name in enumerate(joints)
    )


def panel_title(told: Sequence[Banded], k: int) -> str:
    """`J2 shoulder_lift_joint`, or what of the load."""
    where, what = told[0].probe.features.names[k].rsplit(" ", 1)
    return f"load, {what}" if where == "load" else joint_title(k // 3, where)


def _shown(told: Sequence[Banded], k: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Values, what was expected, and the limits of feature `k`, (P,) each, as they are shown."""
    scale = 100.0 if told[0].probe.features.names[k].rsplit(" ", 1)[1] in SHARES else 1.0
    rows = [(one.probe.features.values[k], one.expected[k], one.chart.limit[k]) for one in told]
    values, expected, limit = scale * np.array(rows).T
    return values, expected, limit


def _bars(expected: FloatArray, limit: FloatArray) -> list[Trace]:
    """A broad bar per probe: a line would say something of the time between them."""
    area = {"color": colours.FILL, "thickness": 9, "width": 0}
    ends = {"color": colours.NEUTRAL, "thickness": 1, "width": 4.5}
    bar = markers(expected, expected, "unchanged", colours.FILL, size=1) | {"hoverinfo": "skip"}
    return [bar | {"error_y": {"type": "data", "array": limit} | look} for look in (area, ends)]


def _blamed(told: Sequence[Banded], name: str) -> list[bool]:
    """Which probes name a feature, or the load it belongs to, as changed."""
    wanted = "load" if name.startswith("load ") else name
    return [any(cause.name == wanted for cause in one.probe.causes) for one in told]


def _marks(
    told: Sequence[Banded], values: FloatArray, along: Along, changed: Sequence[bool]
) -> list[Trace]:
    looks = (
        (False, "probe", colours.MEASURED, "circle", 7.0),
        (True, "changed", colours.PREDICTED, "diamond", 10.0),
    )
    found = []
    for wanted, name, colour, symbol, size in looks:
        rows = [i for i, one in enumerate(changed) if one == wanted]
        if rows:
            y = values[np.array(rows)]
            texts = [told[i].probe.text for i in rows]
            trace = markers(y, y, name, colour, symbol=symbol, size=size, opacity=1, text=texts)
            found.append(along.placed(trace, rows))
    return found


def _range(
    told: Sequence[Banded], values: FloatArray, expected: FloatArray, limit: FloatArray
) -> list[float]:
    """Of y: all probes, and the limits that enough probes have told."""
    known = np.array([one.chart.reference >= FEWEST for one in told])
    parts = [values, (expected - limit)[known], (expected + limit)[known]]
    every = np.concatenate(parts)
    low, high = float(np.min(every)), float(np.max(every))
    room = 0.12 * (high - low) or 1.0
    return [low - room, high + room]


def _what(name: str) -> str:
    where, what = name.rsplit(" ", 1)
    return what if where == "load" else f"change of {what}" if what in SHARES else what


def _outside(told: Sequence[Banded], k: int) -> str:
    count = sum(bool(one.chart.alarm[k]) for one in told)
    return f"{count} outside what is expected"


def _span(values: FloatArray) -> str:
    known = values[np.isfinite(values)]
    if not len(known):
        return "not known"
    return f"{number(float(known.min()))} to {number(float(known.max()))}"
