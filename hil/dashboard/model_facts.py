"""What the pages of models and of their versions say alike: roles, errors, deeds, comparisons."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from hil.core import HilError, RegistryError
from hil.dashboard.drawing import GLYPHS
from hil.dashboard.registered import model_address, run_link, versions_of
from hil.dashboard.settings import Settings
from hil.models import Aliases, Entry, ModelVersion, Registry, read_log
from hil.report import (
    UNKNOWN,
    as_float,
    as_names,
    as_object,
    as_objects,
    count,
    joint_title,
    measure,
    number,
    when,
)


def readable_versions(registry: Registry, name: str, problems: list[str]) -> list[ModelVersion]:
    """Versions of a name; those that cannot be read are named in `problems`.

    Raises:
        RegistryError: There is no such name.
    """
    if name not in registry.names():
        registry.versions(name)  # says what is alike
        raise RegistryError(f"{registry.root} has no models of {name}", hint="look at /models")
    return versions_of(registry, name, problems)


def log_of(registry: Registry, name: str) -> tuple[tuple[Entry, ...], str]:
    """What was done, and what is wrong with the chain of it; nothing is told of a broken one."""
    try:
        return read_log(registry.root / name), ""
    except HilError as error:
        return (), " → ".join(filter(None, (error.message, error.hint)))


def role_of(number_: int, aliases: Aliases) -> str:
    """`champion`, `challenger` or nothing."""
    if number_ == aliases.champion:
        return "champion"
    return "challenger" if number_ == aliases.challenger else ""


def run_of(one: ModelVersion, settings: Settings) -> dict[str, str]:
    """`text` and `address` of the run it was fitted to."""
    told = as_object(one.facts.get("run"))
    return run_link(str(told.get("folder") or ""), settings, str(told.get("uid") or ""))


def error_of(facts: Mapping[str, Any]) -> str:
    """Mean RMSE (raw) on the first source it was judged on."""
    for part in as_objects(facts.get("evaluation")):
        error = as_float(as_object(part.get("total")).get("mean_raw"))
        if math.isfinite(error):
            return measure(error, part.get("unit"))
    return ""


def unit_of(facts: Mapping[str, Any]) -> str:
    """Of the efforts."""
    return "A" if facts.get("effort_kind") == "current" else "N·m"


def deed(name: str, entry: Entry) -> dict[str, Any]:
    """A line of the log, for people."""
    glyph, words = GLYPHS[entry.event]
    return {
        "at": when(entry.at),
        "version": entry.label,
        "address": model_address(name, entry.version),
        "glyph": glyph,
        "words": words,
        "reason": entry.reason,
        "by": entry.by,
    }


def evidence_of(log: Sequence[Entry]) -> dict[str, Any] | None:
    """The newest comparison of two versions, joint by joint; None where there never was one."""
    for entry in reversed(log):
        told = as_object(entry.evidence.get("comparison"))
        names = as_names(told.get("joint_names"))
        errors = [told.get("champion_rmse"), told.get("challenger_rmse")]
        if not names or any(not isinstance(e, list) or len(e) != len(names) for e in errors):
            continue
        old, new = ([as_float(value) for value in error or ()] for error in errors)
        joints = [
            (joint_title(j, name), number(old[j]), number(new[j]), _times(old[j], new[j]))
            for j, name in enumerate(names)
        ]
        return {
            "version": f"v{entry.version}",
            "came": "promoted" if entry.event == "promoted" else "not promoted",
            "at": when(entry.at),
            "words": str(told.get("words") or ""),
            "unit": str(told.get("unit") or ""),
            "samples": _counted(told.get("samples")),
            "blocks": told.get("blocks"),
            "days": str(as_object(entry.evidence.get("days")).get("words") or ""),
            "joints": joints,
        }
    return None


def _counted(told: Any) -> str:
    return count(told) if isinstance(told, int) else str(told or "")


def _times(old: float, new: float) -> str:
    return number(new / old) if old > 0 else UNKNOWN
