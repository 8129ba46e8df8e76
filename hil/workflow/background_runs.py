"""Background runs of the dashboard: start, resume, list and cancel runs in separate processes.

Each background run is a `hil run` or `hil resume` in a separate session, which outlives the process
that starts it. The file `RUNS/.started/ID.json` records the start of a background run, and `ID.log`
contains the output of its process: a run that fails before it has a run directory leaves no other
trace.
"""

from __future__ import annotations

import contextlib
import os
import platform
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from hil.core import (
    DataError,
    HilError,
    RecordingError,
    SpecError,
    is_live,
    json_document,
    read_json,
    read_source,
    run_holder,
    write_replacing,
)
from hil.planning import Commissioning, Experiment, commissioning_of
from hil.planning import load as load_experiment
from hil.recording import STARTED_ID, RunDirectory
from hil.recording import operator as this_user
from hil.runs import known_runs
from hil.spec import is_schedule, is_series
from hil.workflow.checks import check_driver, require_extras
from hil.workflow.live_state import read_live
from hil.workflow.remote_control import stop_run
from hil.workflow.resuming import require_resumable
from hil.workflow.series import load_series


def check_start(
    spec: Path,
    station: Path | None,
    overrides: Mapping[str, str] | None = None,
    commissioning: Commissioning | None = None,
) -> tuple[Experiment, ...]:
    """Return the experiments that a file would run: one experiment, or those of a series.

    Args:
        spec: Spec file of an experiment or file of a series.
        station: Station file; by default the station that `hil run` would use.
        overrides: Overrides of the spec: YAML text by dotted path.
        commissioning: Part of the plan to execute and its speed; None for the whole plan.

    Raises:
        SpecError: The spec or the station has problems, which are all listed, or the file is a
            schedule.
        PluginError: A required extra is not installed.
    """
    source = read_source(spec)
    if is_schedule(source):
        raise SpecError(
            f"{spec} is a schedule, not an experiment or a series", hint=f"hil schedule run {spec}"
        )
    if is_series(source):
        if overrides:
            raise SpecError(f"{spec} is a series, but --set is only for single experiments")
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
    """Start `hil run SPEC --no-console` in a separate session.

    Args:
        spec: Spec file of an experiment or file of a series.
        runs: Folder in which the run directories are created.
        station: Station file; by default the station that `hil run` would use.
        operator: Name of the operator, recorded in the run.
        overrides: Overrides of the spec: YAML text by dotted path.
        speed: Ratio of executed speed to planned speed, see
            `hil.planning.commissioning.commissioning_of`.
        first: Part of the program to execute, see `hil.planning.commissioning.commissioning_of`.
        confirmed: Facts of the motion that the operator confirmed (`MotionFacts.to_dict`). A real
            robot does not move if no facts were confirmed, or if the motion of the run differs from
            the confirmed facts.

    Raises:
        SpecError, PluginError: The spec is not valid (see `check_start`); no process was started.
        RecordingError: The folder of the run directories cannot be written to.
    """
    check_start(spec, station, overrides, commissioning_of(speed, first))
    options = [f"--station={station}"] if station else []
    options += [f"--set={path}={value}" for path, value in (overrides or {}).items()]
    options += [f"--speed-scale={speed}"] if speed else []
    options += [f"--limit={first}"] if first else []
    return _start(
        "run", options, spec, runs, station=station, operator=operator, confirmed=confirmed
    )


FOLDER = ".started"

CONFIRMED = ".confirmed"
"""Suffix of the JSON file with the confirmed facts, which lies beside the record of a background
run."""


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
    command = [sys.executable, "-P", "-m", "hil", verb, f"--runs={runs}", "--no-console", *options]
    command += [f"--operator={operator}"] if operator else []
    command += ["--", str(what)]  # its name may begin as an option does
    if any("\0" in word for word in command):
        raise SpecError(
            "an argument of the run contains a NUL character",
            hint="check the overrides and the name of the operator",
        )
    process = begin(command, folder / f"{name}.log")
    ticks = ticks_of(process.pid)
    # The thread reaps the ended process, so that no zombie process remains.
    threading.Thread(target=process.wait, name="hil-started", daemon=True).start()
    started = Started(
        id=name, runs=str(runs), spec=str(what), station=str(station or ""), operator=operator,
        pid=process.pid, ticks=ticks, time=time.time(), host=platform.node(),
    )  # fmt: skip
    try:
        write_replacing(folder / f"{name}.json", json_document(asdict(started)))
    except RecordingError:
        process.terminate()  # without a record, the run could not be listed or cancelled
        raise
    _remove_old_records(runs)
    return started


