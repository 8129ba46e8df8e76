"""Lists of runs: find run directories, read their documents and resolve the name of a run.

All functions of this module only read run directories. A damaged run is listed as `damaged`. If a
document is missing or invalid, its values are empty; the list of runs is still complete.

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
"""Name by which a user selects the newest run."""

ListedStatus = RunStatus | Literal["running", "damaged"]


@dataclass(frozen=True, slots=True)
class RunListing:
    """Path, identity and status of a run.

    Attributes:
        path: Path of the run directory.
        number: Run number; 0 if the run directory was renamed.
        date: Name of the day folder (ISO 8601 date on which the run was started).
        robot: Name of the robot folder.
        status: Final status of the run, `running` if a process holds the lock of the run, or
            `damaged`.
        uid: Identity from the start document; empty if the run is damaged or the document is
            missing.
        problem: Reason why the run is damaged; empty if the run is not damaged.
    """

    path: Path
    number: int
    date: str
    robot: str
    status: ListedStatus
    uid: str = ""
    problem: str = ""


def run_listings(runs_root: Path) -> list[RunListing]:
    """Return a listing for every run under `runs_root`, sorted by run number.

    Damaged run directories are included with the status `damaged`. For a folder that does not
    exist, the list of runs is empty.

    Raises:
        DataError: The path `runs_root` is a file.
    """
    listings = [listing_of(path) for path in run_paths(runs_root)]
    return sorted(listings, key=lambda run: (run.number, run.path))


def run_paths(runs_root: Path) -> list[Path]:
    """Return every run directory under `runs_root`, even if damaged, without reading files.

    Raises:
        DataError: The path `runs_root` is a file.
    """
    if runs_root.exists() and not runs_root.is_dir():
        raise DataError(
            f"{runs_root} is a file, not a folder of runs",
            hint="name the folder that contains the runs: --runs DIR",
        )
    return [path for path in run_folders(runs_root) if is_run(path)]


def listing_of(path: Path) -> RunListing:
    """Return path, identity and status of one run directory."""
    live, uid, problem = is_live(path), "", ""
    status: ListedStatus = "damaged"
    try:
        run = RunDirectory.open(path)
        status, uid = "running" if live else run.status, str(run.start.get("uid", ""))
    except DataError as error:
        # A live run has possibly not written its start document yet.
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
    """Return the run directory with a given name.

    Args:
        name: Path of a run directory, name of a run directory, run number (`42`), name of an
            experiment (selects the newest run of the experiment), or `last` (selects the newest run
            of all).
        runs_root: Path of the folder of runs.

    Raises:
        DataError: The name is the path of a recording, matches several runs, or matches no run
            under `runs_root`.
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
        raise DataError(f"{len(called)} runs are called {name}: {listed}", hint="use the path")
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
    """Return the error for a file that was passed instead of a run directory, with a hint."""
    if not file.name.endswith((".mcap", f".mcap{PARTIAL_SUFFIX}")):
        return DataError(f"{file} is a file, not a run directory", hint="list them with: hil runs")
    run = file.resolve().parent.parent
    if (run / "start.json").is_file():
        hint = f"show the run of the recording: hil show {run}"
    else:
        hint = f"fit a model to the recording: hil fit {file} --estimator NAME"
    return DataError(f"{file} is a recording, not a run directory", hint=hint)


def find_source(named: str, runs_root: Path) -> Path:
    """Return the path of a recording or a run whose path or name a user passed.

    Args:
        named: Path of a recording or a run, or a run name that `find_run` accepts.
        runs_root: Path of the folder of runs.

    Raises:
        DataError: The name matches no run or several runs; see `find_run`. This function does not
            check whether a path exists; the function that reads the file raises its own errors.
    """
    path = Path(named)
    # The name of a run never ends with .mcap.
    is_path = path.exists() or path.name != named or path.suffix == ".mcap"
    return path if is_path else find_run(named, runs_root)


