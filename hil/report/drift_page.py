"""The page of `hil drift`: what probes have said of a robot, and its champions, over time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import DataError, FloatArray
from hil.models import (
    CHAMPION_EVENTS,
    JOINT_FEATURES,
    REFERENCE,
    ChartedProbe,
    Entry,
    Registry,
    charted_probes,
)
from hil.report import colours
from hil.report.page import Badge, Cell, Column, KeyFigure, Page, Section, Table, cells, write_page
from hil.report.words import UNKNOWN, counted, joint_title, number, when
from hil.studies import Axis, Curve, Figure, Look, Mark, Panel

EVENTS = {
    "registered": "registered",
    "challenger": "made challenger",
    "promoted": "promoted to champion",
    "kept": "not promoted",
    "rolled-back": "champion again",
    "head-adopted": "head of the log adopted",
    "repaired": "log repaired",
}

SHARES = ("friction", "gain")
"""Features that are shares: shown in percent."""

FEWEST = 3
"""Limits that fewer probes have told are wider than the picture."""

ROOM = 0.15
"""Of the height of a picture, for words above its marks."""

WHOLE = 20
"""Up to so many probes each has a number on the axis."""


def write_drift_page(registry: Registry, name: str, path: Path) -> Path:
    """Write the page of a name to `path`, replacing an older one whole.

    Raises:
        DataError: There are no probes yet, or a champion cannot be read.
        RegistryError: There is no such name, or its history is damaged.
        RecordingError: The file cannot be written.
    """
    return write_page(drift_page(registry, name), path)


def drift_page(registry: Registry, name: str) -> Page:
    """The page as blocks.

    Raises:
        DataError, RegistryError: As `write_drift_page`.
    """
    log = registry.log(name)
    told = charted_probes(registry, name)
    if not told:
        raise DataError(f"there are no probes of {name} yet", hint=f"hil drift {name} PROBE")
    told, along = in_time(told, log)
    unit = effort_unit(registry, name)
    newest = told[-1]
    return Page(
        title=f"{name}: has it changed?",
        subtitle=f"{counted(len(told), 'probe')}, champion "
        f"{_champion(registry, name)}, newest probe {when(newest.probe.at) or UNKNOWN}",
        badge=badge(newest),
        summary=_sentence(newest.probe.text),
        key_figures=key_figures(told),
        sections=(*drift_sections(told, along, unit), champion_changes(log)),
        footer=f"Made by hil {version('hil')} from the registry's files; it can be made again at "
        f"any time: hil drift {name} --page FILE.",
    )


def effort_unit(registry: Registry, name: str) -> str:
    """Unit of the efforts of a name's models."""
    versions = registry.versions(name)
    kind = versions[-1].facts.get("effort_kind") if versions else None
    return "A" if kind == "current" else "N·m"


def in_time(told: Sequence[ChartedProbe], log: Sequence[Entry]) -> tuple[list[ChartedProbe], Along]:
    """Probes along the time they were taken at; along their number where that is not known."""
    if all(_moment(one.probe.at) for one in told):
        told = sorted(told, key=lambda one: _moment(one.probe.at))
        changes = [
            (_moment(entry.at), f"v{entry.version}")
            for entry in log
            if entry.event in CHAMPION_EVENTS and entry.version
        ]
        x = tuple(_moment(one.probe.at) for one in told)
        return list(told), Along(x, "time [UTC]", changes=tuple(changes))
    at = [
        (i + 0.5, f"v{one.probe.champion}")
        for i, one in enumerate(told)
        if i == 0 or one.probe.champion != told[i - 1].probe.champion
    ]
    numbers = tuple(float(i + 1) for i in range(len(told)))
    return list(told), Along(numbers, "probe [1]", "probe", tuple(at))


def badge(newest: ChartedProbe) -> Badge:
    """What the newest probe says, in a word."""
    if newest.probe.changed:
        return Badge("changed", "warn")
    return Badge("unchanged", "pass") if newest.probe.reference >= 2 else Badge("too early", "")


def key_figures(told: Sequence[ChartedProbe]) -> tuple[KeyFigure, ...]:
    """How many probes, how many that say something, how sure."""
    probe = told[-1].probe
    changed = sum(one.probe.changed for one in told)
    names = len(probe.features.names)
    return (
        KeyFigure("probes", str(len(told)), f"{REFERENCE} after each new champion are reference"),
        KeyFigure("call it changed", str(changed)),
        KeyFigure(
            "false alarms", f"≤ {100 * probe.false_alarm:g} %",
            f"of probes, all {names} numbers of all joints together",
        ),
        KeyFigure(
            "newest", _percent(told[-1].chance), "chance at most that an unchanged robot shows this"
        ),
    )  # fmt: skip


