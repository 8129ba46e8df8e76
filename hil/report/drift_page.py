"""The page of `hil drift`: what probes have said of a robot, and its champions, over time."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np

from hil.core import DataError
from hil.models import CHAMPION_EVENTS, JOINT_FEATURES, REFERENCE, Banded, Entry, Registry, banded
from hil.report import colours
from hil.report import drift_figures as figures
from hil.report.blocks import (
    Badge,
    Block,
    Cell,
    Column,
    KeyFigure,
    Page,
    Plots,
    Section,
    Table,
    cells,
)
from hil.report.drift_figures import Along
from hil.report.render import write_page
from hil.report.words import UNKNOWN, counted, number, when

EVENTS = {
    "registered": "registered",
    "challenger": "made challenger",
    "promoted": "promoted to champion",
    "kept": "not promoted",
    "rolled-back": "champion again",
    "head-adopted": "head of the log adopted",
    "repaired": "log repaired",
}


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
    told = banded(registry, name)
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


def in_time(told: Sequence[Banded], log: Sequence[Entry]) -> tuple[list[Banded], Along]:
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


def badge(newest: Banded) -> Badge:
    """What the newest probe says, in a word."""
    if newest.probe.changed:
        return Badge("changed", "warn")
    return Badge("unchanged", "pass") if newest.probe.reference >= 2 else Badge("too early", "")


def key_figures(told: Sequence[Banded]) -> tuple[KeyFigure, ...]:
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


def drift_sections(told: Sequence[Banded], along: Along, unit: str) -> list[Section]:
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


def joint_names(told: Sequence[Banded]) -> list[str]:
    """Of the robot, from the features' names."""
    names = told[0].probe.features.names[:: len(JOINT_FEATURES)]
    return [name.rsplit(" ", 1)[0] for name in names if not name.startswith("load ")]


def _probes_section(told: Sequence[Banded], along: Along, unit: str) -> Section:
    rate = 100 * told[-1].probe.false_alarm
    joints = joint_names(told)
    chance = Plots(
        "Chance",
        "How probable it is at most that an unchanged robot shows anything as large, in any joint "
        f"or in the load. Below {rate:g} % a probe is called changed, so that an unchanged robot "
        "is called so no more often.",
        (figures.chances(told, along),),
        (
            figures.LEGEND[0],
            ("probe: changed", *figures.LEGEND[1][1:]),
            ("false alarm rate", colours.LIMIT, "dash"),
            figures.LEGEND[3],
        ),
    )
    error = Plots(
        "Error",
        "Of the champion on the probe, whatever the reason.",
        (figures.errors(told, along, joints, unit),),
        figures.joint_legend(joints),
    )
    return Section("probes", "Probes", "", (chance, _probes_table(told, along), error))


def _probes_table(told: Sequence[Banded], along: Along) -> Table:
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


def _feature_section(told: Sequence[Banded], along: Along, unit: str, what: str) -> Section:
    words = {
        "friction": "How much more friction than the champion believes, joint by joint.",
        "gain": "How much more effort for the same torque, joint by joint: a drive's gain is off.",
        "offset": "What is added to the effort at all times, joint by joint.",
    }
    named = [k for k, name in enumerate(told[0].probe.features.names) if name.endswith(f" {what}")]
    return _kind(told, along, unit, what.capitalize(), words[what], named)


def _load_section(told: Sequence[Banded], along: Along, unit: str) -> Section:
    named = [k for k, name in enumerate(told[0].probe.features.names) if name.startswith("load ")]
    lead = "What hangs at the flange besides what was declared: its mass, and mass times place."
    return _kind(told, along, unit, "Load", lead, named)


def _kind(
    told: Sequence[Banded], along: Along, unit: str, title: str, lead: str, named: Sequence[int]
) -> Section:
    """Panels of features of a kind, open if one of them is ever a cause, or friction."""
    wide = (
        f"{lead} Each is told as if it were the only change; bars show where an unchanged robot's "
        "would lie at the joint's temperature. The first probes under a champion have bars wider "
        "than the picture."
    )
    panels = tuple(figures.over_time(told, k, along, unit) for k in named)
    kind = title.lower()
    causes = (cause.name for one in told for cause in one.probe.causes)
    is_cause = any(name == kind or name.endswith(f" {kind}") for name in causes)
    plots = Plots(title, wide, panels, figures.LEGEND)
    return Section(kind, title, "", (plots,), folded=kind != "friction" and not is_cause)


def _temperature_section(told: Sequence[Banded], along: Along, unit: str) -> Section:
    names, joints = told[0].probe.features.names, joint_names(told)
    celsius = np.array([one.probe.features.temperature for one in told])
    if not np.isfinite(celsius).all():
        lead = "The recordings have no joint temperatures: what warmth does counts as noise."
        return Section("temperature", "Temperature", lead)
    named = [k for k, name in enumerate(names) if name.endswith(" friction")]
    panels = tuple(figures.over_temperature(told, k, unit) for k in named)
    lead = (
        "Friction is another at another temperature; what of it the champion does not know shows "
        "as a slope here. The reference probes tell it, and it is no change."
    )
    legend = (*figures.LEGEND[:2], ("expected under the newest champion", colours.NEUTRAL, "dash"))
    blocks: tuple[Block, ...] = (
        Plots("Friction over temperature", lead, panels, legend),
        Plots(
            "Over time", "Mean of each joint in each probe.",
            (figures.temperatures(told, along, joints),), figures.joint_legend(joints),
        ),
    )  # fmt: skip
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
