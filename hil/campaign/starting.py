"""Starting runs that outlive whoever starts them: each is a `hil run` of its own.

What was started is kept in `RUNS/.started/`: `ID.json` says what, `ID.log` is what it prints. A run
that dies before it has a run directory is heard of nowhere else.
"""

from __future__ import annotations

import contextlib
import os
import platform
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from hil.campaign.detached import begin, last_lines, ticks_of
from hil.campaign.driver_check import check_driver
from hil.campaign.experiment import Experiment, load_experiment
from hil.campaign.extras import require_extras
from hil.campaign.resuming import require_resumable
from hil.campaign.steering import stop_run
from hil.errors import DataError, HilError, RecordingError, SpecError
from hil.plan.commissioning import commissioning_of
from hil.record.files import json_document, read_json, write_replacing
from hil.record.lock import is_live
from hil.record.numbering import run_folders
from hil.record.parts import name_of_attempt
from hil.record.rundir import RunDirectory
from hil.spec.schedule import is_schedule
from hil.spec.series import is_series

FOLDER = ".started"
KEPT = 20
"""Of so many starts records and logs are kept."""

SLACK_S = 2.0
"""File systems and clocks may differ so much about when something was [s]."""


@dataclass(frozen=True, slots=True)
class Started:
    """A run that was started, which need not have a run directory yet.

    Attributes:
        id: Names it below its folder of runs.
        runs: The folder of runs.
        spec, station: What was started; the station is empty for the usual one. Instead of a spec
            the directory of a run that is gone on with.
        operator: Who asked for it.
        pid: Its process.
        ticks: When that began, in the kernel's own count: other processes may get its pid.
        time: When it was started [s, Unix time].
        host: On which computer.
    """

    id: str
    runs: str
    spec: str
    station: str
    operator: str
    pid: int
    ticks: int
    time: float
    host: str

    @property
    def log(self) -> Path:
        """What it prints."""
        return Path(self.runs) / FOLDER / f"{self.id}.log"

    @property
    def alive(self) -> bool:
        """Whether its process still runs."""
        return self.host == platform.node() and 0 < self.ticks == ticks_of(self.pid)

    @property
    def made(self) -> list[Path]:
        """Its run directories: none while it plans, several for a series."""
        if (again := self.again) is not None:
            resumed = again / name_of_attempt("resume.json", RunDirectory(again).attempts - 1)
            return [again] if self._has_written(resumed) else []
        return [run for run in run_folders(Path(self.runs)) if self._is_mine(run)]

    @property
    def again(self) -> Path | None:
        """The run that it goes on with; None where it makes one."""
        run, root = Path(self.spec), Path(self.runs).resolve()
        return run if run.is_dir() and run.resolve().is_relative_to(root) else None

    @property
    def last_words(self) -> list[str]:
        """The last lines it printed."""
        return last_lines(self.log)

    def cancel(self, who: str = "") -> None:
        """End it: as `hil stop` where it is live by now, else as Ctrl-C would.

        Does nothing when it has ended.

        Args:
            who: Who asks; recorded. By default whoever started it.
        """
        for run in self.made if self.alive else ():
            with contextlib.suppress(HilError):  # it does not listen yet, or its motion is over
                stop_run(run, who=who or self.operator, wait_s=0)
                return
        if self.alive:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGTERM)

    def _is_mine(self, run: Path) -> bool:
        return self._has_written(run / "start.json")

    def _has_written(self, document: Path) -> bool:
        try:
            if document.stat().st_mtime < self.time - SLACK_S:
                return False
            said = read_json(document)
        except (OSError, DataError):
            return False
        return said.get("pid") == self.pid and said.get("host") == self.host