def drift_sections(told: Sequence[ChartedProbe], along: Along, unit: str) -> list[Section]:
    """What the probes say: all together, then each kind of change by itself."""
    return [
        _probes_section(told, along, unit),
        *(_feature_section(told, along, unit, what) for what in JOINT_FEATURES[:1]),
        _temperature_section(told, along, unit),
        *(_feature_section(told, along, unit, what) for what in JOINT_FEATURES[1:]),
        _load_section(told, along, unit),
    ]


def champion_changes(log: Sequence[Entry]) -> Section:
    """What was done to the models, and why."""
    titles = ("when", "version", "what was done", "why", "by")
    columns = tuple(Column(title, number=False) for title in titles)
    rows = tuple(
        cells(
            when(e.at) or UNKNOWN,
            e.label or UNKNOWN,
            EVENTS.get(e.event, e.event),
            e.reason or UNKNOWN,
            e.by,
        )
        for e in log
    )
    lead = (
        "From the registry's log. With every new champion the comparison begins anew: its first "
        f"{REFERENCE} probes tell what the robot is like under it."
    )
    return Section(
        "champions", "Champions", lead, (Table("What was done to the models", columns, rows),)
    )


def joint_names(told: Sequence[ChartedProbe]) -> list[str]:
    """Of the robot, from the features' names."""
    names = told[0].probe.features.names[:: len(JOINT_FEATURES)]
    return [name.rsplit(" ", 1)[0] for name in names if not name.startswith("load ")]


def _probes_section(told: Sequence[ChartedProbe], along: Along, unit: str) -> Section:
    rate = 100 * told[-1].probe.false_alarm
    joints = joint_names(told)
    chance = Figure(
        "chance",
        "Chance",
        "How probable it is at most that an unchanged robot shows anything as large, in any joint "
        f"or in the load. Below {rate:g} % a probe is called changed, so that an unchanged robot "
        "is called so no more often.",
        (chances(told, along),),
        0,
    )
    error = Figure(
        "error",
        "Error",
        "Of the champion on the probe, whatever the reason.",
        (errors(told, along, joints, unit),),
        0,
    )
    return Section("probes", "Probes", "", (chance, _probes_table(told, along), error))


def _probes_table(told: Sequence[ChartedProbe], along: Along) -> Table:
    columns = (
        Column("taken", number=False), Column("what it says", number=False),
        Column("chance", number=False), Column("champion", number=False),
        Column("probe", number=False),
    )  # fmt: skip
    rows = tuple(
        (
            Cell(along.place(i)),
            Cell(one.probe.text, "warn" if one.probe.changed else ""),
            Cell(_percent(one.chance)),
            Cell(f"v{one.probe.champion}"),
            Cell(Path(one.probe.source).name),
        )
        for i, one in enumerate(told)
    )
    return Table("Every probe, and what it says has changed", columns, rows)


def _feature_section(told: Sequence[ChartedProbe], along: Along, unit: str, what: str) -> Section:
    words = {
        "friction": "How much more friction than the champion believes, joint by joint.",
        "gain": "How much more effort for the same torque, joint by joint: a drive's gain is off.",
        "offset": "What is added to the effort at all times, joint by joint.",
    }
    named = [k for k, name in enumerate(told[0].probe.features.names) if name.endswith(f" {what}")]
    return _kind(told, along, unit, what.capitalize(), words[what], named)


def _load_section(told: Sequence[ChartedProbe], along: Along, unit: str) -> Section:
    named = [k for k, name in enumerate(told[0].probe.features.names) if name.startswith("load ")]
    lead = "What hangs at the flange besides what was declared: its mass, and mass times place."
    return _kind(told, along, unit, "Load", lead, named)


def _kind(
    told: Sequence[ChartedProbe],
    along: Along,
    unit: str,
    title: str,
    lead: str,
    named: Sequence[int],
) -> Section:
    """Panels of features of a kind, open if one of them is ever a cause, or friction."""
    wide = (
        f"{lead} Each is told as if it were the only change; bars show where an unchanged robot's "
        "would lie at the joint's temperature. The first probes under a champion have bars wider "
        "than the picture."
    )
    panels = tuple(over_time(told, k, along, unit) for k in named)
    kind = title.lower()
    causes = (cause.name for one in told for cause in one.probe.causes)
    is_cause = any(name == kind or name.endswith(f" {kind}") for name in causes)
    figure = Figure(kind, title, wide, panels, 0)
    return Section(kind, title, "", (figure,), folded=kind != "friction" and not is_cause)


