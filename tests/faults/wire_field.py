"""What fields of the matrices over a wire have in common: a run of its own process, what it left.

The mock's journal is the witness; what is asked of the run is its outcome, its message and what it
has recorded.
"""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import hil
from hil.core.errors import DataError
from hil.planning.plan import Plan
from hil.planning.robots import open_robot, plan_for
from hil.recording.mcap_reader import read_topic
from hil.recording.run_directory import RunDirectory
from tests.faults.field import HOST, REST_RAD_S, TRIES, is_doubtful

ENDS_WITHIN_S = 90.0
COUNTED = ("gaps", "missing", "duplicates")
LATEST = "device_time"

Note = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Field:
    """What came of one case; times in seconds, None where there is nothing to tell.

    Attributes:
        outcome: Of the run directory.
        exit_code: Of the process.
        struck: Whether the fault has happened, to a run that was going on.
        message: What the run says of its end.
        ended_s: Wall time from the fault to the end of the process.
        stop_s: Wall time from the fault to the first stop that the arm got, by whoever counts.
        rest_s: Device time from the first stop until the arm was at rest.
        still_on: Axes that nobody has switched off.
        commands: Motions commanded at all.
        commands_after: Motions commanded after the first stop.
        lost_s: Device time from the last sample recorded to the fault.
        lacking: Where the run goes on: what is not measured.
        counts: Where the run goes on: what its recording counts, zeros left out.
    """

    outcome: str
    exit_code: int
    struck: bool
    message: str = ""
    ended_s: float | None = None
    stop_s: float | None = None
    rest_s: float | None = None
    still_on: tuple[int, ...] = ()
    commands: int = 0
    commands_after: int = 0
    lost_s: float | None = None
    lacking: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return asdict(self)


def until_struck(
    run_once: Callable[[Path], Field], folder: Path, stop_within_s: float | None
) -> Field:
    """Run a case in a folder of `folder` of its own.

    It runs again if it ended before the fault, as the arm of a computer that is too busy does by
    another fault, or if the arm of a busy computer stopped late.
    """
    for attempt in range(TRIES):
        own = folder / str(attempt)
        own.mkdir()
        field = run_once(own)
        if field.struck and not is_doubtful(field.stop_s, stop_within_s):
            break
    return field


def run_host(folder: Path, spec: str, plan: Plan, **about: Any) -> int:
    """Run a spec whose plan is made, on the station in `folder`; the exit code.

    Args:
        folder: Has `station.yaml`.
        spec: Its text.
        plan: Of it.
        **about: What the process itself does wrong, and when (`host.Injector`).
    """
    case = {"at": "", "fault": "", "after_s": 0, "prompt_s": 0.1} | about
    (folder / "spec.yaml").write_text(spec, "utf-8")
    (folder / "plan.json").write_text(json.dumps(plan.to_dict()), "utf-8")
    (folder / "case.json").write_text(json.dumps(case), "utf-8")
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


@functools.cache
def plan_of(spec: str, robot: str, model: str, rate_hz: float | None = None) -> Plan:
    """The plan of a spec's text for `robot`, made on the embedded mock of the same model."""
    with tempfile.TemporaryDirectory() as folder:
        path, station = Path(folder, "spec.yaml"), Path(folder, "station.yaml")
        path.write_text(spec, "utf-8")
        options = {"rate_hz": rate_hz} if rate_hz else {}
        robots = {robot: {"driver": "mock", "model": model, "options": options}}
        station.write_text(json.dumps({"hil_station": 1, "robots": robots}), "utf-8")
        experiment = hil.load(path, station)
        stand_in = open_robot(robot, experiment.robot)
        stand_in.connect()
        return plan_for(experiment, stand_in)


def rest_after(stop: Note, after: Sequence[Note]) -> float | None:
    """Device time from the first stop to rest; the controller may have been quicker."""
    if stop["speed_rad_s"] is not None and stop["speed_rad_s"] < REST_RAD_S:
        return 0.0
    rest = next((note for note in after if note["event"] == "rest"), None)
    return None if rest is None else max(0.0, rest["device_time"] - stop["device_time"])


def starts(notes: Sequence[Note]) -> int:
    """Motions that begin."""
    return sum(note["event"] == "start" for note in notes)


def run_in(folder: Path) -> RunDirectory | None:
    """The run that was made in there."""
    runs = list(folder.glob("runs/*/*/*"))
    return RunDirectory.open(runs[0]) if runs else None


def message_of(run: RunDirectory | None, folder: Path) -> str:
    """What a run says of its end; what was told where it has not even begun."""
    if run is None:
        return (folder / "stderr.txt").read_text("utf-8")
    return str((run.stop or {}).get("reason", ""))


def lacking(run: RunDirectory | None) -> tuple[str, ...]:
    """Kinds of measurement that are not complete."""
    complete = ((run and run.stop) or {}).get("complete") or {"all": {"done": 0, "of": 1}}
    return tuple(kind for kind, n in complete.items() if n["done"] != n["of"])


def counts(run: RunDirectory | None) -> dict[str, int]:
    """What the recording counts, zeros left out."""
    stop = (run and run.stop) or {}
    return {name: int(stop[name]) for name in COUNTED if stop.get(name)}


def lost(run: RunDirectory | None, until: float, column: str = LATEST) -> float | None:
    """Time from the last sample to `until`, in a column of times; None if nothing can be read."""
    try:
        paths = run.recordings if run else []
        last = max(float(read_topic(path, salvage=True)[column].max()) for path in paths)
    except (DataError, ValueError):
        return None
    return max(0.0, until - last)
