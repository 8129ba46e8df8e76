"""A version of a model: what it is, what it is worth, and whether it is as it was registered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from hil.core import HilError, shell_word
from hil.dashboard.model_facts import deed, log_of, readable_versions, role_of, run_of, unit_of
from hil.dashboard.registered import model_address
from hil.dashboard.rendering import page, settings_of
from hil.export import TARGETS
from hil.models import Aliases, ModelVersion, Registry, read_version
from hil.report import (
    UNKNOWN,
    Document,
    as_float,
    as_names,
    as_object,
    as_objects,
    in_words,
    joint_title,
    number,
    when,
)


def version(request: Request) -> Response:
    """All that is known of one version."""
    settings, name = settings_of(request), request.path_params["name"]
    registry = Registry(settings.registry)
    readable_versions(registry, name, [])  # such a name there is
    found = read_version(registry.root / name, request.path_params["number"])
    log, broken = log_of(registry, name)
    aliases = Aliases.after(log)
    return page(
        request, "version.html.j2", title=f"{name} {found.label}", name=name,
        address=model_address(name), role=role_of(found.number, aliases),
        intact=_intact(found), broken=broken,
        facts=[(label, text) for label, text in _facts(found) if text and text != UNKNOWN],
        run=run_of(found, settings), evaluation=_evaluation(found.facts),
        files=sorted(found.files.items()),
        log=[deed(name, one) for one in reversed(log) if one.version == found.number],
        commands=_exports(found), evaluate=f"hil evaluate {shell_word(found.folder)} RUN",
    )  # fmt: skip


def _intact(one: ModelVersion) -> str:
    """What is wrong with its files; empty where they are as they were registered."""
    try:
        one.verify()
    except HilError as error:
        return " → ".join(filter(None, (error.message, error.hint)))
    return ""


def _facts(one: ModelVersion) -> list[tuple[str, str]]:
    facts, run = one.facts, as_object(one.facts.get("run"))
    git = as_object(facts.get("git"))
    changed = " with changes" if git.get("dirty") else ""
    keys = ("estimator", "protocol", "robot", "serial")
    return [
        *((key, str(facts.get(key) or "")) for key in keys),
        ("joints", in_words(facts.get("joint_names") or [])),
        ("effort", f"{facts.get('effort_kind', '')} [{unit_of(facts)}]"),
        ("registered", f"{when(one.registered)} by {one.by}"),
        ("measured", when(run.get("started"))),
        ("operator", str(run.get("operator") or "")),
        ("fitted to", in_words(facts.get("trained_on") or [])),
        ("hil", str(as_object(facts.get("packages")).get("hil") or "")),
        ("source revision", f"{git['sha']}{changed}" if git.get("sha") else ""),
        ("digest", one.digest),
        ("folder", str(one.folder)),
    ]


def _evaluation(facts: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Errors per joint on every source it was judged on."""
    names = as_names(facts.get("joint_names"))
    return [_part(part, names) for part in as_objects(facts.get("evaluation"))]


def _part(part: Document, names: Sequence[str]) -> dict[str, Any]:
    total = as_object(part.get("total"))
    columns = [total.get(metric) for metric in ("rmse_raw", "rmse_filtered", "nrmse")]
    known = [c if isinstance(c, list) and len(c) == len(names) else [None] * len(names)
             for c in columns]  # fmt: skip
    joints = [
        (joint_title(j, name), [number(as_float(column[j])) for column in known])
        for j, name in enumerate(names)
    ]
    means = [number(as_float(total.get(key))) for key in ("mean_raw", "mean_filtered")]
    what = str(part.get("source") or "")
    unit = str(part.get("unit") or "")
    return {"what": what, "unit": unit, "joints": [*joints, ("mean", [*means, UNKNOWN])]}


def _exports(one: ModelVersion) -> list[str]:
    folder = shell_word(one.folder)
    return [f"hil export {folder} --to {target} -o OUT" for target in TARGETS]


routes = [Route("/models/{name}/v{number:int}", version)]