def _temperature_section(told: Sequence[ChartedProbe], along: Along, unit: str) -> Section:
    names, joints = told[0].probe.features.names, joint_names(told)
    celsius = np.array([one.probe.features.temperature for one in told])
    if not np.isfinite(celsius).all():
        lead = "The recordings have no joint temperatures: what warmth does counts as noise."
        return Section("temperature", "Temperature", lead)
    named = [k for k, name in enumerate(names) if name.endswith(" friction")]
    panels = tuple(over_temperature(told, k, unit) for k in named)
    lead = (
        "Friction is another at another temperature; what of it the champion does not know shows "
        "as a slope here. The reference probes tell it, and it is no change."
    )
    mean = "Mean of each joint in each probe."
    blocks = (
        Figure("friction", "Friction over temperature", lead, panels, 0),
        Figure("temperatures", "Over time", mean, (temperatures(told, along, joints),), 0),
    )
    return Section("temperature", "Temperature", "", blocks)


def _champion(registry: Registry, name: str) -> str:
    number_ = registry.aliases(name).champion
    return f"v{number_}" if number_ else UNKNOWN


def _percent(share: float) -> str:
    return "< 0.01 %" if share < 1e-4 else f"{number(100 * share, 2)} %"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _moment(at: str) -> str:
    """As plotly has dates; empty for what is none."""
    try:
        return datetime.fromisoformat(at).astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S")
    except ValueError:
        return ""


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

    def panel(self, title: str, y_title: str, curves: Sequence[Curve], **more: Any) -> Panel:
        """A panel along this axis, with the champions marked."""
        dated = any(isinstance(x, str) for x in self.x)
        axis = Axis("date") if dated else Axis(whole=len(self.x) <= WHOLE)
        marks = tuple(Mark(x, text, "another champion") for x, text in self.changes)
        return Panel(title, self.title, y_title, tuple(curves), x_axis=axis, marks=marks, **more)

    def place(self, row: int) -> str:
        """Of a probe, for a table."""
        x = self.x[row]
        return when(f"{x}+00:00") if isinstance(x, str) else f"{self.word} {x:g}".strip()

    def at(self, rows: Iterable[int]) -> list[str | float]:
        """Places of some of the probes."""
        return [self.x[row] for row in rows]


def over_time(told: Sequence[ChartedProbe], k: int, along: Along, effort_unit: str) -> Panel:
    """Feature `k` of every probe, and where it would lie if nothing had changed."""
    name = told[0].probe.features.names[k]
    values, expected, limit = _shown(told, k)
    unit = unit_of(name, effort_unit)
    name_ = "where an unchanged robot's would lie"
    unchanged = Curve(name_, along.x, expected, "ranges", limit, Look(colours.FILL, size=1))
    outside = sum(bool(one.chart.alarm[k]) for one in told)
    return along.panel(
        panel_title(told, k),
        f"{_what(name)} [{unit}]",
        [unchanged, *_marks(told, values, along, _blamed(told, name))],
        y_axis=Axis(limits=_range(told, values, expected, limit)),
        alt=f"{name} [{unit}] of {len(told)} probes: {_span(values)}; {outside} outside what is "
        "expected",
    )


def over_temperature(told: Sequence[ChartedProbe], k: int, effort_unit: str) -> Panel:
    """Feature `k` against the joint's temperature, with what the newest charts say of the two."""
    name = told[0].probe.features.names[k]
    values, expected, _ = _shown(told, k)
    warm = np.array([one.probe.features.temperature[k] for one in told])
    along = Along(tuple(float(x) for x in warm), "joint temperature [°C]")
    same = [i for i, one in enumerate(told) if one.probe.champion == told[-1].probe.champion]
    rows = sorted((i for i in same if told[i].chart.reference >= FEWEST), key=lambda i: warm[i])
    unit = unit_of(name, effort_unit)
    curves = _marks(told, values, along, _blamed(told, name))
    if len(rows) > 1:
        look = Look(colours.NEUTRAL, "dash")
        curves.append(
            Curve("expected under the newest champion", warm[rows], expected[rows], look=look)
        )
    title, y_title = panel_title(told, k), f"{_what(name)} [{unit}]"
    alt = f"{name} [{unit}] from {_span(warm)} °C: {_span(values)}"
    return Panel(title, along.title, y_title, tuple(curves), alt=alt)


