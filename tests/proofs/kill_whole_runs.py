"""Kill whole runs at random moments with `kill -9`, do what is next, and look for losses.

    python -m tests.proofs.kill_whole_runs --kills 40 --seed 1

Each kill has a folder of its own and ends the whole process group of a command: an experiment on
the embedded mock (while its directory is made, while it records, fits or reports), a registration,
a promotion, or the step of a schedule. Half of the moments are operations on files, half are
times, drawn from what the same command does when it is left alone. Afterwards:

- `hil runs` lists the run with the command that goes on with it, or nothing was begun;
- that command ends at a report, and nothing is left to do;
- rows that were on the disk at the kill are in the final recordings, each dwell once in the data;
- `hil models check` finds the registry sound, and each version was registered and promoted once;
- the ledger of the schedule has each due time once.

Prints a line per kill and a summary; exit code 1 if anything was lost.
"""

from __future__ import annotations

import argparse
import atexit
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

OPERATIONS = ("open", "os.rename", "os.mkdir", "os.remove")
PLAN = "HIL_TEST_KILL"
"""Environment: JSON of what the child does, see `arm`."""

SPEC = """hil: 1
name: small
robot: ur5
excitation: {kind: dwell, waypoints: 12, seed: SEED}
warm_up: {duration_s: 2}
reference: {every: 4}
accept: {rmse: {max: 5, unit: A, per: joint}, gaps_percent: {max: 50}}
fit: [{estimator: static-wls}]
"""
DWELLS = 24
REGISTER = ("models", "register", "MODEL", "--name", "ur5", "--challenger")
PROMOTE = ("models", "promote", "ur5", "--on", "ON", "--unless-worse")


@dataclass(frozen=True)
class Phase:
    """A part of a command, between two operations on files.

    Attributes:
        name: Of the phase.
        begin, end: Patterns of the paths of the first operations that begin and end it.
        command: Arguments of `hil`.
    """

    name: str
    begin: str
    end: str
    command: tuple[str, ...]


RUN = ("run", "small.yaml")
PHASES = {
    phase.name: phase
    for phase in (
        Phase("beginning", r"\.claim-\d+$", r"/00\.mcap\.partial$", RUN),
        Phase("recording", r"/00\.mcap\.partial$", r"/stop\.json$", RUN),
        Phase("fit", r"/stop\.json$", r"/verdict\.json$", RUN),
        Phase("report", r"/verdict\.json$", r"/report\.html$", RUN),
        Phase("registration", r"/registry/", "", REGISTER),
        Phase("promotion", r"/registry/", "", PROMOTE),
        Phase("schedule", r"/ledger\.jsonl$", "", ("schedule", "run", "weekly.yaml", "--once")),
    )
}
TURNS = (
    "recording", "fit", "report", "registration", "promotion", "recording", "schedule", "recording",
    "fit", "report", "beginning", "recording", "registration", "promotion", "schedule",
)  # fmt: skip
"""Phases in the order of the kills."""


class Loss(Exception):
    """Something is not as it must be after a kill."""


# ---- the child: `hil` with a fuse ----------------------------------------------------------------


def arm(plan: dict[str, Any]) -> None:
    """Kill the process group at a moment, or note all operations on files when the process ends.

    Args:
        plan: `folder`, below which operations count; `begin`, the pattern of the path that lights
            the fuse, with `operation` or `seconds` from there; or `note`, the file for the notes.
    """
    here, begin = os.path.realpath(plan["folder"]), re.compile(plan.get("begin", ""))
    notes: list[tuple[float, str]] = []
    lit, left = [False], [int(plan.get("operation", 0))]

    def die() -> None:
        os.killpg(os.getpgrp(), signal.SIGKILL)

    def hook(event: str, given: tuple[Any, ...]) -> None:
        if event not in OPERATIONS or not given:
            return
        named = given[1] if event == "os.rename" else given[0]
        if not isinstance(named, str | bytes | os.PathLike):
            return
        path = os.path.abspath(os.fsdecode(named))
        if not path.startswith(here):
            return
        if "note" in plan:
            notes.append((time.monotonic(), path))
            return
        if not lit[0] and begin.search(path):
            lit[0] = True
            if "seconds" in plan:
                fuse = threading.Timer(plan["seconds"], die)
                fuse.daemon = True
                fuse.start()
        if lit[0] and "operation" in plan:
            left[0] -= 1
            if left[0] < 0:
                die()

    if "note" in plan:
        atexit.register(lambda: Path(plan["note"]).write_text(json.dumps(notes)))
    sys.addaudithook(hook)


