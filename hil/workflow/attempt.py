"""One attempt at a run: what it begins with, and how its end is written down."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from hil.core import HilError, RecordingError, exit_code_of
from hil.engine import Observers, Outcome, RunResult
from hil.importers import Completeness, completeness_of
from hil.planning import Experiment, Plan
from hil.recording import Recorder, RunDirectory
from hil.robot import STATE_TOPIC
from hil.workflow.interlocks import RunInterlocks
from hil.workflow.sink import COUNTED, RunSink, counts_of, recorded_span
from hil.workflow.weighed_before import Readings

NOTHING: Mapping[str, int] = dict.fromkeys(COUNTED, 0)


@dataclass(frozen=True, slots=True)
class Before:
    """What earlier attempts of a run recorded.

    Attributes:
        counts: Of the robot record, see `Recorded.counts`.
        device_s: Device time of their samples [s].
        first_load: What the first load weighed, see `weighed_before`.
    """

    counts: Mapping[str, int] = field(default_factory=lambda: NOTHING)
    device_s: float = 0.0
    first_load: Readings = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Attempt:
    """What is about to be executed.

    Attributes:
        directory: The run; everything before the motion is written.
        number: 0 for the first attempt.
        experiment: Spec and station.
        plan: Of the whole run.
        todo: What of it is to be executed now, from where the robot stands.
        interlocks: Watch over it.
        before: What the attempts before this one recorded.
    """

    directory: RunDirectory
    number: int
    experiment: Experiment
    plan: Plan
    todo: Plan
    interlocks: RunInterlocks
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
    complete, problem = _completeness(attempt)
    notes = (*result.notes, *(e.message for e in lost), *observers.problems())
    notes += (problem.message,) if problem and not complete and result.error else ()
    result = replace(result, notes=notes)
    if result.error is None and (error := lost[0] if lost else problem):
        result = replace(result, outcome=Outcome.FAILED, reason=error.message, error=error)
    own = counts_of(recorder.counts[STATE_TOPIC])
    counts = {name: own[name] + attempt.before.counts[name] for name in COUNTED}
    document = {
        **counts,
        "steps_done": _steps_done(attempt, result),
        "unsettled": sorted(complete.unsettled) if complete else list(result.unsettled),
        "complete": complete.to_dict() if complete else {},
        "device_s": result.device_s + attempt.before.device_s,
        "wall_s": result.wall_s,
        "recorded": recorded_span(recorder.counts[STATE_TOPIC]),
        "exit_code": exit_code_of(result.error) if result.error else 0,
        "problems": list(notes),
        **({"hint": result.error.hint} if result.error and result.error.hint else {}),
    }
    attempt.directory.write_stop(
        result.outcome.value, result.reason, document, attempt=attempt.number
    )
    return Recorded(attempt.directory, result, counts)


def _steps_done(attempt: Attempt, result: RunResult) -> int:
    """Steps of the plan that need not be executed any more."""
    left = {step.index for step in attempt.todo.steps[result.steps_done :] if step.index >= 0}
    return len(attempt.plan) - len(left)


def _completeness(attempt: Attempt) -> tuple[Completeness | None, HilError | None]:
    """What was measured, from the data; and an error when it cannot be told, or lacks something.

    Motion that came to its end is no success if the recording has not got it.
    """
    try:
        complete = completeness_of(attempt.plan, attempt.directory.recordings)
    except HilError as error:
        message = f"the recording could not be read back: {error.message}"
        return None, RecordingError(message, hint=error.hint)
    except Exception as error:  # the motion is over: whatever this is, its end must be written
        return None, RecordingError(
            f"the recording could not be read back: {error!r}",
            hint="hil recover RUN makes whole what is left of it",
        )
    if not complete.missing:
        return complete, None
    commissioning = "commissioning" in attempt.directory.start
    message = f"the recording lacks measurements: {complete} are whole"
    if slowed := len(complete.slowed):
        message += f"; {slowed} were measured slower than planned and are excluded"
    again = "run the experiment again" if commissioning else f"hil resume {attempt.directory.path}"
    return complete, RecordingError(message, hint=f"measure what is missing: {again}")