def chances(told: Sequence[ChartedProbe], along: Along) -> Panel:
    """How probable each probe is of an unchanged robot, on a logarithmic scale."""
    # Below that a normal distribution says nothing of a real robot.
    values = np.maximum([one.chance for one in told], 1e-12)
    bottom = min(-3.0, float(np.log10(values.min())) - 0.5)
    rate = np.array([one.probe.false_alarm for one in told])
    limit = Curve("false alarm rate", along.x, rate, look=Look(colours.LIMIT, "dash"))
    changed = [one.probe.changed for one in told]
    return along.panel(
        "Could this be an unchanged robot?",
        "probability [1]",
        [limit, *_marks(told, values, along, changed, "changed")],
        # Above a probability of 1 is room for the names of champions, less than to a next tick.
        y_axis=Axis("log", (10.0**bottom, 10.0 ** (-ROOM * bottom))),
        alt=f"probability of {len(told)} probes if nothing has changed: {_span(values)}",
        wide=True,
    )


def errors(told: Sequence[ChartedProbe], along: Along, joints: Sequence[str], unit: str) -> Panel:
    """The champion's error on each probe, per joint."""
    rms = np.array([one.probe.features.rms for one in told])
    return joints_over("The champion's error", rms, along, joints, f"RMSE [{unit}]", log=True)


def temperatures(told: Sequence[ChartedProbe], along: Along, joints: Sequence[str]) -> Panel:
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
) -> Panel:
    """(P, n) one line per joint, with marks."""
    curves = [
        Curve(joint_title(j, name), along.x, values[:, j], "marked", look=colours.of_joint(j))
        for j, name in enumerate(joints)
    ]
    said = ", ".join(f"{name} {_span(values[:, j])}" for j, name in enumerate(joints))
    axis = Axis("log" if log else "linear")
    alt = f"{title}, {y_title}: {said}"
    return along.panel(title, y_title, curves, y_axis=axis, alt=alt, wide=True)


def panel_title(told: Sequence[ChartedProbe], k: int) -> str:
    """`J2 shoulder_lift_joint`, or what of the load."""
    where, what = told[0].probe.features.names[k].rsplit(" ", 1)
    return f"load, {what}" if where == "load" else joint_title(k // 3, where)


def unit_of(name: str, effort_unit: str) -> str:
    """Unit in which a feature is shown."""
    what = name.rsplit(" ", 1)[1]
    if what in SHARES:
        return "%"
    return effort_unit if what == "offset" else "kg" if what == "mass" else "kg·m"


def _shown(told: Sequence[ChartedProbe], k: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Values, what was expected, and the limits of feature `k`, (P,) each, as they are shown."""
    scale = 100.0 if told[0].probe.features.names[k].rsplit(" ", 1)[1] in SHARES else 1.0
    rows = [(one.probe.features.values[k], one.expected[k], one.chart.limit[k]) for one in told]
    values, expected, limit = scale * np.array(rows).T
    return values, expected, limit


def _blamed(told: Sequence[ChartedProbe], name: str) -> list[bool]:
    """Which probes name a feature, or the load it belongs to, as changed."""
    wanted = "load" if name.startswith("load ") else name
    return [any(cause.name == wanted for cause in one.probe.causes) for one in told]


def _marks(
    told: Sequence[ChartedProbe],
    values: FloatArray,
    along: Along,
    changed: Sequence[bool],
    what: str = "this has changed",
) -> list[Curve]:
    looks = (
        (False, "probe", Look(colours.MEASURED, size=7, opacity=1)),
        (True, f"probe: {what}", Look(colours.PREDICTED, symbol="diamond", size=10,
                                               opacity=1)),
    )  # fmt: skip
    found = []
    for wanted, name, look in looks:
        rows = [i for i, one in enumerate(changed) if one == wanted]
        if rows:
            texts = [told[i].probe.text for i in rows]
            found.append(Curve(name, along.at(rows), values[rows], "points", (), look, texts))
    return found


def _range(
    told: Sequence[ChartedProbe], values: FloatArray, expected: FloatArray, limit: FloatArray
) -> tuple[float, float]:
    """Of y: all probes, and the limits that enough probes have told."""
    known = np.array([one.chart.reference >= FEWEST for one in told])
    parts = [values, (expected - limit)[known], (expected + limit)[known]]
    every = np.concatenate(parts)
    low, high = float(np.min(every)), float(np.max(every))
    room = 0.12 * (high - low) or 1.0
    return low - room, high + room


def _what(name: str) -> str:
    where, what = name.rsplit(" ", 1)
    return what if where == "load" else f"change of {what}" if what in SHARES else what


def _span(values: FloatArray) -> str:
    known = values[np.isfinite(values)]
    if not len(known):
        return "not known"
    return f"{number(float(known.min()))} to {number(float(known.max()))}"
