"""Runs in processes of their own, started by the dashboard: start, resume, list and cancel them.

Each is a `hil run` or `hil resume` in a session of its own, which outlives the process that starts
it. `RUNS/.started/ID.json` says what was started, and `ID.log` is what it prints: a run that fails
before it has a run directory leaves no other trace.
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
    """Return what would be run: one experiment, or those of a series.

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
        operator: Name of the operator; recorded.
        overrides: Laid over the spec, YAML text by dotted path.
        speed: Share of the speed, see `hil.planning.commissioning.commissioning_of`.
        first: How much of the program is run, see there.
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


FOLDER = ".started"

CONFIRMED = ".confirmed"
"""Suffix of the JSON file with the confirmed facts, beside the record of a start."""


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
    # Waited for, so that none is left as a zombie.
    threading.Thread(target=process.wait, name="hil-started", daemon=True).start()
    started = Started(
        id=name, runs=str(runs), spec=str(what), station=str(station or ""), operator=operator,
        pid=process.pid, ticks=ticks, time=time.time(), host=platform.node(),
    )  # fmt: skip
    try:
        write_replacing(folder / f"{name}.json", json_document(asdict(started)))
    except RecordingError:
        process.terminate()  # without a record it could neither be listed nor cancelled
        raise
    _remove_old_records(runs)
    return started


KEPT = 20
"""Number of starts whose records and logs are kept."""


def _remove_old_records(runs: Path) -> None:
    for old in started_runs(runs)[KEPT:]:
        if not old.alive:
            for path in (old.log, *(old.log.with_suffix(end) for end in (".json", CONFIRMED))):
                path.unlink(missing_ok=True)


def check_resume(run: Path, runs: Path) -> RunDirectory:
    """Return a run that can be resumed, as far as its documents say.

    Args:
        run: Directory of a run that ended early.
        runs: The folder of runs that it is in.

    Raises:
        DataError: It is live, was completed, or cannot be resumed.
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
        operator: Name of the operator; recorded.
        confirmed: As in `start_run`; not needed if what was confirmed before still holds.

    Raises:
        DataError: It is live, was completed, or cannot be resumed; nothing was started.
        RecordingError: The folder of runs cannot be written to.
    """
    check_resume(run, runs)
    return _start(
        "resume", [], run.resolve(), runs, station=None, operator=operator, confirmed=confirmed
    )


@dataclass(frozen=True, slots=True)
class Started:
    """A run that was started, which need not have a run directory yet.

    Attributes:
        id: Unique in its folder of runs.
        runs: The folder of runs.
        spec, station: What was started; the station is empty for the default one. The directory of
            the run instead of a spec if a run is resumed.
        operator: Name of the operator.
        pid: Of its process.
        ticks: When that process began, in the kernel's clock ticks: another one may get its pid.
        time: When it was started [s, Unix time].
        host: Computer that it runs on.
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
        """File with what it prints."""
        return Path(self.runs) / FOLDER / f"{self.id}.log"

    @property
    def alive(self) -> bool:
        """Whether its process still runs."""
        return self.host == platform.node() and 0 < self.ticks == ticks_of(self.pid)

    @property
    def made(self) -> list[Path]:
        """Its run directories: none while it plans, several for a series."""
        if (again := self.again) is not None:
            return [again] if self._holds(again) or self._has_resumed(again) else []
        return known_runs(Path(self.runs)).started_as(self.id)

    @property
    def again(self) -> Path | None:
        """The run that it resumes; None if it starts a new one."""
        run, root = Path(self.spec), Path(self.runs).resolve()
        return run if run.is_dir() and run.resolve().is_relative_to(root) else None

    @property
    def last_words(self) -> list[str]:
        """The last lines that it printed."""
        return last_lines(self.log)

    def cancel(self, who: str = "") -> None:
        """End it: as `hil stop` does if it is a live run by now, else as Ctrl-C would.

        Does nothing if it has ended.

        Args:
            who: Recorded; by default the operator who started it.

        Raises:
            DataError: Its process is not one that was started here, whatever its record says.
        """
        for run in self.made if self.alive else ():
            if not read_live(run):
                continue  # it plans or connects, and takes no requests yet
            with contextlib.suppress(HilError):  # its motion is over
                stop_run(run, who=who or self.operator, wait_s=0)
                return
        if not self.alive:
            return
        if not is_ours(self.pid, self.id) and self.alive:  # it has not ended just now
            raise DataError(
                f"process {self.pid} is left alone: it is not what was started as {self.id}",
                hint=f"look at it: ps -fp {self.pid}",
            )
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGTERM)

    def _holds(self, run: Path) -> bool:
        """Return whether it holds a run, as from before the way back is planned on."""
        holder = run_holder(run)
        return holder is not None and holder.pid == self.pid and self.alive

    def _has_resumed(self, run: Path) -> bool:
        for resumed in run.glob("resume*.json"):
            with contextlib.suppress(DataError):
                if read_json(resumed).get("started_as") == self.id:
                    return True
        return False


def started_runs(runs: Path) -> list[Started]:
    """Return what was started, the newest first; damaged records are left out."""
    started: list[Started] = []
    for path in sorted((runs / FOLDER).glob("*.json"), reverse=True):
        with contextlib.suppress(DataError):
            record = read_json(path) | {"id": path.stem, "runs": str(runs)}
            if _is_record(record):
                started.append(Started(**record))
    return started


def _is_record(record: Mapping[str, Any]) -> bool:
    """Return whether a document is one that is written here: other users may write there, too."""
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
    """Start a command in a session of its own.

    Args:
        command: Program and arguments; no shell looks at them.
        log: File for what it prints; made, with its folder, and removed if nothing is started. Its
            stem names the process in its environment, see `is_ours`.

    Raises:
        RecordingError: The log cannot be written.
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
            hint="see whether the folder may be written to and the disk has room",
        ) from error


def last_lines(log: Path) -> list[str]:
    """Return the last lines of a log; of a long one only its end is read.

    A link, a pipe or a device of that name is no log: only `begin` makes one.
    """
    try:
        # Without waiting, in case it is a pipe.
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
    """Return when a process began, in the kernel's clock ticks; 0 for one that has ended."""
    try:
        about = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace")
    except OSError:
        return 0
    state, *fields = about[about.rindex(")") + 2 :].split()
    return 0 if state in "ZX" else int(fields[18])


def is_ours(pid: int, name: str) -> bool:
    """Return whether a process is a `python -P -m hil …` that `begin` has started under a name.

    A record is no proof, as other users may write in its folder. False for a process that may not
    be looked at.
    """
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        environment = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return False
    is_hil = words[1:4] == [b"-P", b"-m", b"hil"]
    return is_hil and os.fsencode(f"{STARTED_ID}={name}") in environment


SECRETS = ("HIL_TOKEN",)
"""Environment variables that a run and its plug-ins do not get."""


def own_environment() -> dict[str, str]:
    """Return the environment for a process that is started here: this one's, without secrets."""
    return {key: value for key, value in os.environ.items() if key not in SECRETS}
