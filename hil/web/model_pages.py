"""Registered models: their champions over time, and what probes say of the robot."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hil.errors import HilError, RegistryError
from hil.registry.log import Entry, read_log
from hil.registry.registry import Aliases, Registry
from hil.registry.version import ModelVersion
from hil.report.documents import as_float, as_names, as_object, as_objects
from hil.report.words import UNKNOWN, joint_title, number, when
from hil.web.drawing import GLYPHS, timeline
from hil.web.registered import model_address, run_link, versions_of
from hil.web.rendering import page, settings_of
from hil.web.settings import Settings


def models(request: Request) -> Response:
    """All names, and who is champion."""
    settings = settings_of(request)
    registry, problems = Registry(settings.registry), list[str]()
    rows = [_name_row(registry, name, problems) for name in registry.names()]
    return page(request, "models.html.j2", title="Models", models=rows, problems=problems)


def model(request: Request) -> Response:
    """One name: champions, drift, versions, and what was done to them."""
    from hil.web.drift_facts import drift_of  # SciPy and more: a dashboard starts without

    settings, name = settings_of(request), request.path_params["name"]
    registry, problems = Registry(settings.registry), list[str]()
    versions = readable_versions(registry, name, problems)
    log, broken = log_of(registry, name)
    aliases = Aliases.after(log)
    unit = unit_of(versions[-1].facts) if versions else "A"
    return page(
        request, "model.html.j2", title=name, problems=problems, broken=broken,
        champion=aliases.champion, challenger=aliases.challenger, before=aliases.before,
        timeline=timeline(log) if log else None,
        log=[deed(name, entry) for entry in reversed(log)],
        versions=[_version_row(one, aliases, settings) for one in reversed(versions)],
        evidence=_evidence(log),
        drift=drift_of(name, request.query_params.get("feature", ""), unit, settings),
        commands=_commands(name, aliases, settings),
    )  # fmt: skip


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


def _name_row(registry: Registry, name: str, problems: list[str]) -> dict[str, Any]:
    versions = versions_of(registry, name, problems)
    log, broken = log_of(registry, name)
    if broken:
        problems.append(broken)
    aliases = Aliases.after(log)
    by_number = {one.number: one for one in versions}
    champion = by_number.get(aliases.champion)
    since = next((e.at for e in reversed(log) if e.event in ("promoted", "rolled-back")), "")
    return {
        "name": name,
        "address": model_address(name),
        "count": len(versions),
        "champion": aliases.champion,
        "challenger": aliases.challenger,
        "since": when(since),
        "estimator": str(champion.facts.get("estimator", "")) if champion else "",
        "serial": str(champion.facts.get("serial", "")) if champion else "",
        "error": _error(champion.facts) if champion else "",
        "newest": when(versions[-1].registered) if versions else "",
        "broken": bool(broken),
    }


def _version_row(one: ModelVersion, aliases: Aliases, settings: Settings) -> dict[str, Any]:
    return {
        "label": one.label,
        "address": model_address(one.name, one.number),
        "role": role_of(one.number, aliases),
        "estimator": str(one.facts.get("estimator", "")),
        "registered": when(one.registered),
        "by": one.by,
        "error": _error(one.facts),
        "run": run_of(one, settings),
    }


def role_of(number_: int, aliases: Aliases) -> str:
    """`champion`, `challenger` or nothing."""
    if number_ == aliases.champion:
        return "champion"
    return "challenger" if number_ == aliases.challenger else ""


def run_of(one: ModelVersion, settings: Settings) -> dict[str, str]:
    """`text` and `address` of the run it was fitted to."""
    told = as_object(one.facts.get("run"))
    return run_link(str(told.get("folder") or ""), settings, str(told.get("uid") or ""))


def _error(facts: Mapping[str, Any]) -> str:
    """Mean RMSE (raw) on the first source it was judged on."""
    for part in as_objects(facts.get("evaluation")):
        error = as_float(as_object(part.get("total")).get("mean_raw"))
        if math.isfinite(error):
            return f"{number(error)} {part.get('unit', '')}".strip()
    return ""


def unit_of(facts: Mapping[str, Any]) -> str:
    """Of the efforts."""
    return "A" if facts.get("effort_kind") == "current" else "N·m"


def deed(name: str, entry: Entry) -> dict[str, Any]:
    """A line of the log, for people."""
    glyph, words = GLYPHS[entry.event]
    return {
        "at": when(entry.at),
        "version": f"v{entry.version}",
        "address": model_address(name, entry.version),
        "glyph": glyph,
        "words": words,
        "reason": entry.reason,
        "by": entry.by,
    }


def _evidence(log: Sequence[Entry]) -> dict[str, Any] | None:
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
            "samples": told.get("samples"),
            "blocks": told.get("blocks"),
            "days": str(as_object(entry.evidence.get("days")).get("words") or ""),
            "joints": joints,
        }
    return None


def _times(old: float, new: float) -> str:
    return number(new / old) if old > 0 else UNKNOWN


def _commands(name: str, aliases: Aliases, settings: Settings) -> list[tuple[str, str]]:
    """What is done in a terminal: there it says what it rests on, and asks nobody twice."""
    where = f"--registry {shlex.quote(str(settings.registry))}"
    found = []
    if aliases.challenger or not aliases.champion:
        which = "challenger" if aliases.challenger else "v1"
        promote = f"hil models promote {name} {which} --on RUN --reason TEXT {where}"
        found.append(("Promote, if it errs less on a run neither was fitted to:", promote))
    if aliases.before:
        back = f"hil models rollback {name} --reason TEXT {where}"
        found.append((f"Go back to v{aliases.before[-1]}, the champion before:", back))
    found.append(("Judge a new probe of the robot:", f"hil drift {name} RUN {where}"))
    found.append(
        ("Compare every file and the log with their digests:", f"hil models check {where}")
    )
    return found


routes = [
    Route("/models", models),
    Route("/models/{name}", model),
]