KEPT = 20
"""Number of background runs whose start records and logs are retained."""


def _remove_old_records(runs: Path) -> None:
    for old in started_runs(runs)[KEPT:]:
        if not old.alive:
            for path in (old.log, *(old.log.with_suffix(end) for end in (".json", CONFIRMED))):
                path.unlink(missing_ok=True)


def check_resume(run: Path, runs: Path) -> RunDirectory:
    """Return a run if its documents allow it to be resumed.

    Args:
        run: Directory of a run that ended early.
        runs: Folder that contains the run directory.

    Raises:
        DataError: The run is live, is complete, or cannot be resumed.
    """
    directory, run = require_resumable(run), run.resolve()
    if is_live(run) or any(one.alive and one.again == run for one in started_runs(runs)):
        raise DataError(f"{run} is running already", hint=f"follow the run: hil watch {run}")
    if directory.status == "completed":
        raise DataError(f"{run} was completed", hint=f"show the result: hil show {run}")
    return directory


def go_on_with(
    run: Path, runs: Path, *, operator: str = "", confirmed: Mapping[str, Any] | None = None
) -> Started:
    """Start `hil resume RUN --no-console` in a separate session; the arm moves.

    Args:
        run: Directory of a run that ended early.
        runs: Folder that contains the run directory.
        operator: Name of the operator, recorded in the run.
        confirmed: Facts of the motion that the operator confirmed, as in `start_run`; not needed if
            the earlier confirmation of the run is still valid.

    Raises:
        DataError: The run is live, is complete, or cannot be resumed; no process was started.
        RecordingError: The folder of the run directories cannot be written to.
    """
    check_resume(run, runs)
    return _start(
        "resume", [], run.resolve(), runs, station=None, operator=operator, confirmed=confirmed
    )


