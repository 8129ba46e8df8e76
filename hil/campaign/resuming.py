"""Going on with a run that ended early: what is measured stays, the rest is measured."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from hil.campaign.attempt import NOTHING, Attempt, Before, Recorded
from hil.campaign.execute import Attendance, execute
from hil.campaign.experiment import Experiment, load_experiment
from hil.campaign.operator import prompt_on, require_attended
from hil.campaign.recording import require_usable
from hil.campaign.remaining import connected_steps, remaining_steps
from hil.campaign.robots import held, standing_at
from hil.campaign.sink import COUNTED, counts_of
from hil.data.completeness import Completeness, completeness_of
from hil.engine import Outcome, RunResult
from hil.errors import DataError, PreflightFailed
from hil.plan.approach import Approach
from hil.plan.plan import Plan
from hil.plan.plan_file import read_plan
from hil.record.continuity import Counts
from hil.record.parts import attempt_of
from hil.record.provenance import utc_now
from hil.record.reader import read_topic
from hil.record.rundir import RunDirectory
from hil.robot import Robot
from hil.spec.load import spec_hash

COLD_AFTER_S = 600.0
"""An arm that has stood still for longer is warmed up again before it measures on [s]."""

SAME = ("model", "serial", "firmware", "driver")
"""What of a robot's identity must be as it was."""


@dataclass(frozen=True, slots=True)
class Unfinished:
    """A run as it lies on the disk, with something left to do.

    Attributes:
        directory: The run.
        experiment: Its own copies of spec and station.
        plan: Its own plan.
        complete: What of it was measured, by the data.
    """

    directory: RunDirectory
    experiment: Experiment
    plan: Plan
    complete: Completeness


def open_unfinished(path: Path) -> Unfinished:
    """Open a run for going on with it.

    Raises:
        DataError: It is no run, lacks what a resumption needs, or its plan or spec is not the one
            it was begun with.
    """
    directory = RunDirectory.open(path)
    start = directory.start
    for name in ("spec.yaml", "station.yaml", "plan.json"):
        if not (path / name).is_file():
            raise DataError(
                f"{path} has no {name}: it ended before anything moved",
                hint="there is nothing to go on with; run the experiment again",
            )
    plan = read_plan(path / "plan.json")
    experiment = load_experiment(path / "spec.yaml", path / "station.yaml")
    # The copy of the station in the run is the same station, and its robots the same robots.
    experiment = replace(experiment, station_source=str(start.get("station", "")))
    _require_same("plan.json", "plan_hash", start, plan.hash)
    _require_same("spec.yaml", "spec_hash", start, spec_hash(experiment.spec))
    complete = completeness_of(plan, directory.recordings)
    return Unfinished(directory, experiment, plan, complete)


def resume_recording(unfinished: Unfinished, attendance: Attendance) -> Recorded:
    """Measure what is missing, in a new attempt of the same run, which this process holds.

    Raises:
        SpecError, PluginError, RobotError: The robot cannot be reached or used.
        PlanError: No clear way leads from where the arm stands back to the plan.
        PreflightFailed: It is another robot.
        RecordingError: The run directory cannot be written to.
    """
    experiment, plan = unfinished.experiment, unfinished.plan
    directory = unfinished.directory
    with held(experiment, wait_s=attendance.wait_s, tell=attendance.stage) as (robot, lease):
        _require_same_robot(directory, robot)
        require_usable(experiment, robot)
        attendance.stage("planning the way back")
        cold = _is_cold(directory, robot)
        todo = _todo(unfinished, robot, cold=cold)
        require_attended(todo, prompt_on(robot, attendance.prompt))
        before = _before(directory, plan.rate_hz)
        with attendance.signals.guard():
            lease.note_run(directory.path)
            number = directory.next_attempt()
            directory.write_resume(
                number, _document(unfinished, robot, todo, attendance, cold=cold)
            )
            attendance.stage(
                f"going on with {plan.name} ({unfinished.complete}) → {directory.path}"
            )
            attempt = Attempt(directory, number, experiment, plan, todo, before)
            return execute(attempt, robot, attendance)


