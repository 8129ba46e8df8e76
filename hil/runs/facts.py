"""What can be asked about a run, from its documents; one that is missing or odd says nothing."""

from __future__ import annotations

import contextlib
import math
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import DataError, read_json
from hil.runs.listing import listing_of
from hil.runs.summary import entry_of, number_in

LARGEST_SPEC = 262_144
"""Bytes; a longer spec is not searched for a description."""


def facts_of(path: Path) -> dict[str, Any]:
    """An entry of `hil runs QUERY`: what `hil runs` says of a run, and what can be asked.

    Keys beside those of `hil.list_runs`: `number`, `name`, `description`, `started` (ISO 8601),
    `arm`, `serial`, `operator`, `reason`, `samples`, `gaps`, `loads_kg`, `occasion`, and `fits`:
    `{estimator, unit, rmse}` each, the mean of the joints' `rmse_raw` on what was held out.

    Args:
        path: The run directory; it may be damaged.
    """
    listing = listing_of(path)
    told = entry_of(listing) | {"number": listing.number}
    try:
        return told | _told(path)
    except FileNotFoundError:
        raise
    except Exception as error:  # one run that says something odd keeps no other from the list
        problem = f"what it says cannot be read: {type(error).__name__}: {error}"
        return told | _NOTHING | {"status": "damaged", "problem": problem}


_NOTHING: dict[str, Any] = {
    **dict.fromkeys(
        ("name", "description", "started", "arm", "serial", "operator", "reason", "occasion"), ""
    ),
    **dict.fromkeys(("samples", "gaps")),
    "loads_kg": [],
    "fits": [],
}


def _told(path: Path) -> dict[str, Any]:
    start, stop = _document(path / "start.json"), _last_stop(path)
    robot = _mapping(start.get("robot"))
    return {
        "name": _text(start.get("experiment")),
        "description": _description(path / "spec.yaml"),
        "started": _text(start.get("started")),
        "arm": _text(robot.get("model")),
        "serial": _text(_mapping(robot.get("identity")).get("serial")),
        "operator": _text(start.get("operator")),
        "reason": _text(stop.get("reason")),
        "samples": number_in(stop, "samples"),
        "gaps": number_in(stop, "gaps"),
        "loads_kg": _loads(start.get("loads")),
        "occasion": _text(start.get("occasion")),
        "fits": [_fit(file) for file in sorted(path.glob("fit/*/evaluation.json"))],
    }


def started_s(facts: dict[str, Any]) -> float | None:
    """When a run was started [s, Unix]; of one that does not say the day of its folder."""
    for told in (facts["started"], facts["date"]):
        with contextlib.suppress(ValueError, OverflowError, OSError):
            return datetime.fromisoformat(told).timestamp()
    return None


def _last_stop(path: Path) -> dict[str, Any]:
    ends = sorted(path.glob("stop*.json"), key=lambda file: (len(file.name), file.name))
    return _document(ends[-1]) if ends else {}


def _fit(file: Path) -> dict[str, Any]:
    document = _document(file)
    held_out = _mapping(document.get("held_out"))
    errors = _mapping(held_out.get("total")).get("rmse_raw")
    rmse = None
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        values = np.asarray(errors, dtype=np.float64)
        mean = float(np.mean(values)) if values.size else math.nan
        rmse = mean if math.isfinite(mean) else None
    estimator = _text(document.get("estimator")) or file.parent.name.rpartition("-")[0]
    return {"estimator": estimator, "unit": _text(held_out.get("unit")), "rmse": rmse}


def _description(spec: Path) -> str:
    from hil.core import look_into  # a list of runs starts without PyYAML

    with contextlib.suppress(OSError, ValueError):
        if spec.stat().st_size <= LARGEST_SPEC:
            return _text(_mapping(look_into(spec.read_bytes())).get("description"))
    return ""


def _loads(told: Any) -> list[float]:
    """Masses in the order of the spec [kg]."""
    given = told if isinstance(told, list) else []
    masses = (number_in(_mapping(load), "mass_kg") for load in given)
    return [mass for mass in masses if mass is not None]


def _document(path: Path) -> dict[str, Any]:
    with contextlib.suppress(DataError):
        return read_json(path)
    return {}


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _text(value: Any) -> str:
    return value if isinstance(value, str) else ""
