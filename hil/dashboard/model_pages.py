"""Registered models: their champions over time, and what probes say of the robot."""

from __future__ import annotations

from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hil.core import shell_word
from hil.dashboard.drawing import timeline
from hil.dashboard.drift_facts import drift_of
from hil.dashboard.model_facts import (
    deed,
    error_of,
    evidence_of,
    log_of,
    readable_versions,
    role_of,
    run_of,
    unit_of,
)
from hil.dashboard.registered import model_address, versions_of
from hil.dashboard.rendering import page, settings_of
from hil.dashboard.settings import Settings
from hil.models import CHAMPION_EVENTS, Aliases, ModelVersion, Registry
from hil.report import when


def models(request: Request) -> Response:
    """All names, and who is champion."""
    settings = settings_of(request)
    registry, problems = Registry(settings.registry), list[str]()
    rows = [_name_row(registry, name, problems) for name in registry.names()]
    return page(request, "models.html.j2", title="Models", models=rows, problems=problems)


def model(request: Request) -> Response:
    """One name: champions, drift, versions, and what was done to them."""
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
        evidence=evidence_of(log),
        drift=drift_of(name, request.query_params.get("feature", ""), unit, settings),
        commands=_commands(name, aliases, bool(broken), settings),
    )  # fmt: skip


def _name_row(registry: Registry, name: str, problems: list[str]) -> dict[str, Any]:
    versions = versions_of(registry, name, problems)
    log, broken = log_of(registry, name)
    if broken:
        problems.append(broken)
    aliases = Aliases.after(log)
    by_number = {one.number: one for one in versions}
    champion = by_number.get(aliases.champion)
    since = next((e.at for e in reversed(log) if e.event in CHAMPION_EVENTS), "")
    return {
        "name": name,
        "address": model_address(name),
        "count": len(versions),
        "champion": aliases.champion,
        "challenger": aliases.challenger,
        "since": when(since),
        "estimator": str(champion.facts.get("estimator", "")) if champion else "",
        "serial": str(champion.facts.get("serial", "")) if champion else "",
        "error": error_of(champion.facts) if champion else "",
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
        "error": error_of(one.facts),
        "run": run_of(one, settings),
    }


def _commands(
    name: str, aliases: Aliases, broken: bool, settings: Settings
) -> list[tuple[str, str]]:
    """What is done in a terminal: there it says what it rests on, and asks nobody twice."""
    where = f"--registry {shell_word(settings.registry)}"
    if broken:
        repair = f"hil models repair {name} {where}"
        return [("Rebuild the log from its intact lines and the version folders:", repair)]
    found = []
    if not aliases.champion:
        which = "challenger" if aliases.challenger else "v1"
        promote = f"hil models promote {name} {which} --reason TEXT {where}"
        found.append(("Make it the first champion, which has nobody to be compared with:", promote))
    elif aliases.challenger:
        promote = f"hil models promote {name} challenger --on RUN --reason TEXT {where}"
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
