"""Resuming a run that ended early: what was measured stays, the rest is measured.

A plan falls into legs: the motions that lead to one measurement, and the measurement. A leg that
is complete in the data is never repeated, an incomplete one is repeated whole, so that every dwell
is reached from the side that the plan reaches it from. Mounting a load and checking it comes before
the first leg under each load, because it is unknown what was done to the robot in between.
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
    """A run on the disk with something left to do.

    Attributes:
        directory: The run.
        experiment: Of its own copies of spec and station.
        plan: Its own plan.
        complete: What of the plan was measured, by the recordings.
    """

    directory: RunDirectory
    experiment: Experiment
    plan: Plan
    complete: Completeness


def require_resumable(path: Path) -> RunDirectory:
    """Return a run that can be resumed, as far as its documents say; its recordings are not read.

    Raises:
        DataError: It is no run, one of a kind that cannot be resumed, or lacks a file.
    """
    directory = RunDirectory.open(path)
    start = directory.start
    if start.get("passive"):
        raise DataError(
            f"{path} is a passive recording: there is no plan to go on with",
            hint=f"use what there is (hil fit {path}), or record again",
        )
    if "commissioning" in start:
        raise DataError(
            f"{path} is a commissioning run: its way back would be at full speed",
            hint="run the experiment again with --speed and --first",
        )
    if directory.pruned:
        raise DataError(
            f"{path} lacks recordings that were deleted (pruned.json)",
            hint="run the experiment again",
        )
    for name in ("spec.yaml", "station.yaml", "plan.json"):
        if not (path / name).is_file():
            raise DataError(
                f"{path} has no {name}: it ended before anything moved",
                hint="there is nothing to go on with; run the experiment again",
            )
    return directory


def open_unfinished(path: Path) -> Unfinished:
    """Return a run that is to be resumed.

    Raises:
        DataError: See `require_resumable`; or its plan or spec is not the one it was begun with,
            or it was judged and reported already.
    """
    directory = require_resumable(path)
    start = directory.start
    plan = read_plan(path / "plan.json")
    experiment = load_experiment(path / "spec.yaml", path / "station.yaml")
    # The copy in the run describes that station: its robots have the same leases.
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
            f"{name} is not what the run was begun with: its hash is {digest[:12]}…, "
            f"start.json says {str(start.get(key))[:12]}…",
            hint="put the original file back, or run the experiment again",
        )


def _require_something_left(directory: RunDirectory, complete: Completeness) -> None:
    """Raise if a run is judged and reported, or judged and no longer complete.

    A verdict holds for the recording that was judged: nothing is added to it afterwards.
    """
    if not directory.is_judged:
        return
    forget_training(directory.path)  # trainings that a kill after the verdict has left
    if complete.missing:
        raise DataError(
            f"{directory.path} was judged when it was complete, but now only {complete} are whole",
            hint="the recording was damaged since: restore it from a copy, or run the experiment "
            "again",
        )
    if directory.is_reported:
        raise DataError(
            f"{directory.path} is complete ({complete}), judged and reported",
            hint=f"look at it: hil show {directory.path}",
        )


def resume_recording(unfinished: Unfinished, attendance: Attendance) -> Recorded:
    """Measure what is missing, in a new attempt of the same run, which this process holds.

    Raises:
        SpecError, PluginError, RobotError: The robot cannot be reached or used.
        PlanError: No clear way leads from where the arm stands back to the plan.
        PreflightFailed: It is another robot.
        NotConfirmed: Address or payload differs from the confirmed one, or the motion goes
            further or is faster, and was not confirmed.
        RecordingError: The run directory cannot be written to.
    """
    experiment, plan = unfinished.experiment, unfinished.plan
    directory = unfinished.directory
    gate = Gate(experiment, attendance.confirm, _confirmed_before(directory))
    with held(experiment, wait_s=attendance.wait_s, report=attendance.stage, admit=gate.admit) as (
        robot,
        lease,
    ):
        attendance.stage("planning the way back")
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
            attendance.stage(
                f"going on with {plan.name} ({unfinished.complete}) → {directory.path}"
            )
            for text in _repetitions(unfinished, todo, cold=cold):
                attendance.stage(text)
            attempt = Attempt(directory, number, experiment, plan, todo, interlocks, before)
            return execute(attempt, robot, attendance)


def _confirmed_before(directory: RunDirectory) -> Mapping[str, Any] | None:
    """Return the facts that were confirmed last; None for a run without a confirmation."""
    names = [name_of_attempt("resume.json", n) for n in range(directory.attempts - 1, 0, -1)]
    documents = [read_json(path) for name in names if (path := directory.path / name).is_file()]
    for document in (*documents, directory.start):
        if isinstance(answer := document.get("confirmation"), dict):
            facts = answer.get("facts")
            return facts if isinstance(facts, dict) else None
    return None


def _remaining(unfinished: Unfinished, robot: Robot) -> tuple[Plan, Readings, bool]:
    """Return what is left to execute, what the first load weighed, and whether the arm is cold."""
    directory, plan = unfinished.directory, unfinished.plan
    require_same_robot(directory, describe_robot(robot, unfinished.experiment.robot))
    require_usable(unfinished.experiment, robot)
    cold = _is_cold(unfinished, robot)
    weighed = readings_of_earlier_attempts(plan, directory.recordings, robot.capabilities)
    todo = _with_prompt(_todo(unfinished, robot, weighed, cold=cold), directory)
    return todo, weighed, cold


COLD_AFTER_S = 600.0
"""An arm that has stood still for longer is warmed up again before further measurements [s]."""


def _is_cold(unfinished: Unfinished, robot: Robot) -> bool:
    """Return whether the arm has stood still too long; a simulated one is always cold."""
    if robot.capabilities.clock == "virtual":
        return True  # each connection switches it on anew
    directory = unfinished.directory
    moved_s, last = 0.0, -1
    for path in directory.recordings:
        rows = recorded_rows(path)
        if rows is not None and (moving := (rows["status"] & int(Status.MOVING)) != 0).any():
            moved_s, last = float(np.nanmax(rows["host_time"][moving])), attempt_of(path)
    if time.time() - moved_s > COLD_AFTER_S:
        return True
    # An attempt that measured nothing may not have come to the end of its warm-up.
    own = [path for path in directory.recordings if attempt_of(path) == last]
    return last > 0 and not completeness_of(unfinished.plan, own).done


def _with_prompt(plan: Plan, directory: RunDirectory) -> Plan:
    """Return a plan that asks for its first load, if that may not be the one that is mounted.

    A plan asks for a load when it comes to it; a resumed run may have to go back to an earlier one.
    """
    declared = [e.get("load") for e in directory.events() if e.get("kind") == "payload"]
    first = next((step.load for step in plan if step.kind == "payload"), 0)
    by_hand = any(load.prompt for load in plan.loads)
    if not (by_hand and declared and declared[-1] != first) or plan.loads[first].prompt:
        return plan
    mass = plan.loads[first].payload.mass
    what = f"Mount load {first} ({mass:g} kg) again" if mass else "Take the load off again"
    prompted = replace(plan.loads[first], prompt=f"{what}: the run goes back to it")
    loads = (*plan.loads[:first], prompted, *plan.loads[first + 1 :])
    return replace(plan, loads=loads)


def _todo(unfinished: Unfinished, robot: Robot, weighed: Readings, *, cold: bool) -> Plan:
    """Return what is left as a plan that begins where the robot stands."""
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
    """Return what the recordings so far contain; their counts are part of those of the run."""
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


def _resume_document(
    unfinished: Unfinished, robot: Robot, todo: Plan, attendance: Attendance, *, cold: bool
) -> dict[str, Any]:
    """Return the content of `resume-NN.json`."""
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
    """Yield what is done again, and why: it might look as if the program began from the start."""
    kinds = {step.kind for step in todo}
    weighs = {step.load for step in todo if step.kind == "weigh"}
    events = unfinished.directory.events()
    if any(e.get("kind") == "weighing" and e.get("load") in weighs for e in events):
        yield "weighing again, on purpose: nobody knows what was done to the load meanwhile"
    if cold and "warmup" in kinds and unfinished.complete.done:
        yield "warming up again, on purpose: the arm may have cooled down meanwhile"


def remaining_motion(unfinished: Unfinished) -> MotionFacts | None:
    """Return what has to be confirmed before a run is resumed; None if nothing has to be.

    The robot is leased and connected to for that: the way back begins where it stands.

    Raises:
        SpecError, PluginError, RobotError, PlanError, PreflightFailed: See `resume_recording`.
    """
    if not unfinished.complete.missing:
        return None
    experiment = unfinished.experiment
    # Nothing moves here, so any robot is admitted.
    gate = Gate(experiment, Granted("preview"), _confirmed_before(unfinished.directory))
    with held(experiment, report=lambda text: None, admit=gate.admit) as (robot, _):
        todo, _, _ = _remaining(unfinished, robot)
        return gate.facts(robot, todo)


SAME_ROBOT = ("model", "gravity_m_s2", "joint_names", "rate_hz", "effort_kind", "drive_gains")
SAME_IDENTITY = ("model", "serial", "firmware", "driver")
"""Keys of `start.json:robot`, and of its `identity`, that must be as they were."""


def _recorded_robot(directory: RunDirectory) -> Mapping[str, Any]:
    """Return the robot of a run, from its start document; empty in runs of an older hil.

    Raises:
        DataError: The document is damaged there.
    """
    robot = directory.start.get("robot", {})
    if not isinstance(robot, Mapping) or not isinstance(robot.get("identity", {}), Mapping):
        raise DataError(
            f"{directory.path / 'start.json'} does not say which robot the run is of",
            hint="run the experiment again",
        )
    return robot


def require_same_robot(directory: RunDirectory, robot: Mapping[str, Any]) -> None:
    """Raise if a robot is not the one of a run: their samples in one dataset describe neither.

    Args:
        directory: The run.
        robot: From `describe_robot`.

    Raises:
        PreflightFailed: It is another robot.
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

    A process that died after its last measurement wrote no stop document: it is written now.

    Raises:
        RecordingError: The disk refuses.
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
    """Steps that belong together, the last of which measures, weighs or changes the load.

    Attributes:
        steps: In order.
        closed: False for motions at the end of a load that lead to no measurement.
    """

    steps: tuple[Step, ...]
    closed: bool = True

    @property
    def last(self) -> Step:
        """The step that the others lead to."""
        return self.steps[-1]


