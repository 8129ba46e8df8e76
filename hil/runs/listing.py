"""Lists of runs: which there are, what the documents of each say, and which one a name means.

Everything here is a view of the run directories. A damaged run is listed as `damaged`, and a
document that is missing or odd leaves its facts empty: neither breaks the list.

==================  ============================================================
`RunListing`        where a run is and how it ended: one line of `hil runs`
`entry_of`          the same as JSON, with duration, verdict and studies
`facts_of`          and all that `hil runs QUERY` compares (see `hil.runs.query`)
`describe_run`      all that the documents of one run say (`hil show --json`)
==================  ============================================================
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hil.core import DataError, HilError, closest, is_live, read_json, shell_word
from hil.estimators import models_below, only_model
from hil.evaluation import verdict_word
from hil.recording import (
    PARTIAL_SUFFIX,
    PRUNED,
    RunDirectory,
    RunStatus,
    is_run,
    name_for_path,
    name_of_attempt,
    number_of,
    recorded_s,
    run_folders,
)

LAST = "last"
"""Names the newest run."""

ListedStatus = RunStatus | Literal["running", "damaged"]


@dataclass(frozen=True, slots=True)
class RunListing:
    """Where a run is and how it ended.

    Attributes:
        path: The run directory.
        number: Its running number, 0 if it was renamed.
        date: Folder of the day it was started, ISO 8601.
        robot: Folder of the robot.
        status: How it ended, `running` while a process holds it, or `damaged`.
        uid: Identity from the start document, empty when damaged or not written yet.
        problem: Why it is damaged, else empty.
    """

    path: Path
    number: int
    date: str
    robot: str
    status: ListedStatus
    uid: str = ""
    problem: str = ""


def run_listings(runs_root: Path) -> list[RunListing]:
    """Return every run under `runs_root`, by number; damaged directories are listed as such.

    Raises:
        DataError: `runs_root` is a file. A folder that does not exist holds no runs.
    """
    listings = [listing_of(path) for path in run_paths(runs_root)]
    return sorted(listings, key=lambda run: (run.number, run.path))


def run_paths(runs_root: Path) -> list[Path]:
    """Return every run directory under `runs_root`, damaged ones too; nothing in them is read.

    Raises:
        DataError: `runs_root` is a file.
    """
    if runs_root.exists() and not runs_root.is_dir():
        raise DataError(
            f"{runs_root} is not a folder of runs but a file",
            hint="give the folder that holds them: --runs DIR",
        )
    return [path for path in run_folders(runs_root) if is_run(path)]


def listing_of(path: Path) -> RunListing:
    """Return the line of one run directory."""
    live, uid, problem = is_live(path), "", ""
    status: ListedStatus = "damaged"
    try:
        run = RunDirectory.open(path)
        status, uid = "running" if live else run.status, str(run.start.get("uid", ""))
    except DataError as error:
        # A live run may not have written its start document yet.
        status, problem = ("running", "") if live else ("damaged", error.message)
    except OSError as error:
        problem = str(error)
    return RunListing(
        path=path,
        number=number_of(path),
        date=path.parents[1].name,
        robot=path.parent.name,
        status=status,
        uid=uid,
        problem=problem,
    )


def find_run(name: str, runs_root: Path) -> Path:
    """Return the run directory of a name.

    Args:
        name: A path, a directory's name, a number (`42`), the name of an experiment for its newest
            run, or `last` for the newest run of all.
        runs_root: The folder of runs.

    Raises:
        DataError: It is a recording instead of a run, or no run under `runs_root` is called so.
    """
    path = Path(name)
    if path.is_dir():
        return path
    if path.is_file():
        raise _no_run(path)
    folders = run_folders(runs_root)
    number = int(name) if name.isdecimal() else 0
    called = [run for run in folders if run.name == name or (number and number_of(run) == number)]
    if len(called) == 1:
        return called[0]
    if called:
        listed = ", ".join(str(run) for run in called)
        raise DataError(f"{len(called)} runs are called {name}: {listed}", hint="give the path")
    candidates = [run for run in folders if number_of(run)]
    if name != LAST:
        own = name_for_path(name)
        candidates = [run for run in candidates if run.name.partition("-")[2] == own]
    if candidates:
        return max(candidates, key=number_of)
    guess = None if number else closest(name, [run.name for run in folders])
    hint = f"did you mean {guess!r}?" if guess else f"list them with: hil runs --runs {runs_root}"
    raise DataError(f"there is no run {name}, here or under {runs_root}", hint=hint)


def _no_run(file: Path) -> DataError:
    """Return the error for a file where a run directory is needed, with what to do instead."""
    if not file.name.endswith((".mcap", f".mcap{PARTIAL_SUFFIX}")):
        return DataError(f"{file} is a file, not a run directory", hint="list them with: hil runs")
    run = file.resolve().parent.parent
    if (run / "start.json").is_file():
        hint = f"its run: hil show {run}"
    else:
        hint = f"it is data, not a run; fit it: hil fit {file} --estimator NAME"
    return DataError(f"{file} is a recording, not a run directory", hint=hint)


def find_source(named: str, runs_root: Path) -> Path:
    """Return the recording or run that a person means: a path, else as of `find_run`.

    Raises:
        DataError: As `find_run`; not for a path, whose reader says what is wrong with it.
    """
    path = Path(named)
    is_path = path.exists() or path.name != named or path.suffix == ".mcap"  # no run's name ends so
    return path if is_path else find_run(named, runs_root)


def find_model(named: str, runs_root: Path) -> Path:
    """Return the folder of the model that a person means.

    Args:
        named: The folder, or a run with one model: by path, or as of `find_run`.
        runs_root: The folder of runs.

    Raises:
        DataError: There is none, or there are several.
    """
    try:
        path = find_source(named, runs_root)
    except DataError as error:
        message = f"there is no model folder {named}; {error.message}"
        raise DataError(message, hint=error.hint) from None
    return only_model(path)


def list_runs(runs: str | Path = "runs") -> list[dict[str, Any]]:
    """Return one entry per run directory, damaged and interrupted ones included, oldest first.

    Keys: `run`, `status`, `robot`, `date`, `uid`, `duration_s`, `verdict`, `studies`, `problem`,
    `next` (the command that completes the run; empty if nothing is left to do).
    """
    return [
        entry_of(listing) | {"next": next_command(listing)} for listing in run_listings(Path(runs))
    ]


def next_command(listing: RunListing) -> str:
    """Return the command that completes a run; empty if nothing is left to do."""
    run = RunDirectory(listing.path)
    if listing.status in ("running", "damaged") or run.is_reported:
        return ""
    start, path = _document(run.path / "start.json") or {}, shell_word(run.path)
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


def _document(path: Path) -> dict[str, Any] | None:
    """Return a JSON document; None if the file is missing or damaged, as no view fails for that."""
    try:
        return read_json(path) if path.is_file() else None
    except (DataError, OSError):
        return None


_STUDY_FILES = "study/*/study.json"


def describe_run(run: str | Path) -> dict[str, Any]:
    """Return everything that the JSON files of a run directory say.

    Raises:
        DataError: It is no run directory, or was written by a newer version.
    """
    directory = RunDirectory.open(Path(run))
    status = "running" if is_live(directory.path) else directory.status
    out: dict[str, Any] = {"run": str(directory.path), "status": status}
    out |= {"start": directory.start, "stop": directory.stop}
    out["resumed"] = [
        _document(directory.path / name_of_attempt("resume.json", attempt))
        for attempt in range(1, directory.attempts)
    ]
    out["verdict"] = _document(directory.path / "verdict.json")
    out["fits"] = {
        file.parent.name: _document(file)
        for file in sorted(directory.path.glob("fit/*/evaluation.json"))
    }
    out["models"] = [str(folder) for folder in models_below(directory.path)]
    out["studies"] = {
        file.parent.name: _study(file) for file in sorted(directory.path.glob(_STUDY_FILES))
    }
    page = directory.path / "report.html"
    return out | {"report": str(page) if page.is_file() else None}


def _study(file: Path) -> dict[str, Any] | None:
    """Return the summary of a study; its tables and curves are in the file."""
    document = _document(file)
    keys = ("study", "title", "summary", "parameters", "seconds", "warnings")
    return document and {key: document.get(key) for key in keys}


def _number_in(document: Mapping[str, Any], key: str) -> float | None:
    """Return a number that SQLite can hold; None if anything else stands there, NaN included."""
    value = document.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    return value if -(2**63) < value < 2**63 else None


def entry_of(listing: RunListing) -> dict[str, Any]:
    """Return an entry of `list_runs`, but for `next`."""
    stop: dict[str, Any] = {}
    with contextlib.suppress(DataError, OSError):
        stop = RunDirectory(listing.path).stop or {}
    return {
        "run": str(listing.path),
        "status": listing.status,
        "robot": listing.robot,
        "date": listing.date,
        "uid": listing.uid,
        "duration_s": _number_in(stop, "device_s") if "device_s" in stop else _recorded_s(listing),
        "verdict": verdict_word(listing.path),
        "studies": sorted({_method_of(file) for file in listing.path.glob(_STUDY_FILES)}),
        "problem": listing.problem,
    }


def _recorded_s(listing: RunListing) -> float | None:
    """Return the duration [s] that a run without stop document has recorded; None if unknown."""
    if listing.status not in ("interrupted", "running"):
        return None
    with contextlib.suppress(OSError):
        return recorded_s(RunDirectory(listing.path).recordings)
    return None


def _method_of(file: Path) -> str:
    """Return the study or estimator of a document in a folder `NAME-DIGEST`."""
    return file.parent.name.rpartition("-")[0]


def facts_of(path: Path) -> dict[str, Any]:
    """Return an entry of `hil runs QUERY`: what `hil runs` says of a run, and what is compared.

    Keys beside those of `hil.list_runs`: `number`, `name`, `description`, `started` (ISO 8601),
    `arm`, `serial`, `operator`, `reason`, `samples`, `gaps`, `loads_kg`, `occasion`, and `fits`:
    `{estimator, unit, rmse}` each, the mean of the joints' `rmse_raw` on what was held out.

    Args:
        path: The run directory; it may be damaged.
    """
    listing = listing_of(path)
    entry = entry_of(listing) | {"number": listing.number}
    try:
        return entry | _from_documents(path)
    except FileNotFoundError:
        raise  # deleted meanwhile: it is no entry at all
    except Exception as error:  # one odd run keeps no other from the list
        problem = f"what it says cannot be read: {type(error).__name__}: {error}"
        return entry | _NOTHING | {"status": "damaged", "problem": problem}


_NOTHING: dict[str, Any] = {
    **dict.fromkeys(
        ("name", "description", "started", "arm", "serial", "operator", "reason", "occasion"), ""
    ),
    **dict.fromkeys(("samples", "gaps")),
    "loads_kg": [],
    "fits": [],
}


def _from_documents(path: Path) -> dict[str, Any]:
    start, stop = _document(path / "start.json") or {}, _last_stop(path)
    robot = _mapping(start.get("robot"))
    return {
        "name": _text(start.get("experiment")),
        "description": _description(path / "spec.yaml"),
        "started": _text(start.get("started")),
        "arm": _text(robot.get("model")),
        "serial": _text(_mapping(robot.get("identity")).get("serial")),
        "operator": _text(start.get("operator")),
        "reason": _text(stop.get("reason")),
        "samples": _number_in(stop, "samples"),
        "gaps": _number_in(stop, "gaps"),
        "loads_kg": _loads(start.get("loads")),
        "occasion": _text(start.get("occasion")),
        "fits": [_fit(file) for file in sorted(path.glob("fit/*/evaluation.json"))],
    }


def _last_stop(path: Path) -> dict[str, Any]:
    ends = sorted(path.glob("stop*.json"), key=lambda file: (len(file.name), file.name))
    return _document(ends[-1]) or {} if ends else {}


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _text(value: Any) -> str:
    return value if isinstance(value, str) else ""


LARGEST_SPEC = 262_144
"""Bytes; a longer spec is not searched for a description."""


def _description(spec: Path) -> str:
    from hil.core import look_into  # a list of runs starts without PyYAML

    with contextlib.suppress(OSError, ValueError):
        if spec.stat().st_size <= LARGEST_SPEC:
            return _text(_mapping(look_into(spec.read_bytes())).get("description"))
    return ""


def _loads(value: Any) -> list[float]:
    """Return the masses of the loads in the order of the spec [kg]."""
    loads = value if isinstance(value, list) else []
    masses = (_number_in(_mapping(load), "mass_kg") for load in loads)
    return [mass for mass in masses if mass is not None]


def _fit(file: Path) -> dict[str, Any]:
    document = _document(file) or {}
    held_out = _mapping(document.get("held_out"))
    errors = _mapping(held_out.get("total")).get("rmse_raw")
    rmse = None
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        values = np.asarray(errors, dtype=np.float64)
        mean = float(np.mean(values)) if values.size else math.nan
        rmse = mean if math.isfinite(mean) else None
    estimator = _text(document.get("estimator")) or _method_of(file)
    return {"estimator": estimator, "unit": _text(held_out.get("unit")), "rmse": rmse}


def started_s(facts: dict[str, Any]) -> float | None:
    """Return when a run was started [s, Unix], else the day of its folder; None without either."""
    for moment in (facts["started"], facts["date"]):
        with contextlib.suppress(ValueError, OverflowError, OSError):
            return datetime.fromisoformat(moment).timestamp()
    return None
