"""Runs one field of the wire's fault matrix and judges it by the mock controller's own journal."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from faults.field import HOST, REST_RAD_S
from faults.ur_cases import NONE, SPECS, Case
from ur_mock import mock_ur

import hil
from hil.campaign.robots import open_robot, plan_for
from hil.errors import DataError
from hil.record.reader import read_topic
from hil.record.rundir import RunDirectory

ENDS_WITHIN_S = 90.0
TRIES = 3
COUNTED = ("gaps", "missing", "duplicates")
CONTROLLER_STOPS = ("protective_stop", "emergency_stop", "watchdog", "power_cut")

Note = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Field:
    """What came of one case; times in seconds, None where there is nothing to tell.

    Attributes:
        outcome: Of the run directory.
        exit_code: Of the process.
        struck: Whether the fault has happened, to a run that was going on.
        ended_s: Wall time from the fault to the end of the process.
        stop_s: Wall time from the fault to the first stop that the arm got, by whoever counts.
        rest_s: Device time from the first stop until the arm was at rest.
        commands: Motions commanded at all.
        commands_after: Motions commanded after the first stop.
        lost_s: Device time from the last sample recorded to the fault.
        lacking: Where the run goes on: what is not measured.
        counts: Where the run goes on: what its recording counts, zeros left out.
    """

    outcome: str
    exit_code: int
    struck: bool
    ended_s: float | None = None
    stop_s: float | None = None
    rest_s: float | None = None
    commands: int = 0
    commands_after: int = 0
    lost_s: float | None = None
    lacking: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return asdict(self)


def run_field(case: Case, folder: Path) -> Field:
    """Run a case in a folder of `folder` of its own; again where the run ended before the fault.

    A computer that is too busy is late for the arm, and then it is stopped: that is another fault.
    """
    for attempt in range(TRIES):
        own = folder / str(attempt)
        own.mkdir()
        field = _run_once(case, own)
        if field.struck:
            break
    return field


def _run_once(case: Case, folder: Path) -> Field:
    (folder / "spec.yaml").write_text(SPECS[case.spec], "utf-8")
    (folder / "plan.json").write_text(_plan(case.spec), "utf-8")
    (folder / "faults.yaml").write_text(json.dumps([case.strikes]), "utf-8")
    about = {"at": "", "fault": "", "after_s": 0, "prompt_s": 0.1}
    (folder / "case.json").write_text(json.dumps(about), "utf-8")
    arguments = ("--faults", str(folder / "faults.yaml"), *case.ending.arguments)
    with mock_ur(*arguments, journal=folder / "journal.jsonl") as mock:
        (folder / "station.yaml").write_text(_station(mock.address, arguments), "utf-8")
        exit_code = _run(folder)
        ended = time.monotonic()
        mock.process.terminate()
        mock.process.wait(20)
        return _judged(case, folder, exit_code, ended, mock.journal())


def _run(folder: Path) -> int:
    environment = {**os.environ, "HIL_LEASES": str(folder / "leases")}
    with (folder / "stderr.txt").open("wb") as errors:
        done = subprocess.run(
            [sys.executable, str(HOST), "case.json"],
            cwd=folder,
            stdout=errors,
            stderr=errors,
            env=environment,
            timeout=ENDS_WITHIN_S,
            check=False,
        )
    return done.returncode


def _station(address: str, arguments: Sequence[str]) -> str:
    """The driver with its own options: nothing is made easier for it."""
    model = "ur5e" if "ur5e" in arguments else "ur5"
    robot = {"driver": "ur", "model": model, "options": {"address": address}}
    return json.dumps({"hil_station": 1, "robots": {"ur5": robot}})


@functools.cache
def _plan(spec: str) -> str:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "spec.yaml")
        path.write_text(SPECS[spec], "utf-8")
        experiment = hil.load(path)
        robot = open_robot("ur5", experiment.robot)
        robot.connect()
        return json.dumps(plan_for(experiment, robot).to_dict())


def _judged(
    case: Case, folder: Path, exit_code: int, ended: float, journal: Sequence[Note]
) -> Field:
    runs = list(folder.glob("runs/*/*/*"))
    run = RunDirectory.open(runs[0]) if runs else None
    fault = _fault(case, journal)
    about: dict[str, Any] = {
        "outcome": str(run.status) if run else NONE,
        "exit_code": exit_code,
        "struck": fault is not None,
        "commands": sum(note["event"] == "start" for note in journal),
    }
    if fault is None:
        return Field(**about)
    about["ended_s"] = ended - fault["monotonic_s"]
    if case.ending.before:
        return Field(**about)
    if case.ending.stop_within_s is None:
        return Field(**about, lacking=_lacking(run), counts=_counts(run))
    after = list(journal[journal.index(fault) :])
    return Field(**about, **_stopped(case, after), lost_s=_lost(run, fault))


def _fault(case: Case, journal: Sequence[Note]) -> Note | None:
    """When it struck; None where the arm was stopped before, and nothing was there to strike."""
    for note in journal:
        if note["event"] == "fault":
            return note
        if note["event"] in ("stop", *CONTROLLER_STOPS) and not case.ending.before:
            return None
    return None


def _stopped(case: Case, after: Sequence[Note]) -> dict[str, Any]:
    events = ("stop",) if case.ending.by == "driver" else CONTROLLER_STOPS
    stop = next((note for note in after if note["event"] in events), None)
    if stop is None:
        return {}
    later = after[after.index(stop) + 1 :]
    return {
        "stop_s": stop["monotonic_s"] - after[0]["monotonic_s"],
        "rest_s": _rest(stop, after),
        "commands_after": sum(note["event"] == "start" for note in later),
    }


def _rest(stop: Note, after: Sequence[Note]) -> float | None:
    """Device time from the first stop to rest; the controller may have been quicker."""
    if stop["speed_rad_s"] is not None and stop["speed_rad_s"] < REST_RAD_S:
        return 0.0
    rest = next((note for note in after if note["event"] == "rest"), None)
    return None if rest is None else max(0.0, rest["device_time"] - stop["device_time"])


def _lacking(run: RunDirectory | None) -> tuple[str, ...]:
    complete = ((run and run.stop) or {}).get("complete") or {"all": {"done": 0, "of": 1}}
    return tuple(kind for kind, n in complete.items() if n["done"] != n["of"])


def _counts(run: RunDirectory | None) -> dict[str, int]:
    stop = (run and run.stop) or {}
    return {name: int(stop[name]) for name in COUNTED if stop.get(name)}


def _lost(run: RunDirectory | None, fault: Note) -> float | None:
    try:
        paths = run.recordings if run else []
        last = max(float(read_topic(path, salvage=True)["device_time"].max()) for path in paths)
    except (DataError, ValueError):
        return None
    return max(0.0, fault["device_time"] - last)
