"""What a run was, how it ended and what its models are worth: the part of its page that stays."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from hil.core import sha256_of, shell_word
from hil.dashboard.registered import registered_models
from hil.dashboard.run_details import completeness_of, details_of, virtual_clock
from hil.dashboard.run_files import listed_files, report_address, require_run
from hil.dashboard.settings import Settings
from hil.estimators import MODEL_FILE, models_below
from hil.report import (
    ENDINGS,
    Badge,
    Document,
    FitFacts,
    RunFacts,
    as_objects,
    badge_of,
    criterion_text,
    failed_fits,
    joint_title,
    measure,
    next_command,
    number,
    read_facts,
    sentence_of,
)
from hil.runs import ALWAYS_READ, stamp_of


def facts_of_run(run: Path, settings: Settings) -> dict[str, Any]:
    """What `run_facts.html.j2` shows, as `facts`; of a damaged run what can still be read.

    Args:
        run: The run directory.
        settings: What is served.

    Raises:
        DataError: It is no run directory, or was written by a newer hil.
    """
    require_run(str(run.resolve().relative_to(settings.runs.resolve())), settings)
    files = {"files": listed_files(run, settings), "report": report_address(run, settings)}
    if not (run / "start.json").is_file() and not (run / "plan.json").is_file():
        told = "There is neither start.json nor plan.json: nothing was begun here, or it was lost."
        return {"unreadable": told, "name": run.name, **files}
    try:
        return {**_facts(run, settings), **files}
    except Exception as error:  # its files are there all the same
        told = f"What it says cannot be shown: {type(error).__name__}: {error}"
        return {"unreadable": told, "name": run.name, **files}


def _facts(run: Path, settings: Settings) -> dict[str, Any]:
    facts = _read(run)
    badge = badge_of(facts) if facts.whole else Badge(*ENDINGS["damaged"])
    return {
        "unreadable": "",
        "name": facts.name,
        "badge": {"text": badge.text.lower(), "mark": badge.mark or "quiet"},
        "sentence": sentence_of(facts),
        "virtual": virtual_clock(facts.start),
        "hint": str(facts.stop.get("hint") or ""),
        "command": next_command(facts, shell_word(run)),
        "warnings": _warnings(facts),
        "details": [(label, text) for label, text in details_of(facts) if text],
        "complete": list(completeness_of(facts)),
        "fits": [_fit(fit) for fit in facts.listed_fits],
        "criteria": [_criterion(row) for row in as_objects(facts.verdict.get("rows"))],
        "models": list(_models(run, settings)),
        "studies": [
            {"name": one.study, "title": one.title, "summary": one.summary}
            for one in facts.studies.made
        ],
    }


def _read(run: Path) -> RunFacts:
    """Of one that was interrupted the recordings are counted, which takes a while: once."""
    stamp = stamp_of(run)
    return read_facts(run) if stamp == ALWAYS_READ else _settled(run, stamp)


@lru_cache(maxsize=16)
def _settled(run: Path, stamp: str) -> RunFacts:
    return read_facts(run)


def _warnings(facts: RunFacts) -> list[str]:
    told = facts.stop.get("problems")
    ending = [str(one) for one in told] if isinstance(told, list) else []
    return [*facts.problems, *ending, *failed_fits(facts), *facts.studies.warnings]


def _fit(fit: FitFacts) -> dict[str, Any]:
    columns = [fit.values(metric) for metric in ("rmse_raw", "rmse_filtered", "nrmse")]
    columns.append(fit.values("rmse_raw", "trained"))
    means = [fit.mean(metric) for metric in ("rmse_raw", "rmse_filtered", "nrmse")]
    means.append(fit.mean("rmse_raw", "trained"))
    joints = [
        {"name": joint_title(j, name), "values": [number(column[j]) for column in columns]}
        for j, name in enumerate(fit.joint_names)
    ]
    return {
        "label": fit.label,
        "unit": fit.unit,
        "note": "" if fit.is_honest else f"Not judged: {fit.protocol}.",
        "joints": [*joints, {"name": "mean", "values": [number(mean) for mean in means]}],
    }


def _criterion(row: Document) -> dict[str, Any]:
    return {
        "what": str(row.get("estimator") or "recording"),
        "limit": criterion_text(row),
        "of": str(row.get("what") or ""),
        "found": measure(row.get("value"), row.get("unit")),
        "passed": bool(row.get("passed")),
    }


def _models(run: Path, settings: Settings) -> Iterator[dict[str, Any]]:
    """Its model folders, and the versions that were registered of them."""
    folders = models_below(run)
    known = registered_models(settings) if folders else {}
    for folder in folders:
        versions = known.get(_digest(folder / MODEL_FILE), [])
        yield {"name": folder.relative_to(run).as_posix(), "versions": versions}


def _digest(file: Path) -> str:
    try:
        return sha256_of(file)
    except OSError:
        return ""
