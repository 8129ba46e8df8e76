"""What probes have said of a robot, for its page: a chart per feature, and a table."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import HilError
from hil.dashboard.drawing import control_chart
from hil.dashboard.registered import run_link
from hil.dashboard.settings import Settings
from hil.models import PROBES_FILE, UNITS, Banded, Probe, Registry, banded, probes_of
from hil.report import number, when

SHARES = ("friction", "gain")
"""Features that are shares: shown in percent."""


def drift_of(name: str, feature: str, unit: str, settings: Settings) -> dict[str, Any]:
    """`probes` (newest first), `features`, `feature` and its `chart`; `problem` in words.

    Args:
        name: Of the models.
        feature: Which is charted; anything but one of them is what has changed last.
        unit: Of the efforts.
        settings: What is served.
    """
    registry, problem = Registry(settings.registry), ""
    told: Sequence[Banded] = ()
    probes: Sequence[Probe] = ()
    try:
        probes = probes_of(registry, name)
        told = _banded(settings.registry, name, _stamp(settings.registry / name)) if probes else ()
    except HilError as error:
        problem = error.message
    except (OSError, ValueError) as error:  # a model that is no model any more
        problem = f"the probes cannot be charted: {error}"
    names = probes[-1].features.names if probes else ()
    chosen = feature if feature in names else _most_telling(probes)
    alike = [one for one in told if one.probe.features.names == names]
    return {
        "problem": problem,
        "features": names,
        "feature": chosen,
        "unit": _unit(chosen, unit),
        "chart": _chart(_in_time(alike), chosen) if alike else None,
        "probes": [_row(probe, settings) for probe in reversed(probes)],
    }


@lru_cache(maxsize=32)
def _banded(registry: Path, name: str, stamp: str) -> tuple[Banded, ...]:
    """Models are loaded for that; `stamp` changes when they, or the probes, do."""
    return tuple(banded(Registry(registry), name))


def _stamp(home: Path) -> str:
    """Versions never change but by damage, which changes their folders or files."""
    found = [home / PROBES_FILE, *home.glob("v*/*")]
    return ";".join(f"{p.name}:{p.stat().st_mtime_ns}:{p.stat().st_size}" for p in sorted(found))


def _most_telling(probes: Sequence[Probe]) -> str:
    """What has changed last; where nothing ever has, the first feature."""
    for probe in reversed(probes):
        for cause in probe.causes:
            wanted = "load mass" if cause.name == "load" else cause.name
            if wanted in probe.features.names:
                return wanted
    return probes[-1].features.names[0] if probes else ""


def _in_time(told: Sequence[Banded]) -> list[Banded]:
    return sorted(told, key=lambda one: _seconds(one.probe.at)) if _timed(told) else list(told)


def _timed(told: Sequence[Banded]) -> bool:
    return all(np.isfinite(_seconds(one.probe.at)) for one in told)


def _chart(told: Sequence[Banded], feature: str) -> dict[str, Any]:
    k = told[0].probe.features.names.index(feature)
    scale = 100.0 if feature.rsplit(" ", 1)[1] in SHARES else 1.0
    rows = [(one.probe.features.values[k], one.expected[k], one.chart.limit[k]) for one in told]
    values, expected, limit = scale * np.array(rows).T
    timed = _timed(told)
    at = [_seconds(one.probe.at) if timed else float(i + 1) for i, one in enumerate(told)]
    labels = [one.probe.at[:16] if timed else f"probe {i + 1}" for i, one in enumerate(told)]
    changed = [bool(one.chart.alarm[k]) for one in told]
    champions = [one.probe.champion for one in told]
    return control_chart(values, expected, limit, at, changed, champions, labels)


def _unit(feature: str, effort: str) -> str:
    what = feature.rsplit(" ", 1)[-1]
    return "%" if what in SHARES else UNITS.get(what, effort)


def _row(probe: Probe, settings: Settings) -> dict[str, Any]:
    chance = min(1.0, 2.0 * len(probe.features.names) * probe.p)
    return {
        "taken": when(probe.at) or "not known",
        "text": probe.text,
        "changed": probe.changed,
        "early": probe.reference < 2,
        "chance": "< 0.01 %" if chance < 1e-4 else f"{number(100 * chance, 2)} %",
        "champion": probe.champion,
        "source": run_link(probe.source, settings, probe.uid if probe.program else ""),
    }


def _seconds(at: str) -> float:
    try:
        told = datetime.fromisoformat(at)
    except ValueError:
        return float("nan")
    return (told if told.tzinfo else told.replace(tzinfo=UTC)).timestamp()
