"""Runs as people list and look at them: views of the disk, nothing of their own."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hil.core import DataError, HilError, is_live, read_json, shell_word
from hil.estimators import models_below
from hil.evaluation import verdict_word
from hil.recording import PRUNED, RunDirectory, name_of_attempt, recorded_s
from hil.runs.listing import RunListing, run_listings

_STUDY_FILES = "study/*/study.json"


def list_runs(runs: str | Path = "runs") -> list[dict[str, Any]]:
    """One entry per run directory, damaged and interrupted ones included, oldest first.

    Keys: `run`, `status`, `robot`, `date`, `uid`, `duration_s`, `verdict`, `studies`, `problem`,
    `next` (the command that brings a run to its end; empty where nothing is left to do).
    """
    return [
        entry_of(listing) | {"next": next_command(listing)} for listing in run_listings(Path(runs))
    ]


def next_command(listing: RunListing) -> str:
    """Return the command that completes a run; empty if nothing is left to do."""
    run = RunDirectory(listing.path)
    if listing.status in ("running", "damaged") or run.is_reported:
        return ""
    start, path = _optional(run.path / "start.json") or {}, shell_word(run.path)
    has = [(run.path / name).exists() for name in ("spec.yaml", "plan.json", PRUNED)]
    if "replayed" in start:
        return ""
    if "commissioning" in start and (run.path / "report.html").is_file():
        from hil.report import next_commissioning, read_facts

        with contextlib.suppress(HilError):
            if listing.status != "completed":
                return next_commissioning(read_facts(run.path))
        return ""
    if not start.keys() & {"passive", "commissioning"} and has == [True, True, False]:
        return f"hil resume {path}"
    return "" if (run.path / "report.html").is_file() else f"hil report {path}"


def describe_run(run: str | Path) -> dict[str, Any]:
    """Everything the JSON files of a run directory say.

    Raises:
        DataError: It is no run directory, or was written by a newer version.
    """
    directory = RunDirectory.open(Path(run))
    status = "running" if is_live(directory.path) else directory.status
    out: dict[str, Any] = {"run": str(directory.path), "status": status}
    out |= {"start": directory.start, "stop": directory.stop}
    out["resumed"] = [
        _optional(directory.path / name_of_attempt("resume.json", attempt))
        for attempt in range(1, directory.attempts)
    ]
    out["verdict"] = _optional(directory.path / "verdict.json")
    out["fits"] = {
        file.parent.name: _optional(file)
        for file in sorted(directory.path.glob("fit/*/evaluation.json"))
    }
    out["models"] = [str(folder) for folder in models_below(directory.path)]
    out["studies"] = {
        file.parent.name: _study(file) for file in sorted(directory.path.glob(_STUDY_FILES))
    }
    page = directory.path / "report.html"
    return out | {"report": str(page) if page.is_file() else None}


def number_in(document: Mapping[str, Any], key: str) -> float | None:
    """A number to calculate and to compare with; None where anything else stands there."""
    value = document.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    return value if -(2**63) < value < 2**63 else None  # so NaN is none, too


def _study_name(file: Path) -> str:
    return file.parent.name.rpartition("-")[0]


def _study(file: Path) -> dict[str, Any] | None:
    """What a study comes to; its curves are in the file."""
    document = _optional(file)
    keys = ("study", "title", "summary", "parameters", "seconds", "warnings")
    return document and {key: document.get(key) for key in keys}


def entry_of(listing: RunListing) -> dict[str, Any]:
    """What `list_runs` says of one run."""
    stop = _stop(RunDirectory(listing.path))
    return {
        "run": str(listing.path),
        "status": listing.status,
        "robot": listing.robot,
        "date": listing.date,
        "uid": listing.uid,
        "duration_s": number_in(stop, "device_s") if "device_s" in stop else _recorded_s(listing),
        "verdict": verdict_word(listing.path),
        "studies": sorted({_study_name(file) for file in listing.path.glob(_STUDY_FILES)}),
        "problem": listing.problem,
    }


def _recorded_s(listing: RunListing) -> float | None:
    """What a run without stop document recorded so far; None where nobody can say."""
    if listing.status not in ("interrupted", "running"):
        return None
    with contextlib.suppress(OSError):
        return recorded_s(RunDirectory(listing.path).recordings)
    return None


def _stop(run: RunDirectory) -> dict[str, Any]:
    try:
        return run.stop or {}
    except DataError:
        return {}


def _optional(path: Path) -> dict[str, Any] | None:
    """A view never fails because one file is missing or damaged: that file just says nothing."""
    try:
        return read_json(path) if path.is_file() else None
    except DataError:
        return None