def _todo(unfinished: Unfinished, robot: Robot, *, cold: bool) -> Plan:
    """What is left, as a plan that begins where the robot stands."""
    plan, experiment = unfinished.plan, unfinished.experiment
    here = standing_at(robot.read()[-1])
    approach = Approach(
        experiment.spec, experiment.robot, rate_hz=robot.capabilities.rate_hz, here=here
    )
    left = remaining_steps(plan, unfinished.complete.done, cold=cold)
    return replace(plan, steps=tuple(connected_steps(left, here, approach.way)))


def _require_same(name: str, key: str, start: Mapping[str, Any], found: str) -> None:
    if start.get(key) != found:
        raise DataError(
            f"{name} is not what the run was begun with: its hash is {found[:12]}…, "
            f"start.json says {str(start.get(key))[:12]}…",
            hint="put the original file back, or run the experiment anew",
        )


def _require_same_robot(directory: RunDirectory, robot: Robot) -> None:
    """Two robots in one dataset would be identified as one that does not exist."""
    recorded = directory.start.get("robot", {})
    was, now = recorded.get("identity", {}), asdict(robot.identity)
    can = robot.capabilities
    was = {key: was.get(key) for key in SAME} | {
        "joint_names": recorded.get("joint_names"),
        "rate_hz": recorded.get("rate_hz"),
    }
    now = {key: now[key] for key in SAME} | {
        "joint_names": list(can.joint_names),
        "rate_hz": can.rate_hz,
    }
    differs = [f"{key} was {was[key]!r}, is {now[key]!r}" for key in was if was[key] != now[key]]
    if differs:
        raise PreflightFailed(
            f"this is not the robot of {directory.path}: {'; '.join(differs)}",
            hint="connect the robot that began the run, or run the experiment anew on this one",
        )


def _is_cold(directory: RunDirectory, robot: Robot) -> bool:
    """Whether the arm has stood still too long; a simulated one is switched on cold each time."""
    if robot.capabilities.clock == "virtual":
        return True
    newest = max((float(event.get("t", 0.0)) for event in directory.events()), default=0.0)
    return time.time() - newest > COLD_AFTER_S


def _before(directory: RunDirectory, rate_hz: float) -> Before:
    """What the recordings so far hold; their gaps and duplicates count for the whole run."""
    total, device_s = dict(NOTHING), 0.0
    for _, parts in groupby(directory.recordings, attempt_of):
        counts = Counts()
        for path in parts:
            with contextlib.suppress(DataError):  # torn before its first samples
                counts = counts.after(read_topic(path, salvage=True), rate_hz)
        own = counts_of(counts)
        total = {name: total[name] + own[name] for name in COUNTED}
        device_s += counts.last_time - counts.first_time if counts.samples else 0.0
    return Before(total, device_s)


def _document(
    unfinished: Unfinished, robot: Robot, todo: Plan, attendance: Attendance, *, cold: bool
) -> dict[str, Any]:
    """What `resume-NN.json` says."""
    return {
        "resumed": utc_now(),
        "operator": attendance.operator,
        "host": socket.gethostname(),
        "pid": os.getpid(),
        "status_before": unfinished.directory.status,
        "complete_before": unfinished.complete.to_dict(),
        "plan_hash": unfinished.plan.hash,
        "robot": asdict(robot.identity),
        "warmed_up_again": cold,
        "waivers": dict(attendance.waivers),
        "steps": [step.index for step in todo],
        "approach": [step.to_dict() for step in todo if step.index < 0],
    }


def recorded_before(unfinished: Unfinished) -> Recorded:
    """A run whose measuring steps are all complete, as if its motion had just come to its end.

    Raises:
        DataError: It has been judged, so nothing is left to do.
    """
    directory = unfinished.directory
    if (directory.path / "verdict.json").exists():
        raise DataError(
            f"{directory.path} is complete ({unfinished.complete}) and judged",
            hint=f"look at it: hil show {directory.path}",
        )
    before = _before(directory, unfinished.plan.rate_hz)
    steps = len(unfinished.plan)
    unsettled = tuple(sorted(unfinished.complete.unsettled))
    samples = before.counts["samples"]
    result = RunResult(Outcome.COMPLETED, "", None, steps, unsettled, samples, before.device_s, 0.0)
    return Recorded(directory, result, before.counts)