def check_start(
    spec: Path, station: Path | None, overrides: Mapping[str, str] | None = None
) -> tuple[Experiment, ...]:
    """What would be run: one experiment, or those of a series.

    Raises:
        SpecError: Spec or station have problems; all are listed. Or it is a schedule.
        PluginError: An extra that it needs is not installed.
    """
    if is_schedule(spec):
        raise SpecError(
            f"{spec} is a schedule, which runs by itself", hint=f"hil schedule run {spec}"
        )
    if is_series(spec):
        from hil.campaign.series import load_series

        if overrides:
            raise SpecError(f"{spec} is a series: --set is for experiments")
        experiments = load_series(spec, station).experiments
    else:
        experiments = (load_experiment(spec, station, overrides or {}),)
    for experiment in experiments:
        check_driver(experiment)
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
) -> Started:
    """Start `hil run SPEC --elsewhere` in a session of its own.

    Args:
        spec: An experiment or a series.
        runs: The folder of runs.
        station: Its file; by default the one `hil run` would use.
        operator: Who asks; recorded as who is at the robot.
        overrides: Laid over the spec, YAML text by dotted path.
        speed: Share of the speed; see `hil.plan.commissioning.commissioning_of`.
        first: How much of the program; see there, too.

    Raises:
        SpecError, PluginError: See `check_start`; nothing was started.
        RecordingError: The folder of runs cannot be written to.
    """
    check_start(spec, station, overrides)
    commissioning_of(speed, first)
    options = [f"--station={station}"] if station else []
    options += [f"--set={path}={value}" for path, value in (overrides or {}).items()]
    options += [f"--speed={speed}"] if speed else []
    options += [f"--first={first}"] if first else []
    return _start("run", options, spec, runs, station=station, operator=operator)


def go_on_with(run: Path, runs: Path, *, operator: str = "") -> Started:
    """Start `hil resume RUN --elsewhere` in a session of its own: the arm moves.

    Args:
        run: Directory of a run that ended early.
        runs: The folder of runs that it is in.
        operator: Who asks; recorded as who is at the robot.

    Raises:
        DataError: It is live, was completed, or cannot be gone on with; nothing was started.
        RecordingError: The folder of runs cannot be written to.
    """
    directory = require_resumable(run)
    run = run.resolve()
    if is_live(run) or any(one.alive and one.again == run for one in started_runs(runs)):
        raise DataError(f"{run} goes on already", hint=f"follow it: hil watch {run}")
    if directory.status == "completed":
        raise DataError(f"{run} was completed", hint=f"what came of it: hil show {run}")
    return _start("resume", [], run, runs, station=None, operator=operator)


def _start(
    verb: str, options: list[str], what: Path, runs: Path, *, station: Path | None, operator: str
) -> Started:
    folder = runs / FOLDER
    name = f"{time.time_ns():020d}-{os.getpid()}"
    command = [sys.executable, "-m", "hil", verb, f"--runs={runs}", "--elsewhere", *options]
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
        started.cancel()  # nobody would hear of it again
        raise
    _forget_old(runs)
    return started


def started_runs(runs: Path) -> list[Started]:
    """What was started, the newest first; damaged records are left out."""
    return list(_records(runs))


def _records(runs: Path) -> Iterator[Started]:
    for path in sorted((runs / FOLDER).glob("*.json"), reverse=True):
        with contextlib.suppress(DataError):
            said = read_json(path) | {"id": path.stem, "runs": str(runs)}
            if _is_record(said):
                yield Started(**said)


def _is_record(said: Mapping[str, Any]) -> bool:
    """Whether a document is what was written here: others may have been at it."""
    if said.keys() != {field.name for field in fields(Started)}:
        return False
    texts = [said[key] for key in ("spec", "station", "operator", "host")]
    counts, time_s = [said[key] for key in ("pid", "ticks")], said["time"]
    return (
        all(isinstance(text, str) and "\0" not in text for text in texts)
        and all(isinstance(count, int) and 0 <= count < 2**63 for count in counts)
        and isinstance(time_s, int | float)
        and 0 <= time_s < 2**53
    )


def _forget_old(runs: Path) -> None:
    for old in started_runs(runs)[KEPT:]:
        if not old.alive:
            for path in (old.log, old.log.with_suffix(".json")):
                path.unlink(missing_ok=True)
