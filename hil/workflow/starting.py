"""Starting runs that outlive whoever starts them: each is a `hil run` of its own.

What was started, and what became of it, is in `hil.workflow.started`.
"""

from __future__ import annotations

import os
import platform
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from hil.core import (
    DataError,
    RecordingError,
    SpecError,
    is_live,
    json_document,
    read_source,
    write_replacing,
)
from hil.planning import Commissioning, Experiment, commissioning_of
from hil.planning import load as load_experiment
from hil.recording import RunDirectory
from hil.recording import operator as this_user
from hil.spec import is_schedule, is_series
from hil.workflow.detached import begin, ticks_of
from hil.workflow.driver_check import check_driver
from hil.workflow.extras import require_extras
from hil.workflow.resuming import require_resumable
from hil.workflow.series import load_series
from hil.workflow.started import FOLDER, Started, started_runs

__all__ = ["Started", "check_resume", "check_start", "go_on_with", "start_run", "started_runs"]

CONFIRMED = ".confirmed"
"""Suffix of the JSON file with the confirmed facts, beside the record of a start."""

KEPT = 20
"""Of so many starts records and logs are kept."""


def check_start(
    spec: Path,
    station: Path | None,
    overrides: Mapping[str, str] | None = None,
    commissioning: Commissioning | None = None,
) -> tuple[Experiment, ...]:
    """What would be run: one experiment, or those of a series.

    Args:
        spec: An experiment or a series.
        station: Its file; by default the one `hil run` would use.
        overrides: Laid over the spec, YAML text by dotted path.
        commissioning: What of the plan would be executed, and how fast; None for all of it.

    Raises:
        SpecError: Spec or station have problems; all are listed. Or it is a schedule.
        PluginError: An extra that it needs is not installed.
    """
    source = read_source(spec)
    if is_schedule(source):
        raise SpecError(
            f"{spec} is a schedule, which runs by itself", hint=f"hil schedule run {spec}"
        )
    if is_series(source):
        if overrides:
            raise SpecError(f"{spec} is a series: --set is for experiments")
        experiments = load_series(source, station).experiments
    else:
        experiments = (load_experiment(source, station, overrides=overrides),)
    for experiment in experiments:
        check_driver(replace(experiment, commissioning=commissioning))
        if commissioning is None:
            require_extras(experiment.spec)
    return experiments


def start_run(
    spec: Path,
    runs: Path,
    *,
    station: Path | None = None,
    operator: str = "",
    overrides: Mapping[str, str] | None = None,
    speed: str = "",
    first: str = "",
    confirmed: Mapping[str, Any] | None = None,
) -> Started:
    """Start `hil run SPEC --elsewhere` in a session of its own.

    Args:
        spec: An experiment or a series.
        runs: The folder of runs.
        station: Its file; by default the one `hil run` would use.
        operator: Who asks; recorded as who is at the robot.
        overrides: Laid over the spec, YAML text by dotted path.
        speed: Share of the speed; see `hil.planning.commissioning.commissioning_of`.
        first: How much of the program; see there, too.
        confirmed: `MotionFacts.to_dict` of the motion that the operator confirmed; without it, or
            if the run's motion differs from it, a real robot does not move.

    Raises:
        SpecError, PluginError: See `check_start`; nothing was started.
        RecordingError: The folder of runs cannot be written to.
    """
    check_start(spec, station, overrides, commissioning_of(speed, first))
    options = [f"--station={station}"] if station else []
    options += [f"--set={path}={value}" for path, value in (overrides or {}).items()]
    options += [f"--speed={speed}"] if speed else []
    options += [f"--first={first}"] if first else []
    return _start(
        "run", options, spec, runs, station=station, operator=operator, confirmed=confirmed
    )


def check_resume(run: Path, runs: Path) -> RunDirectory:
    """Return a run that can be gone on with, as far as its documents say.

    Args:
        run: Directory of a run that ended early.
        runs: The folder of runs that it is in.

    Raises:
        DataError: It is live, was completed, or cannot be gone on with.
    """
    directory, run = require_resumable(run), run.resolve()
    if is_live(run) or any(one.alive and one.again == run for one in started_runs(runs)):
        raise DataError(f"{run} goes on already", hint=f"follow it: hil watch {run}")
    if directory.status == "completed":
        raise DataError(f"{run} was completed", hint=f"what came of it: hil show {run}")
    return directory


def go_on_with(
    run: Path, runs: Path, *, operator: str = "", confirmed: Mapping[str, Any] | None = None
) -> Started:
    """Start `hil resume RUN --elsewhere` in a session of its own: the arm moves.

    Args:
        run: Directory of a run that ended early.
        runs: The folder of runs that it is in.
        operator: Who asks; recorded as who is at the robot.
        confirmed: As in `start_run`; not needed if what was confirmed before still holds.

    Raises:
        DataError: It is live, was completed, or cannot be gone on with; nothing was started.
        RecordingError: The folder of runs cannot be written to.
    """
    check_resume(run, runs)
    return _start(
        "resume", [], run.resolve(), runs, station=None, operator=operator, confirmed=confirmed
    )


def _start(
    verb: str,
    options: list[str],
    what: Path,
    runs: Path,
    *,
    station: Path | None,
    operator: str,
    confirmed: Mapping[str, Any] | None,
) -> Started:
    folder = runs / FOLDER
    name = f"{time.time_ns():020d}-{os.getpid()}"
    if confirmed is not None:
        answer = {"how": "dashboard", "by": operator or this_user(), "facts": dict(confirmed)}
        folder.mkdir(parents=True, exist_ok=True)
        write_replacing(folder / f"{name}{CONFIRMED}", json_document(answer))
        options = [*options, f"--confirmed={folder / name}{CONFIRMED}"]
    command = [sys.executable, "-P", "-m", "hil", verb, f"--runs={runs}", "--elsewhere", *options]
    command += [f"--operator={operator}"] if operator else []
    command += ["--", str(what)]  # its name may begin as an option does
    if any("\0" in word for word in command):
        raise SpecError(
            "a run cannot be started with a NUL character in what it is given",
            hint="look at the changes and at the name of the operator",
        )
    process = begin(command, folder / f"{name}.log")
    ticks = ticks_of(process.pid)
    # Whoever started it hears of its end, so that none is left as a zombie.
    threading.Thread(target=process.wait, name="hil-started", daemon=True).start()
    started = Started(
        id=name, runs=str(runs), spec=str(what), station=str(station or ""), operator=operator,
        pid=process.pid, ticks=ticks, time=time.time(), host=platform.node(),
    )  # fmt: skip
    try:
        write_replacing(folder / f"{name}.json", json_document(asdict(started)))
    except RecordingError:
        process.terminate()  # nobody would hear of it again
        raise
    _forget_old(runs)
    return started


def _forget_old(runs: Path) -> None:
    for old in started_runs(runs)[KEPT:]:
        if not old.alive:
            for path in (old.log, *(old.log.with_suffix(end) for end in (".json", CONFIRMED))):
                path.unlink(missing_ok=True)
