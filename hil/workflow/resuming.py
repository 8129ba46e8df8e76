"""Resuming a run that ended early: retain complete measurements and measure what is missing.

A plan is divided into legs: the motions that lead to one measurement, and the measurement. A leg
whose data are complete is never repeated. An incomplete leg is repeated entirely, so that every
dwell is approached from the planned direction. The payload is mounted and checked again before the
first leg with each load, because the load may have been changed after the run ended.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms import require_same_arm
from hil.core import DataError, FloatArray, PreflightFailed, read_json
from hil.engine import Outcome, RunResult
from hil.excitation import STANDSTILL_RAD, Line
from hil.importers import Completeness, completeness_of, recorded_rows
from hil.planning import Approach, Experiment, Plan, Step, held, read_plan, standing_at
from hil.planning import load as load_experiment
from hil.recording import (
    Counts,
    RunDirectory,
    attempt_of,
    name_of_attempt,
    read_topic,
    started_as,
    utc_now,
)
from hil.robot import Robot, Status
from hil.spec import spec_hash
from hil.workflow.interlocks import RunInterlocks
from hil.workflow.judging import forget_training
from hil.workflow.motion_confirmation import Gate, Granted, MotionFacts, was_shown
from hil.workflow.operator import prompt_on, require_attended
from hil.workflow.payload_check import Readings, all_reliable, readings_of_earlier_attempts
from hil.workflow.recording import (
    COUNTED,
    NOTHING,
    Attempt,
    Attendance,
    Before,
    Recorded,
    counts_of,
    describe_robot,
    execute,
    require_usable,
)


@dataclass(frozen=True, slots=True)
class Unfinished:
    """Unfinished run with its plan and recordings.

    Attributes:
        directory: Run directory.
        experiment: Experiment, loaded from the copies of spec and station in the run directory.
        plan: Plan stored in the run directory.
        complete: Measured part of the plan, according to the recordings.
    """

    directory: RunDirectory
    experiment: Experiment
    plan: Plan
    complete: Completeness


def require_resumable(path: Path) -> RunDirectory:
    """Return a run if its documents allow it to be resumed; the recordings are not read.

    Raises:
        DataError: The directory is not a run directory, the kind of run cannot be resumed, or a
            file is missing.
    """
    directory = RunDirectory.open(path)
    start = directory.start
    if start.get("passive"):
        raise DataError(
            f"{path} is a passive recording, which has no plan and cannot be resumed",
            hint=f"fit the recorded data (hil fit {path}), or record again",
        )
    if "commissioning" in start:
        raise DataError(
            f"{path} is a commissioning run, which cannot be resumed: the motion back to the plan "
            "would be at full speed",
            hint="run the experiment again with --speed-scale and --limit",
        )
    if directory.pruned:
        raise DataError(
            f"recordings of {path} were deleted (pruned.json)",
            hint="run the experiment again",
        )
    for name in ("spec.yaml", "station.yaml", "plan.json"):
        if not (path / name).is_file():
            raise DataError(
                f"{path} has no {name}: the run ended before the robot moved",
                hint="nothing can be resumed; run the experiment again",
            )
    return directory


def open_unfinished(path: Path) -> Unfinished:
    """Return the unfinished run that is to be resumed.

    Raises:
        DataError: The run cannot be resumed (see `require_resumable`), its plan or spec was changed
            since the run began, or the run already has verdict and report.
    """
    directory = require_resumable(path)
    start = directory.start
    plan = read_plan(path / "plan.json")
    experiment = load_experiment(path / "spec.yaml", path / "station.yaml")
    # Leases depend on the source of the station, so the copy in the run keeps the original source.
    experiment = replace(experiment, station_source=str(start.get("station", "")))
    require_same_arm(_recorded_robot(directory), path, "run the experiment again")
    _require_same("plan.json", "plan_hash", start, plan.hash)
    _require_same("spec.yaml", "spec_hash", start, spec_hash(experiment.spec))
    complete = completeness_of(plan, directory.recordings)
    _require_something_left(directory, complete)
    return Unfinished(directory, experiment, plan, complete)


def _require_same(name: str, key: str, start: Mapping[str, Any], digest: str) -> None:
    if start.get(key) != digest:
        raise DataError(
            f"{name} has changed since the run began: its hash is {digest[:12]}…, but start.json "
            f"contains {str(start.get(key))[:12]}…",
            hint="restore the original file, or run the experiment again",
        )


def _require_something_left(directory: RunDirectory, complete: Completeness) -> None:
    """Raise if a run already has verdict and report, or a verdict on an incomplete recording.

    A verdict is valid for the recording that was evaluated, so no data are added to this recording
    after the verdict.
    """
    if not directory.is_judged:
        return
    forget_training(directory.path)  # trainings left by a kill after the verdict
    if complete.missing:
        raise DataError(
            f"{directory.path} was complete when it was evaluated, but now only {complete} are "
            "complete",
            hint="the recording was damaged since then: restore it from a copy, or run the "
            "experiment again",
        )
    if directory.is_reported:
        raise DataError(
            f"{directory.path} is complete ({complete}), evaluated and reported",
            hint=f"show the result: hil show {directory.path}",
        )


def resume_recording(unfinished: Unfinished, attendance: Attendance) -> Recorded:
    """Measure what is missing in a new attempt of a run whose lock this process holds.

    Raises:
        SpecError, PluginError, RobotError: The robot cannot be reached or used.
        PlanError: No collision-free motion leads from the present pose of the arm back to the plan.
        PreflightFailed: The connected robot is not the robot with which the run began.
        NotConfirmed: The operator did not confirm the motion again, although address or payload
            differs from the confirmed one, or the motion sweeps more space or is faster than
            confirmed.
        RecordingError: The run directory cannot be written to.
    """
    experiment, plan = unfinished.experiment, unfinished.plan
    directory = unfinished.directory
    gate = Gate(experiment, attendance.confirm, _confirmed_before(directory))
    with held(experiment, wait_s=attendance.wait_s, report=attendance.stage, admit=gate.admit) as (
        robot,
        lease,
    ):
        attendance.stage("planning the motion back to the plan")
        todo, weighed, cold = _remaining(unfinished, robot)
        require_attended(todo, prompt_on(robot, attendance.prompt), resumed=True)
        interlocks = RunInterlocks(experiment, robot, plan)
        confirmed = gate.confirmation(robot, todo)
        if not was_shown(confirmed):
            attendance.planned(todo)
        before = replace(_before(directory, plan.rate_hz), first_load=weighed)
        with attendance.signals.guard():
            lease.note_run(directory.path)
            number = directory.next_attempt()
            directory.write_resume(
                number,
                _resume_document(unfinished, robot, todo, attendance, cold=cold)
                | ({"confirmation": confirmed} if confirmed else {}),
            )
            attendance.stage(f"resuming {plan.name} ({unfinished.complete}) → {directory.path}")
            for text in _repetitions(unfinished, todo, cold=cold):
                attendance.stage(text)
            attempt = Attempt(directory, number, experiment, plan, todo, interlocks, before)
            return execute(attempt, robot, attendance)


def _confirmed_before(directory: RunDirectory) -> Mapping[str, Any] | None:
    """Return the facts of the last confirmation of motion; None for a run without confirmation."""
    names = [name_of_attempt("resume.json", n) for n in range(directory.attempts - 1, 0, -1)]
    documents = [read_json(path) for name in names if (path := directory.path / name).is_file()]
    for document in (*documents, directory.start):
        if isinstance(answer := document.get("confirmation"), dict):
            facts = answer.get("facts")
            return facts if isinstance(facts, dict) else None
    return None


def _remaining(unfinished: Unfinished, robot: Robot) -> tuple[Plan, Readings, bool]:
    """Return the remaining plan, the readings of the first load, and whether the arm is cold."""
    directory, plan = unfinished.directory, unfinished.plan
    require_same_robot(directory, describe_robot(robot, unfinished.experiment.robot))
    require_usable(unfinished.experiment, robot)
    cold = _is_cold(unfinished, robot)
    weighed = readings_of_earlier_attempts(plan, directory.recordings, robot.capabilities)
    todo = _with_prompt(_todo(unfinished, robot, weighed, cold=cold), directory)
    return todo, weighed, cold


COLD_AFTER_S = 600.0
"""Standstill time after which an arm is warmed up again before further measurements [s]."""


def _is_cold(unfinished: Unfinished, robot: Robot) -> bool:
    """Return whether the arm is cold after a standstill; always True for a simulated arm."""
    if robot.capabilities.clock == "virtual":
        return True  # each connection switches the mock on anew
    directory = unfinished.directory
    moved_s, last = 0.0, -1
    for path in directory.recordings:
        rows = recorded_rows(path)
        if rows is not None and (moving := (rows["status"] & int(Status.MOVING)) != 0).any():
            moved_s, last = float(np.nanmax(rows["host_time"][moving])), attempt_of(path)
    if time.time() - moved_s > COLD_AFTER_S:
        return True
    # An attempt without any measurement possibly did not complete its warm-up.
    own = [path for path in directory.recordings if attempt_of(path) == last]
    return last > 0 and not completeness_of(unfinished.plan, own).done


def _with_prompt(plan: Plan, directory: RunDirectory) -> Plan:
    """Return a plan that prompts for its first load if a different load is possibly mounted.

    A plan prompts for a load when that load begins; a resumed run may have to return to an earlier
    load, for which the plan has no prompt.
    """
    declared = [e.get("load") for e in directory.events() if e.get("kind") == "payload"]
    first = next((step.load for step in plan if step.kind == "payload"), 0)
    by_hand = any(load.prompt for load in plan.loads)
    if not (by_hand and declared and declared[-1] != first) or plan.loads[first].prompt:
        return plan
    mass = plan.loads[first].payload.mass
    what = f"Mount load {first} ({mass:g} kg) again" if mass else "Remove the load again"
    prompted = replace(plan.loads[first], prompt=f"{what}: the run returns to load {first}")
    loads = (*plan.loads[:first], prompted, *plan.loads[first + 1 :])
    return replace(plan, loads=loads)


def _todo(unfinished: Unfinished, robot: Robot, weighed: Readings, *, cold: bool) -> Plan:
    """Return the remaining steps as a plan that begins at the present pose of the robot."""
    plan, experiment = unfinished.plan, unfinished.experiment
    here = standing_at(robot.read()[-1])
    approach = Approach(
        experiment.spec,
        experiment.robot,
        rate_hz=robot.capabilities.rate_hz,
        here=here,
        targets=np.array([motion.q_end for motion in plan.motions]),
    )
    again = bool(weighed) and not all_reliable(weighed)
    left = remaining_steps(plan, unfinished.complete.done, cold=cold, weigh_first=again)
    return replace(plan, steps=tuple(connected_steps(left, here, approach.way)))


def _before(directory: RunDirectory, rate_hz: float) -> Before:
    """Return the totals of the earlier recordings, which are added to the counts of the run."""
    total, device_s = dict(NOTHING), 0.0
    for _, parts in groupby(directory.recordings, attempt_of):
        counts = Counts()
        for path in parts:
            with contextlib.suppress(DataError):  # truncated before the first samples
                counts = counts.after(read_topic(path, salvage=True), rate_hz)
        own = counts_of(counts)
        total = {name: total[name] + own[name] for name in COUNTED}
        device_s += counts.last_time - counts.first_time if counts.samples else 0.0
    return Before(total, device_s)


def _resume_document(
    unfinished: Unfinished, robot: Robot, todo: Plan, attendance: Attendance, *, cold: bool
) -> dict[str, Any]:
    """Return the content of the resume document `resume-NN.json`."""
    return {
        "resumed": utc_now(),
        "operator": attendance.operator,
        "host": socket.gethostname(),
        "pid": os.getpid(),
        **started_as(),
        "status_before": unfinished.directory.status,
        "complete_before": unfinished.complete.to_dict(),
        "plan_hash": unfinished.plan.hash,
        "robot": asdict(robot.identity),
        "warmed_up_again": cold,
        "waivers": dict(attendance.waivers),
        "steps": [step.index for step in todo],
        "approach": [step.to_dict() for step in todo if step.index < 0],
    }


def _repetitions(unfinished: Unfinished, todo: Plan, *, cold: bool) -> Iterator[str]:
    """Yield a message for each repeated action, with the reason for the repetition.

    Without these messages, an operator might conclude that the resumed run restarts from the
    beginning.
    """
    kinds = {step.kind for step in todo}
    weighs = {step.load for step in todo if step.kind == "weigh"}
    events = unfinished.directory.events()
    if any(e.get("kind") == "weighing" and e.get("load") in weighs for e in events):
        yield "weighing again, because the load may have been changed since then"
    if cold and "warmup" in kinds and unfinished.complete.done:
        yield "warming up again, because the arm may have cooled down since then"


def remaining_motion(unfinished: Unfinished) -> MotionFacts | None:
    """Return the facts to confirm before a run is resumed; None if no confirmation is needed.

    `remaining_motion` leases the robot and connects to it, because the resumed motion begins at the
    present pose of the robot.

    Raises:
        SpecError, PluginError, RobotError, PlanError, PreflightFailed: The errors are those of
            `resume_recording`.
    """
    if not unfinished.complete.missing:
        return None
    experiment = unfinished.experiment
    # No robot moves in this function, so any robot is admitted.
    gate = Gate(experiment, Granted("preview"), _confirmed_before(unfinished.directory))
    with held(experiment, report=lambda text: None, admit=gate.admit) as (robot, _):
        todo, _, _ = _remaining(unfinished, robot)
        return gate.facts(robot, todo)


SAME_ROBOT = ("model", "gravity_m_s2", "joint_names", "rate_hz", "effort_kind", "drive_gains")
SAME_IDENTITY = ("model", "serial", "firmware", "driver")
"""Keys of `start.json:robot` and of its entry `identity` whose values must be the same in a
resumed run."""


def _recorded_robot(directory: RunDirectory) -> Mapping[str, Any]:
    """Return the robot entry of a run's start document; empty for runs of an older version of hil.

    Raises:
        DataError: The robot entry of the start document is damaged.
    """
    robot = directory.start.get("robot", {})
    if not isinstance(robot, Mapping) or not isinstance(robot.get("identity", {}), Mapping):
        raise DataError(
            f"{directory.path / 'start.json'} does not state the robot of the run",
            hint="run the experiment again",
        )
    return robot


def require_same_robot(directory: RunDirectory, robot: Mapping[str, Any]) -> None:
    """Raise if a robot is not the robot with which a run began.

    A dataset with samples of two robots would describe neither of the two robots.

    Args:
        directory: Run directory.
        robot: Description of the connected robot, returned by `describe_robot`.

    Raises:
        PreflightFailed: The robot is not the robot with which the run began.
        DataError: The start document is damaged.
    """
    recorded = _recorded_robot(directory)
    pairs = {key: (recorded.get(key), robot[key]) for key in SAME_ROBOT}
    was, now = recorded.get("identity", {}), robot["identity"]
    pairs |= {key: (was.get(key), now[key]) for key in SAME_IDENTITY}
    differs = [f"{key} was {old!r}, is {new!r}" for key, (old, new) in pairs.items() if old != new]
    if differs:
        raise PreflightFailed(
            f"this is not the robot of {directory.path}: {'; '.join(differs)}",
            hint="connect the robot that began the run, or run the experiment again on this one",
        )


DIED_AFTER = "the process died after the last measurement; the end was written later"


def recorded_before(unfinished: Unfinished) -> Recorded:
    """Return a run whose measuring steps are all complete, as if its motion had just ended.

    A process that died after its last measurement wrote no stop document, so `recorded_before`
    writes the document.

    Raises:
        RecordingError: The stop document cannot be written to the disk.
    """
    directory = unfinished.directory
    before = _before(directory, unfinished.plan.rate_hz)
    steps = len(unfinished.plan)
    unsettled = tuple(sorted(unfinished.complete.unsettled))
    samples = before.counts["samples"]
    if directory.stop is None:
        document = {
            **before.counts,
            "steps_done": steps,
            "unsettled": list(unsettled),
            "complete": unfinished.complete.to_dict(),
            "device_s": before.device_s,
            "exit_code": 0,
            "problems": [DIED_AFTER],
        }
        directory.write_stop("completed", "", document, attempt=directory.attempts - 1)
    result = RunResult(Outcome.COMPLETED, "", None, steps, unsettled, samples, before.device_s, 0.0)
    return Recorded(directory, result, before.counts)


@dataclass(frozen=True, slots=True)
class Leg:
    """Consecutive steps, the last of which measures, checks the payload or changes the load.

    Attributes:
        steps: List of the steps of the leg, in order.
        closed: Whether the leg ends with a measurement, payload check or change of the load; False
            for motions at the end of a load that lead to no measurement.
    """

    steps: tuple[Step, ...]
    closed: bool = True

    @property
    def last(self) -> Step:
        """Last step of the leg, to which the other steps of the leg lead."""
        return self.steps[-1]


def legs_of(plan: Plan) -> list[Leg]:
    """Return the legs of a plan in order; together, the legs contain all steps of the plan."""
    legs: list[Leg] = []
    open_steps: list[Step] = []
    for step in plan:
        if step.kind == "payload" and open_steps:
            legs.append(Leg(tuple(open_steps), closed=False))
            open_steps = []
        open_steps.append(step)
        if step.measures or step.kind in ("payload", "weigh"):
            legs.append(Leg(tuple(open_steps)))
            open_steps = []
    return [*legs, Leg(tuple(open_steps), closed=False)] if open_steps else legs


def remaining_steps(
    plan: Plan, done: Collection[int], *, cold: bool, weigh_first: bool = False
) -> list[Step]:
    """Return the steps of a plan that still have to be executed, in order.

    Args:
        plan: Whole plan.
        done: Indices of the complete measuring steps.
        cold: Whether the arm has to be warmed up again before it measures.
        weigh_first: Whether the payload check of the first load is repeated even if no measurement
            with the first load is missing, because the first load is the reference for the other
            loads.
    """
    legs = legs_of(plan)
    needed = {step.load for step in plan if step.measures and step.index not in done}
    if needed and weigh_first:
        needed.add(0)
    warm_up = [step for step in plan if step.kind == "warmup"] if cold else []
    steps: list[Step] = []
    for load in dict.fromkeys(step.load for step in plan):
        if load not in needed:
            continue
        own = [leg for leg in legs if leg.closed and leg.last.load == load]
        todo = [leg for leg in own if leg.last.measures and leg.last.index not in done]
        before = [leg for leg in own if leg.last.kind in ("payload", "weigh")]
        steps += [step for leg in before for step in leg.steps]
        # One warm-up before the first remaining measurement, unless its leg contains one already.
        if todo and not any(step.kind == "warmup" for step in todo[0].steps):
            steps += warm_up
        warm_up = [] if todo else warm_up
        steps += [step for leg in todo for step in leg.steps]
    return steps


Way = Callable[[FloatArray, FloatArray], Sequence[Line]]
"""Function that returns a collision-free path of straight lines from one joint position (n,) to
another.