@dataclass(frozen=True, slots=True)
class Started:
    """Record of a started background run, which possibly has no run directory yet.

    Attributes:
        id: Identifier of the background run, unique in the folder of the run directories.
        runs: Folder in which the run directories are created.
        spec, station: Paths of spec and station; `station` is empty for the default station. If a
            run is resumed, `spec` is the run directory.
        operator: Name of the operator, recorded in the run.
        pid: Process id.
        ticks: Start time of the process in clock ticks of the kernel, because a process id may be
            reused.
        time: Time at which the run was started [s, Unix time].
        host: Name of the computer on which the process runs.
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
        """File with the printed output of the process of the background run."""
        return Path(self.runs) / FOLDER / f"{self.id}.log"

    @property
    def alive(self) -> bool:
        """Whether the process of the background run is still running."""
        return self.host == platform.node() and 0 < self.ticks == ticks_of(self.pid)

    @property
    def made(self) -> list[Path]:
        """Run directories of the process: none while the process plans, several for a series."""
        if (again := self.again) is not None:
            return [again] if self._holds(again) or self._has_resumed(again) else []
        return known_runs(Path(self.runs)).started_as(self.id)

    @property
    def again(self) -> Path | None:
        """Directory of the run that is resumed; None if the process starts a new run."""
        run, root = Path(self.spec), Path(self.runs).resolve()
        return run if run.is_dir() and run.resolve().is_relative_to(root) else None

    @property
    def last_words(self) -> list[str]:
        """Last lines of the output that the process printed."""
        return last_lines(self.log)

    def cancel(self, who: str = "") -> None:
        """End the run: in the same way as `hil stop` if the run is live, otherwise as Ctrl-C.

        If the run has already ended, `cancel` has no effect.

        Args:
            who: Name of the user who ends the run, for the record; by default the operator who
                started the run.

        Raises:
            DataError: The process with the recorded id was not started by `begin`.
        """
        for run in self.made if self.alive else ():
            if not read_live(run):
                continue  # the run is planning or connecting: no requests yet
            with contextlib.suppress(HilError):  # the motion of the run is over
                stop_run(run, who=who or self.operator, wait_s=0)
                return
        if not self.alive:
            return
        if not is_ours(self.pid, self.id) and self.alive:  # still running
            raise DataError(
                f"process {self.pid} was not stopped, because it was not started as {self.id}",
                hint=f"inspect the process: ps -fp {self.pid}",
            )
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGTERM)

    def _holds(self, run: Path) -> bool:
        """Return whether the process holds the lock of a run; the lock is held from planning on."""
        holder = run_holder(run)
        return holder is not None and holder.pid == self.pid and self.alive

    def _has_resumed(self, run: Path) -> bool:
        for resumed in run.glob("resume*.json"):
            with contextlib.suppress(DataError):
                if read_json(resumed).get("started_as") == self.id:
                    return True
        return False


def started_runs(runs: Path) -> list[Started]:
    """Return the records of all background runs, newest first; damaged records are left out."""
    started: list[Started] = []
    for path in sorted((runs / FOLDER).glob("*.json"), reverse=True):
        with contextlib.suppress(DataError):
            record = read_json(path) | {"id": path.stem, "runs": str(runs)}
            if _is_record(record):
                started.append(Started(**record))
    return started


def _is_record(record: Mapping[str, Any]) -> bool:
    """Return whether a document has the format of a `Started` record.

    The format is checked because other users may write to the folder of the records.
    """
    if record.keys() != {field.name for field in fields(Started)}:
        return False
    texts = [record[key] for key in ("spec", "station", "operator", "host")]
    counts, time_s = [record[key] for key in ("pid", "ticks")], record["time"]
    return (
        all(isinstance(text, str) and "\0" not in text for text in texts)
        and all(isinstance(count, int) and 0 <= count < 2**63 for count in counts)
        and isinstance(time_s, int | float)
        and 0 <= time_s < 2**53
    )


LAST_LINES = 10
LAST_BYTES = 16 * 1024


def begin(command: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
    """Start a command in a separate session.

    Args:
        command: Program and its arguments; no shell interprets this command.
        log: File for the printed output; `begin` creates the file and its folder, and removes the
            file if the command cannot be started. The stem of the log file's name identifies the
            process in its environment variables, see `is_ours`.

    Raises:
        RecordingError: The log file cannot be written.
    """
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("xb") as printed:
            return subprocess.Popen(  # noqa: S603 - our own command line, no shell
                command,
                stdin=subprocess.DEVNULL,
                stdout=printed,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env=own_environment() | {STARTED_ID: log.stem},
            )
    except OSError as error:
        with contextlib.suppress(OSError):
            log.unlink()
        raise RecordingError(
            f"cannot write to {log.parent}: {error.strerror or error}",
            hint="check the permissions of the folder and the free disk space",
        ) from error


def last_lines(log: Path) -> list[str]:
    """Return the last lines of a log file; only the end of a long log file is read.

    A link, a pipe or a device with the name of a log file is not read, because `begin` creates only
    regular files.
    """
    try:
        # Non-blocking, in case the file is a pipe.
        opened = os.open(log, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        with open(opened, "rb") as printed:
            about = os.fstat(opened)
            if not stat.S_ISREG(about.st_mode):
                return []
            printed.seek(max(0, about.st_size - LAST_BYTES))
            text = printed.read(LAST_BYTES).decode("utf-8", "replace")
    except OSError:
        return []
    return text.replace("\r", "\n").splitlines()[-LAST_LINES:]


def ticks_of(pid: int) -> int:
    """Return the start time of a process in kernel clock ticks; 0 if it has ended."""
    try:
        about = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace")
    except OSError:
        return 0
    state, *fields = about[about.rindex(")") + 2 :].split()
    return 0 if state in "ZX" else int(fields[18])


def is_ours(pid: int, name: str) -> bool:
    """Return whether `begin` started a process as `python -P -m hil …` under this name.

    A start record alone does not prove that `begin` started the process, because other users may
    write to the folder of the records. The return value is False for a process that this user is
    not allowed to inspect.
    """
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        environment = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return False
    is_hil = words[1:4] == [b"-P", b"-m", b"hil"]
    return is_hil and os.fsencode(f"{STARTED_ID}={name}") in environment


SECRETS = ("HIL_TOKEN",)
"""Names of the environment variables that are not passed to a background run and its plug-ins."""


def own_environment() -> dict[str, str]:
    """Return the environment variables of this process without secrets, for a process to start."""
    return {key: value for key, value in os.environ.items() if key not in SECRETS}