def legs_of(plan: Plan) -> list[Leg]:
    """Return the legs of a plan, in order; together they are all its steps."""
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
    """Return the steps of a plan that are still to be executed, in order.

    Args:
        plan: The whole plan.
        done: Indices of the measuring steps that are complete.
        cold: Whether the arm has to be warmed up again.
        weigh_first: Whether the first load has to be weighed again even if nothing is left to
            measure with it: the others are weighed against it.
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
        # Once, before the first measurement that is left; its leg may have the warm-up itself.
        if todo and not any(step.kind == "warmup" for step in todo[0].steps):
            steps += warm_up
        warm_up = [] if todo else warm_up
        steps += [step for leg in todo for step in leg.steps]
    return steps


Way = Callable[[FloatArray, FloatArray], Sequence[Line]]
"""Returns clear lines from one joint position (n,) to another; raises `PlanError` without any."""

FIRST_APPROACH = -2
"""Index of the first motion back to the plan; the next ones count down. −1 is `no step`."""


def connected_steps(steps: Sequence[Step], here: FloatArray, way: Way) -> list[Step]:
    """Return steps with the motions between them that the plan did not need.

    The first change of load happens where the arm stands; later ones where the plan has them.

    Args:
        steps: Of a plan, in order, some left out.
        here: (n,) set-point the robot holds [rad].
        way: Finds the way from one position to another.

    Raises:
        PlanError: There is no clear way.
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