def find_model(named: str, runs_root: Path) -> Path:
    """Return the model folder whose path a user passed, or whose run a user passed.

    Args:
        named: Path of a model folder, or a run with exactly one model (path of the run, or name
            that `find_run` accepts).
        runs_root: Path of the folder of runs.

    Raises:
        DataError: The name matches no model or several models.
    """
    try:
        path = find_source(named, runs_root)
    except DataError as error:
        message = f"there is no model folder {named}; {error.message}"
        raise DataError(message, hint=error.hint) from None
    return only_model(path)


def list_runs(runs: str | Path = "runs") -> list[dict[str, Any]]:
    """Return one entry per run directory, sorted by run number, including damaged runs.

    An entry has the keys `run`, `status`, `robot`, `date`, `uid`, `duration_s`, `verdict`,
    `studies`, `problem` and `next` (command that completes the run; empty if the run is complete).
    """
    return [
        entry_of(listing) | {"next": next_command(listing)} for listing in run_listings(Path(runs))
    ]


def next_command(listing: RunListing) -> str:
    """Return the command that completes a run; empty if the run is complete."""
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
    """Return a JSON document; None if the file is missing or damaged."""
    try:
        return read_json(path) if path.is_file() else None
    except (DataError, OSError):
        return None


_STUDY_FILES = "study/*/study.json"


def describe_run(run: str | Path) -> dict[str, Any]:
    """Return the contents of the JSON documents of a run directory.

    Raises:
        DataError: The path is not a run directory, or the run was written by a newer version of
            hil.
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
    """Return the summary of a study without its tables and curves, which only its file contains."""
    document = _document(file)
    keys = ("study", "title", "summary", "parameters", "seconds", "warnings")
    return document and {key: document.get(key) for key in keys}


def _number_in(document: Mapping[str, Any], key: str) -> float | None:
    """Return a number that fits into SQLite; None for NaN, infinity and values of other types."""
    value = document.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    return value if -(2**63) < value < 2**63 else None


def entry_of(listing: RunListing) -> dict[str, Any]:
    """Return an entry of `list_runs` without the key `next`."""
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
    """Return the recorded duration [s] of a run without stop document; None if it is unknown."""
    if listing.status not in ("interrupted", "running"):
        return None
    with contextlib.suppress(OSError):
        return recorded_s(RunDirectory(listing.path).recordings)
    return None


def _method_of(file: Path) -> str:
    """Return the name of the study or estimator whose document is in a folder `NAME-DIGEST`."""
    return file.parent.name.rpartition("-")[0]


def facts_of(path: Path) -> dict[str, Any]:
    """Return the entry of a run for `hil runs QUERY`: listed values and all searchable values.

    The entry has the keys of `hil.list_runs` except `next`, and additionally `number`, `name`,
    `description`, `started` (ISO 8601), `arm`, `serial`, `operator`, `reason`, `samples`, `gaps`,
    `loads_kg`, `occasion` and `fits`. Each item of the list `fits` is `{estimator, unit, rmse}`;
    `rmse` is the mean over the joints of `rmse_raw` on the hold-out set.

    Args:
        path: Path of the run directory, which is possibly damaged.

    Raises:
        FileNotFoundError: The run directory was deleted in the meantime.
    """
    listing = listing_of(path)
    entry = entry_of(listing) | {"number": listing.number}
    try:
        return entry | _from_documents(path)
    except FileNotFoundError:
        raise  # the run was deleted in the meantime, so it has no entry
    except Exception as error:  # one invalid run must not break the list
        problem = f"its documents cannot be read: {type(error).__name__}: {error}"
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
"""Maximum size of a spec [bytes] in which a description is searched for."""


def _description(spec: Path) -> str:
    from hil.core import look_into  # PyYAML is imported only when needed

    with contextlib.suppress(OSError, ValueError):
        if spec.stat().st_size <= LARGEST_SPEC:
            return _text(_mapping(look_into(spec.read_bytes())).get("description"))
    return ""


def _loads(value: Any) -> list[float]:
    """Return the masses of the payloads [kg] in the order of the spec."""
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
    """Return the start time of a run [s, Unix time].

    If the start document has no valid time, the date of the day folder is used. None is returned if
    neither the time in the start document nor the name of the day folder is valid.
    """
    for moment in (facts["started"], facts["date"]):
        with contextlib.suppress(ValueError, OverflowError, OSError):
            return datetime.fromisoformat(moment).timestamp()
    return None