The function raises `PlanError` if no collision-free path exists.
"""

FIRST_APPROACH = -2
"""Step index of the first motion back to the plan; further motions have the indices −3, −4, ….

The step index −1 is reserved for the absence of a step.
"""


def connected_steps(steps: Sequence[Step], here: FloatArray, way: Way) -> list[Step]:
    """Return the steps and the additional motions that connect them.

    The first change of the load happens at the present pose of the arm; later changes happen at
    their planned poses.

    Args:
        steps: Steps of a plan, in order; some steps of the plan may be missing.
        here: (n,) set-point that the robot holds [rad].
        way: Function that returns a path from one joint position to another.

    Raises:
        PlanError: No collision-free path connects the steps.
    """
    connected: list[Step] = []
    index = FIRST_APPROACH
    for i, step in enumerate(steps):
        starts = (one.motion.q_start for one in steps[i:] if one.motion is not None)
        target = next(starts, None) if i or step.motion is not None else None
        if target is not None and np.abs(target - here).max() >= STANDSTILL_RAD:
            for k, line in enumerate(way(here, target)):
                connected.append(Step(index, "move", line, load=step.load, checkpoint=k == 0))
                index -= 1
            here = target
        connected.append(step)
        if step.motion is not None:
            here = step.motion.q_end
    return connected
