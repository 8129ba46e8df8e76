"""One attempt at a run: what it begins with, and how its end is written down."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from hil.campaign.experiment import Experiment
from hil.campaign.sink import COUNTED, RunSink, counts_of
from hil.data.completeness import Completeness, completeness_of
from hil.engine import Observers, Outcome, RunResult
from hil.errors import HilError, exit_code_of
from hil.plan.plan import Plan
from hil.record.recorder import Recorder
from hil.record.rundir import RunDirectory
from hil.record.topic import STATE_TOPIC

NOTHING: Mapping[str, int] = dict.fromkeys(COUNTED, 0)


@dataclass(frozen=True, slots=True)
class Before:
    """What earlier attempts of a run recorded.

    Attributes:
        counts: Of the robot record, see `Recorded.counts`.
        device_s: Device time of their samples [s].
    """

    counts: Mapping[str, int] = field(default_factory=lambda: NOTHING)
    device_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Attempt:
    """What is about to be executed.

    Attributes:
        directory: The run; everything before the motion is written.
        number: 0 for the first attempt.
        experiment: Spec and station.
        plan: Of the whole run.
        todo: What of it is to be executed now, from where the robot stands.
        before: What the attempts before this one recorded.
    """

    directory: RunDirectory
    number: int
    experiment: Experiment
    plan: Plan
    todo: Plan
    before: Before = field(default_factory=lambda: Before())


@dataclass(frozen=True, slots=True)
class Recorded:
    """What the motion left behind.

    Attributes:
        directory: The run directory, complete up to its stop document.
        result: How the run ended; a recording that could not be kept makes it `failed`.
        counts: `samples`, `gaps`, `missing`, `duplicates`, `overruns` of the robot record, over
            all attempts.
    """

    directory: RunDirectory
    result: RunResult
    counts: Mapping[str, int]


def finish(
    attempt: Attempt, result: RunResult, recorder: Recorder, sink: RunSink, observers: Observers
) -> Recorded:
    """Close everything, then write the stop document, whatever went wrong in closing."""
    lost = sink.close()
    complete, problem = _completeness(attempt, result)
    notes = (*result.notes, *(e.message for e in lost), *problem, *observers.problems())
    result = replace(result, notes=notes)
    if lost and result.error is None:
        error = lost[0]
        result = replace(result, outcome=Outcome.FAILED, reason=error.message, error=error)
    own = counts_of(recorder.counts[STATE_TOPIC])
    counts = {name: own[name] + attempt.before.counts[name] for name in COUNTED}
    document = {
        **counts,
        "steps_done": len(attempt.plan) - (len(attempt.todo) - result.steps_done),
        "unsettled": sorted(complete.unsettled) if complete else list(result.unsettled),
        "complete": complete.to_dict() if complete else {},
        "device_s": result.device_s + attempt.before.device_s,
        "wall_s": result.wall_s,
        "exit_code": exit_code_of(result.error) if result.error else 0,
        "problems": list(notes),
    }
    attempt.directory.write_stop(
        result.outcome.value, result.reason, document, attempt=attempt.number
    )
    return Recorded(attempt.directory, result, counts)


def _completeness(attempt: Attempt, result: RunResult) -> tuple[Completeness | None, list[str]]:
    """What was measured, from the data, and what a run that came to its end is missing."""
    try:
        complete = completeness_of(attempt.plan, attempt.directory.recordings)
    except HilError as error:
        return None, [f"the recording could not be read back: {error.message}"]
    lacks = result.outcome is Outcome.COMPLETED and complete.missing
    return complete, [f"the recording lacks measurements: {complete}"] if lacks else []
