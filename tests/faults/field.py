"""Runs one field of the fault matrix and judges it by the mock robot's own journal."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import hil
from hil.core.errors import DataError
from hil.planning.plan import Plan
from hil.planning.robots import open_robot, plan_for
from hil.recording.mcap_reader import read_topic
from hil.recording.run_directory import RunDirectory
from tests.faults.cases import SPECS, SPEED, STEPS, Case

HOST = Path(__file__).with_name("host.py")
PROMPT_S = 0.4
REST_RAD_S = 0.01
COMMANDS = ("prepare", "start")
CLOSED_WITHIN_S = 10.0


@dataclass(frozen=True, slots=True)
class Field:
    """What came of one case; times in seconds, None where nothing had to stop.

    Attributes:
        outcome: Of the run directory.
        exit_code: Of the process.
        stop_s: Wall time from the fault to the first stop the robot got.
        rest_s: Device time from there until the arm was at rest.
        commands_after: Motions commanded after the first stop.
        lost_s: Device time from the last sample recorded to the stop.
        lacking: Where the run goes on: what is not measured, missing, or there twice.
    """

    outcome: str
    exit_code: int
    stop_s: float | None
    rest_s: float | None
    commands_after: int
    lost_s: float | None
    lacking: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return asdict(self)


TRIES = 3


def run_field(case: Case, folder: Path) -> Field:
    """Run a case in folders of `folder`; again if the arm stopped late on a busy computer."""
    for attempt in range(TRIES):
        own = folder / str(attempt)
        own.mkdir()
        field = _run_once(case, own)
        if not is_doubtful(field.stop_s, case.ending.stop_within_s):
            break
    return field


def is_doubtful(stop_s: float | None, within_s: float | None) -> bool:
    """Whether the arm stopped late while the computer had more to do than cores.

    A process may then wait for a core for longer than a stop may take. A late stop on a computer
    that is not busy is a defect at once.
    """
    late = stop_s is not None and within_s is not None and stop_s > within_s
    return late and os.getloadavg()[0] > (os.cpu_count() or 1)


def _run_once(case: Case, folder: Path) -> Field:
    """Run a case in `folder`, which is empty."""
    spec, after_s = STEPS[case.step]
    (folder / "spec.yaml").write_text(SPECS[spec], "utf-8")
    (folder / "plan.json").write_text(json.dumps(_plan(spec).to_dict()), "utf-8")
    (folder / "station.yaml").write_text(_station(case, spec, after_s), "utf-8")
    about = {"at": case.step, "fault": case.fault, "after_s": after_s, "prompt_s": PROMPT_S}
    (folder / "case.json").write_text(json.dumps(about), "utf-8")
    environment = {**os.environ, "HIL_LEASES": str(folder / "leases")}
    with (folder / "stderr.txt").open("wb") as errors:
        done = subprocess.run(
            [sys.executable, str(HOST), "case.json"],
            cwd=folder,
            stdout=errors,
            stderr=errors,
            env=environment,
            timeout=100,
            check=False,
        )
    return _judged(case, folder, done.returncode)


def _station(case: Case, spec: str, after_s: float) -> str:
    options: dict[str, Any] = {"clock": "wall", "speed": SPEED, "journal": "journal.jsonl"}
    if case.ending.mock:
        options["faults"] = [{"kind": case.ending.mock, **_when(case.step, _plan(spec), after_s)}]
    robot = {"driver": "mock", "model": "ur5", "own_process": True, "options": options}
    return json.dumps({"hil_station": 1, "robots": {"ur5": robot}})


def _when(kind: str, plan: Plan, after_s: float) -> dict[str, Any]:
    """The moment of a fault as the mock knows it: so long after a segment began."""
    if kind != "payload":
        step = next(step for step in plan if step.kind == kind)
        return {"segment": step.index, "after_s": after_s * SPEED}
    # While the operator is asked no segment runs: counted from the motion that leads there.
    asked = next(s for s in plan if s.kind == kind and plan.loads[s.load].prompt)
    before = plan.steps[asked.index - 1]
    after_s = plan.step_duration_s(before) + (PROMPT_S / 2) * SPEED
    return {"segment": before.index, "after_s": round(after_s, 3)}


@functools.cache
def _plan(spec: str) -> Plan:
    path = Path(os.environ.get("TMPDIR", "/tmp")) / f"hil-matrix-{os.getpid()}-{spec}.yaml"
    path.write_text(SPECS[spec], "utf-8")
    try:
        experiment = hil.load(path)
        robot = open_robot("ur5", experiment.robot)
        robot.connect()
        return plan_for(experiment, robot)
    finally:
        path.unlink()


def _judged(case: Case, folder: Path, exit_code: int) -> Field:
    (run,) = folder.glob("runs/*/*/*")
    journal = _settled(folder / "journal.jsonl")
    happened = _moment(case, folder, journal)
    outcome = str(RunDirectory.open(run).status)
    if case.ending.stop_within_s is None:
        return Field(outcome, exit_code, None, None, 0, None, _lacking(run))
    stop = next(n for n in journal if n["event"] == "stop" and n["monotonic_s"] >= happened)
    later = journal[journal.index(stop) + 1 :]
    return Field(
        outcome,
        exit_code,
        stop["monotonic_s"] - happened,
        _rest(stop, later),
        sum(note["event"] in COMMANDS for note in later),
        _lost(run, stop),
    )


def _lacking(run: Path) -> tuple[str, ...]:
    stop = RunDirectory.open(run).stop or {}
    lacking = [
        k
        for k, n in stop.get("complete", {"all": {"done": 0, "of": 1}}).items()
        if n["done"] != n["of"]
    ]
    return (*lacking, *(name for name in ("gaps", "missing", "duplicates") if stop.get(name)))


def _settled(path: Path) -> list[dict[str, Any]]:
    """The journal once the arm rests and is let go: its process outlives one that was killed."""
    until = time.monotonic() + CLOSED_WITHIN_S
    while True:
        notes = sorted(_lines(path), key=lambda note: float(note["monotonic_s"]))
        said = {note["event"] for note in notes}
        stopped = [note for note in notes if note["event"] == "stop"]
        rests = "rest" in said or all(_is_slow(note) for note in stopped)
        if ("closed" in said or ("close" in said and rests)) or time.monotonic() > until:
            return notes
        time.sleep(0.05)


def _is_slow(note: dict[str, Any]) -> bool:
    return note["speed_rad_s"] is not None and note["speed_rad_s"] < REST_RAD_S


def _lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()]


def _moment(case: Case, folder: Path, journal: list[dict[str, Any]]) -> float:
    if not case.ending.mock:
        happened = json.loads((folder / "happened.json").read_text("utf-8"))
        return float(happened["monotonic_s"])
    return float(next(n for n in journal if n["event"] == "fault")["monotonic_s"])


def _rest(stop: dict[str, Any], later: list[dict[str, Any]]) -> float | None:
    if _is_slow(stop):
        return 0.0
    # An arm that nobody can stop may also end its motion by itself: then it was seen at rest.
    rest = next((note for note in later if note["event"] == "rest" or _is_slow(note)), None)
    return None if rest is None else float(rest["device_time"] - stop["device_time"])


def _lost(run: Path, stop: dict[str, Any]) -> float | None:
    try:
        rows = [read_topic(p, salvage=True) for p in RunDirectory.open(run).recordings]
    except DataError:
        return None
    last = float(np.concatenate(rows)["device_time"].max())
    return max(0.0, float(stop["device_time"]) - last)