def child() -> None:
    """Be `hil` with a fuse."""
    arm(json.loads(os.environ.pop(PLAN)))
    from hil.cli import main

    sys.argv[0] = "hil"
    main()


# ---- the parent ----------------------------------------------------------------------------------


def hil(
    *arguments: object, cwd: Path, plan: dict[str, Any] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process group of its own, with a fuse if there is a plan."""
    program = [sys.executable, __file__] if plan is not None else [sys.executable, "-m", "hil"]
    return subprocess.run(
        [*program, *map(str, arguments)],
        cwd=cwd,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        start_new_session=True,
        env=os.environ | {"NO_COLOR": "1"} | ({} if plan is None else {PLAN: json.dumps(plan)}),
    )


def require(condition: object, what: str) -> None:
    """Raise `Loss` with these words unless the condition holds."""
    if not condition:
        raise Loss(what)


def done(what: subprocess.CompletedProcess[str]) -> subprocess.CompletedProcess[str]:
    """Return a process that came to its end with exit code 0."""
    words = " ".join(map(str, what.args[2:]))
    require(what.returncode == 0, f"hil {words}: exit {what.returncode}: {what.stderr[-400:]}")
    return what


@dataclass(frozen=True)
class Prepared:
    """What is made once: folders to begin with, and what each phase takes when left alone."""

    home: Path
    models: tuple[Path, Path]
    on: Path
    took: dict[str, tuple[int, float]]

    def folder(self, phase: Phase, to: Path) -> None:
        """Make the folder in which a command of the phase is run."""
        to.mkdir()
        if phase.command[0] == "models":
            shutil.copytree(self.home / f"for-{phase.name}", to / "registry")
        elif phase.command[0] == "schedule":
            _write_schedule(to)
        else:
            (to / "small.yaml").write_text(SPEC.replace("SEED", "3"))

    def words(self, phase: Phase) -> list[str]:
        """Return the arguments of the command."""
        given = {"MODEL": str(self.models[1]), "ON": str(self.on)}
        return [given.get(word, word) for word in phase.command]


def prepared(home: Path) -> Prepared:
    """Record three runs, register their models, and run each command once without a kill."""
    runs = []
    for number, seed in enumerate((3, 4, 5), start=1):
        (home / "small.yaml").write_text(SPEC.replace("SEED", str(seed)))
        done(hil("run", "small.yaml", cwd=home))
        runs += list(home.glob(f"runs/*/*/{number:04d}-small"))
    models = [next(run.glob("fit/*")) for run in runs]
    done(hil("models", "register", models[0], "--name", "ur5", "--challenger", cwd=home))
    done(hil("models", "promote", "ur5", cwd=home))
    shutil.copytree(home / "registry", home / "for-registration")
    done(hil("models", "register", models[1], "--name", "ur5", "--challenger", cwd=home))
    shutil.copytree(home / "registry", home / "for-promotion")
    found = Prepared(home, (models[0], models[1]), runs[2], {})
    noted: dict[tuple[str, ...], list[tuple[float, str]]] = {}
    for phase in PHASES.values():
        if phase.command not in noted:
            at = home / f"calm-{phase.name}"
            found.folder(phase, at)
            note = home / "notes.json"
            done(hil(*found.words(phase), cwd=at, plan={"folder": str(at), "note": str(note)}))
            noted[phase.command] = json.loads(note.read_text())
        found.took[phase.name] = _extent(phase, noted[phase.command])
    return found


def _extent(phase: Phase, notes: list[tuple[float, str]]) -> tuple[int, float]:
    """Return the operations and the seconds of a phase."""
    paths = [path for _, path in notes]
    first = next(i for i, path in enumerate(paths) if re.search(phase.begin, path))
    ends = (i for i, path in enumerate(paths) if i > first and re.search(phase.end, path))
    last = next(ends) if phase.end else len(paths) - 1
    return last - first, notes[last][0] - notes[first][0]


def _write_schedule(folder: Path) -> None:
    from tests.support.pipeline_parts import SCHEDULE, write_schedule

    while datetime.now(UTC).second > 45:  # due in the minute in which the schedule begins
        time.sleep(1)
    start = f"{datetime.now(UTC):%Y-%m-%dT%H:%M}"
    probe = SCHEDULE["probe"] | {"every": "60min"}
    write_schedule(folder, schedule=SCHEDULE | {"start": start, "probe": probe})


# ---- what must hold afterwards -------------------------------------------------------------------


def listed(folder: Path) -> list[dict[str, Any]]:
    """Return what `hil runs` lists."""
    out: list[dict[str, Any]] = json.loads(done(hil("runs", "--json", cwd=folder)).stdout)
    return out


def rows_on_disk(run: Path) -> dict[int, bytes]:
    """Return the rows of each attempt that can be read from the disk at this moment."""
    from hil.core.errors import DataError
    from hil.recording.mcap_reader import read_topic
    from hil.recording.recording_files import attempt_of
    from hil.recording.run_directory import RunDirectory

    rows: dict[int, bytes] = {}
    for path in RunDirectory(run).recordings:
        try:
            found = read_topic(path, salvage=True).tobytes()
        except DataError:  # killed before its first samples
            found = b""
        rows[attempt_of(path)] = rows.get(attempt_of(path), b"") + found
    return rows


def gone_on_with(folder: Path) -> str:
    """Do what `hil runs` names next for the one run there is; return what was found and done."""
    entries = listed(folder)
    if not entries:
        require(not list(folder.glob("runs/*/*/[!.]*")), "a run that is not listed")
        return "nothing begun"
    (entry,) = entries
    run, command = folder / entry["run"], entry["next"]
    before = rows_on_disk(run)
    if command:
        words = command.split()
        require(words[:2] == ["hil", "resume"], f"{entry['status']}: the next command is {command}")
        done(hil(*words[1:], cwd=folder))
    require_whole(folder, run, before)
    was = f"{entry['status']}, {sum(map(len, before.values())) // 1000} kB recorded"
    return f"{was} → {command.split()[1]}d to a report" if command else f"{was}, at its report"


def require_whole(folder: Path, run: Path, before: dict[int, bytes]) -> None:
    """Require a run at its end, with all that was on the disk before."""
    from hil.importers.sources import load_source
    from hil.recording.run_directory import RESERVE

    (entry,) = listed(folder)
    told = f"{entry['status']}, verdict {entry['verdict']}, next {entry['next']!r}"
    require((entry["status"], entry["next"]) == ("completed", ""), told)
    require((run / "report.html").is_file(), "there is no report")
    require(not (run / RESERVE).exists(), "the reserve is still there")
    after = rows_on_disk(run)
    for attempt, rows in before.items():
        require(after[attempt].startswith(rows), f"rows of attempt {attempt} are lost")
    if "small" in run.name:
        require(entry["verdict"] == "passed", told)
        dwells = Counter(
            (one.pose, one.approach) for one in load_source(run, ("dwell",)).conditions
        )
        require(len(dwells) == DWELLS and set(dwells.values()) == {1}, f"dwells: {dwells}")


def after_run(folder: Path, again: list[str]) -> str:
    """Look after a run that was killed."""
    told = gone_on_with(folder)
    if told == "nothing begun":
        done(hil(*again, cwd=folder))
        (entry,) = listed(folder)
        require_whole(folder, folder / entry["run"], {})
        require(entry["run"].endswith("/0001-small"), f"it is called {entry['run']}")
        told += " → run again"
        require(not list(folder.glob("runs/.claim-*")), "a claim of a number is still there")
    require(not list(folder.glob("runs/*/*/.draft-*")), "a draft of a run is still there")
    return told


def after_registry(folder: Path, again: list[str]) -> str:
    """Look after a registration or a promotion that was killed."""
    from hil.models.log import read_log
    from hil.models.model_registry import Registry

    done(hil("models", "check", cwd=folder))
    registry = Registry(folder / "registry")
    promotes = again[1] == "promote"
    told = f"{len(read_log(registry.root / 'ur5'))} entries"
    if not (promotes and registry.aliases("ur5").champion == 2):
        done(hil(*again, cwd=folder))
        told += " → done again"
    done(hil("models", "check", cwd=folder))
    log = Counter((entry.event, entry.version) for entry in read_log(registry.root / "ur5"))
    wanted = [("registered", 1), ("challenger", 1), ("promoted", 1), ("registered", 2)]
    wanted += [("challenger", 2)] + [("promoted", 2)] * promotes
    require(log == Counter(wanted), f"the log has {dict(log)}")
    require(registry.aliases("ur5").champion == (2 if promotes else 1), "another champion")
    for version in registry.versions("ur5"):
        version.verify()
    return f"{told}, sound"


def after_schedule(folder: Path, again: list[str]) -> str:
    """Look after a step of a schedule that was killed; every other time its run is gone on with."""
    from hil.maintenance.ledger import Ledger
    from hil.models.log import read_log

    told = "left to the schedule"
    if int(folder.name) % 2:
        told = gone_on_with(folder)
    done(hil(*again, cwd=folder))
    lines = Ledger.read(folder / "schedules" / "weekly").lines
    ended = [line["occasion"] for line in lines if line["event"] not in ("started", "begun")]
    require(len(ended) == 1, f"ended in the ledger: {ended}")
    starts = [json.loads(path.read_bytes()) for path in folder.glob("runs/*/*/*/start.json")]
    occasions = Counter(start["occasion"] for start in starts)
    require(set(occasions.values()) == {1}, f"runs of occasions: {occasions}")
    (entry,) = listed(folder)
    require_whole(folder, folder / entry["run"], {})
    done(hil("models", "check", cwd=folder))
    log = Counter((entry.event, entry.version) for entry in read_log(folder / "registry" / "ur5"))
    wanted = [("registered", 1), ("challenger", 1), ("promoted", 1)]
    require(log == Counter(wanted), f"the log has {dict(log)}")
    return f"{told} → the due time once"


AFTER: dict[str, Callable[[Path, list[str]], str]] = {
    "run": after_run,
    "models": after_registry,
    "schedule": after_schedule,
}


def kill(what: Prepared, phase: Phase, folder: Path, dice: random.Random) -> tuple[str, str]:
    """Kill a command in a phase; return the moment and what was found and done afterwards."""
    operations, seconds = what.took[phase.name]
    plan: dict[str, Any] = {"folder": str(folder), "begin": phase.begin}
    while True:
        # A registration writes for milliseconds: times would nearly always miss that.
        if phase.command[0] == "models" or dice.random() < 0.5:
            moment: dict[str, float] = {"operation": dice.randint(0, operations)}
            told = f"operation {moment['operation']} of {operations}"
        else:
            moment = {"seconds": dice.uniform(0.0, seconds)}
            told = f"{moment['seconds']:.2f} of {seconds:.2f} s"
        what.folder(phase, folder)
        ended = hil(*what.words(phase), cwd=folder, plan=plan | moment)
        if ended.returncode == -signal.SIGKILL:
            return told, AFTER[phase.command[0]](folder, what.words(phase))
        done(ended)  # quicker than when it was left alone: another moment
        shutil.rmtree(folder)


def main() -> int:
    """Kill as often as asked, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    dice, began, losses = random.Random(asked.seed), time.monotonic(), 0
    killed: Counter[str] = Counter()
    home = Path(tempfile.mkdtemp(prefix="hil-kills-"))
    what = prepared(home)
    print(f"{'':>3}  {'phase':<13}{'killed at':<24}{'found → done'}", flush=True)
    for number in range(1, asked.kills + 1):
        phase = PHASES[TURNS[(number - 1) % len(TURNS)]]
        folder = home / str(number)
        try:
            moment, told = kill(what, phase, folder, dice)
        except Exception as loss:  # one loss must not hide the others
            losses += 1
            print(f"{number:>3}  {phase.name:<13}LOST in {folder}: {loss!r}", flush=True)
            continue
        killed[phase.name] += 1
        print(f"{number:>3}  {phase.name:<13}{moment:<24}{told}", flush=True)
        shutil.rmtree(folder)
    spread = ", ".join(f"{count} {name}" for name, count in killed.items())
    print(f"{asked.kills} kills ({spread}): {losses} losses [{time.monotonic() - began:.0f} s]")
    if not losses:
        shutil.rmtree(home)
    return 1 if losses else 0


if __name__ == "__main__":
    if PLAN in os.environ:
        child()
    else:
        sys.exit(main())
