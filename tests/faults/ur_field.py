"""Runs one field of the wire's fault matrix and judges it by the mock controller's own journal."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from faults.field import HOST, REST_RAD_S, _lacking
from faults.ur_cases import NONE, SPECS, Case
from ur_mock import mock_ur

import hil
from hil.campaign.robots import open_robot, plan_for
from hil.errors import DataError
from hil.record.reader import read_topic
from hil.record.rundir import RunDirectory

ENDS_WITHIN_S = 90.0
COMMAND = ("-c", "from hil.cli import main; main()", "run", "spec.yaml", "--station",
           "station.yaml", "--runs", "runs")  # fmt: skip
"""`hil run`, for what is wrong before any run begins."""

CONTROLLER_STOPS = ("protective_stop", "emergency_stop", "watchdog", "power_cut")

Note = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Field:
    """What came of one case; times in seconds, None where there is nothing to tell.

    Attributes:
        outcome: Of the run directory.
        exit_code: Of the process.
        stop_s: Wall time from the fault to the first stop that the arm got, by whoever counts.
        rest_s: Device time from the first stop until the arm was at rest.
        commands: Motions commanded at all.
        commands_after: Motions commanded after the first stop.
        lost_s: Device time from the last sample recorded to the fault.
        lacking: Where the run goes on: what is not measured, missing, or there twice.
    """

    outcome: str
    exit_code: int
    stop_s: float | None
    rest_s: float | None
    commands: int
    commands_after: int
    lost_s: float | None
    lacking: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return asdict(self)


def run_field(case: Case, folder: Path) -> Field:
    """Run a case in `folder`, which is empty."""
    (folder / "spec.yaml").write_text(SPECS[case.spec], "utf-8")
    (folder / "plan.json").write_text(_plan(case.spec), "utf-8")
    (folder / "faults.yaml").write_text(json.dumps([case.strikes]), "utf-8")
    about = {"at": "", "fault": "", "after_s": 0, "prompt_s": 0.1}
    (folder / "case.json").write_text(json.dumps(about), "utf-8")
    arguments = ("--faults", str(folder / "faults.yaml"), *case.ending.arguments)
    with mock_ur(*arguments, journal=folder / "journal.jsonl") as mock:
        model = "ur5e" if "ur5e" in arguments else "ur5"
        (folder / "station.yaml").write_text(_station(mock.address, model, case), "utf-8")
        exit_code = _run(folder, COMMAND if case.ending.before else [str(HOST), "case.json"])
        mock.process.terminate()
        mock.process.wait(20)
        return _judged(case, folder, exit_code, mock.journal())


def _run(folder: Path, command: Sequence[str]) -> int:
    environment = {**os.environ, "HIL_LEASES": str(folder / "leases")}
    with (folder / "stderr.txt").open("wb") as errors:
        done = subprocess.run(
            [sys.executable, *command],
            cwd=folder,
            stdout=errors,
            stderr=errors,
            env=environment,
            timeout=ENDS_WITHIN_S,
            check=False,
        )
    return done.returncode


def _station(address: str, model: str, case: Case) -> str:
    options = {"address": address, **case.ending.options}
    robot = {"driver": "ur", "model": model, "options": options}
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


def _judged(case: Case, folder: Path, exit_code: int, journal: Sequence[Note]) -> Field:
    runs = list(folder.glob("runs/*/*/*"))
    run = runs[0] if runs else None
    outcome = str(RunDirectory.open(run).status) if run else NONE
    started = [note for note in journal if note["event"] == "start"]
    fault = next((note for note in journal if note["event"] == "fault"), None)
    if case.ending.before or case.ending.stop_within_s is None or fault is None:
        lacking = _lacking(run) if run and not case.ending.before else ()
        return Field(outcome, exit_code, None, None, len(started), 0, None, lacking)
    after = list(journal[journal.index(fault) :])
    events = ("stop",) if case.ending.by == "driver" else CONTROLLER_STOPS
    stop = next((note for note in after if note["event"] in events), None)
    if stop is None:
        return Field(outcome, exit_code, None, None, len(started), 0, None, ())
    later = after[after.index(stop) + 1 :]
    return Field(
        outcome,
        exit_code,
        stop["monotonic_s"] - fault["monotonic_s"],
        _rest(stop, after),
        len(started),
        sum(note["event"] == "start" for note in later),
        _lost(run, fault),
        (),
    )


def _rest(stop: Note, after: Sequence[Note]) -> float | None:
    """Device time from the first stop to rest; the controller may have been quicker."""
    if stop["speed_rad_s"] is not None and stop["speed_rad_s"] < REST_RAD_S:
        return 0.0
    rest = next((note for note in after if note["event"] == "rest"), None)
    return None if rest is None else max(0.0, rest["device_time"] - stop["device_time"])


def _lost(run: Path | None, fault: Note) -> float | None:
    try:
        paths = RunDirectory.open(run).recordings if run else []
        last = max(float(read_topic(path, salvage=True)["device_time"].max()) for path in paths)
    except (DataError, ValueError):
        return None
    return max(0.0, fault["device_time"] - last)
