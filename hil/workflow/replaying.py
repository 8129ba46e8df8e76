"""Replay of a run (`hil replay`): its recording is made again from a log of its bus.

The log has what the wire carried; spec, plan and robot are the run's own. The result is a run
directory like any other, whose start document names the run and the log. Its dataset is equal to
the run's to the last bit, if the log contains the whole run (decision 0019).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import DataError, HilError, PluginError, StructArray, hold_run, plugins, sha256_of
from hil.importers import Completeness, completeness_of, require_arm_as_recorded
from hil.planning import Plan, read_plan
from hil.recording import (
    Attachment,
    Counts,
    McapWriter,
    Outcome,
    Recorder,
    RunDirectory,
    collect_provenance,
)
from hil.robot import STATE_TOPIC, ReadsLogs, RecordedLog, state_topic
from hil.spec import load_station
from hil.workflow.recording import counts_of, recorded_span


@dataclass(frozen=True, slots=True)
class Replay:
    """The result of a replay.

    Attributes:
        run: The new run directory.
        counts: Samples, gaps, … of its recording.
        recorded: The same of the original run; empty if that has no stop document.
    """

    run: Path
    counts: Mapping[str, int]
    recorded: Mapping[str, int]

    def to_dict(self) -> dict[str, Any]:
        """Return the contract of `hil replay --json`."""
        return {
            "run": str(self.run),
            "counts": dict(self.counts),
            "recorded": dict(self.recorded),
        }


def replay(source: Path, log: Path, runs: Path) -> Replay:
    """Make the recording of a run again, from a log of its bus.

    Args:
        source: Run directory.
        log: Log of the bus during the run.
        runs: Where run directories are kept.

    Raises:
        DataError: The run or the log cannot be read, or do not belong together.
        PluginError: The driver's wire does not carry everything that a recording has.
        RecordingError: The new run directory cannot be written.
    """
    run = RunDirectory.open(source)
    if run.attempts > 1:
        raise DataError(
            f"{source} has {run.attempts} attempts, a log is of one",
            hint="replay logs of runs that were not resumed",
        )
    require_arm_as_recorded(source)
    decoded, plan = _decoded(log, run), read_plan(run.path / "plan.json")
    robot, name = str(run.start["robot_name"]), f"{run.start.get('experiment', 'run')}-replay"
    directory = RunDirectory.create(
        runs, robot, name, begin=lambda draft: _write_beginning(draft, run, log)
    )
    stop = run.stop or {}
    with hold_run(directory.path):
        counts = _record(directory, decoded, _span(stop))
        problem = _finish(directory, plan, counts, stop, log)
    if problem is not None:
        raise problem
    numbers = counts_of(counts)
    recorded = {key: stop[key] for key in numbers if isinstance(stop.get(key), int)}
    return Replay(directory.path, numbers, recorded)


def _decoded(log: Path, run: RunDirectory) -> RecordedLog:
    """Return a log as the driver of the run's robot decodes it.

    Raises:
        DataError: The station of the run has no such robot, or the log cannot be read.
        PluginError: The driver cannot decode logs.
    """
    name = str(run.start.get("robot_name", ""))
    entry = load_station(run.path / "station.yaml").robots.get(name)
    if entry is None:
        raise DataError(
            f"{run.path / 'station.yaml'} has no robot {name!r}",
            hint="the run directory is damaged or was edited: take it from a copy",
        )
    driver = plugins.load("hil.drivers", entry.driver)
    if not isinstance(driver, ReadsLogs):
        raise PluginError(
            f"a log of the driver {entry.driver!r}'s wire does not hold what a recording holds",
            hint="hil recover mends torn recordings of any driver",
        )
    return driver.read_log(log, entry.model, entry.options, run.start["robot"])


COPIED_FILES = ("spec.yaml", "station.yaml", "plan.json")
COPIED_FACTS = (
    "experiment", "plan_hash", "spec_hash", "station", "robot_name", "robot", "loads", "seed",
    "commissioning", "waivers",
)  # fmt: skip
"""What the new run has of the old one: files, and keys of the start document."""


def _write_beginning(directory: RunDirectory, run: RunDirectory, log: Path) -> None:
    for name in COPIED_FILES:
        if (run.path / name).exists():
            directory.write_text(name, (run.path / name).read_text("utf-8"))
    start = run.start
    directory.write_start(
        collect_provenance()
        | {key: start[key] for key in COPIED_FACTS if key in start}
        | {"replayed": {"of": start.get("uid"), "log": log.name, "sha256": sha256_of(log)}}
    )


def _span(stop: Mapping[str, Any]) -> tuple[float, float]:
    """Return the device time of the run's recording [s]; the log begins earlier and ends later."""
    first, last = stop.get("recorded") or (-math.inf, math.inf)
    return float(first), float(last)


def _record(directory: RunDirectory, log: RecordedLog, span: tuple[float, float]) -> Counts:
    recorder = _recorder(directory, log)
    try:
        for rows, further in log.blocks():
            recorder.put(STATE_TOPIC, _within(rows, span))
            for topic, more in further.items():
                recorder.put(topic, _within(more, span))
    except HilError:
        recorder.close()
        directory.write_stop("failed", "the log could not be read to its end")
        raise
    recorder.close()
    return recorder.counts[STATE_TOPIC]


def _within(rows: StructArray, span: tuple[float, float]) -> StructArray:
    at = rows["device_time"]
    return np.asarray(rows[(at >= span[0]) & (at <= span[1])])


def _recorder(directory: RunDirectory, log: RecordedLog) -> Recorder:
    start = directory.start
    robot, names = start["robot"], ("spec.yaml", "station.yaml", "plan.json", "start.json")
    unit = "A" if robot["effort_kind"] == "current" else "N·m"
    joints = tuple(robot["joint_names"])
    state = state_topic(len(joints), robot["rate_hz"], clock=robot["clock"], effort_unit=unit)
    attachments = [
        Attachment(name, f"application/{name.rpartition('.')[2]}", file.read_bytes())
        for name in names
        if (file := directory.path / name).exists()
    ]
    about = {"uid": str(start["uid"]), "name": str(start.get("experiment", "")), "attempt": "0"}
    writer = McapWriter(
        directory.part_path(0, 0),
        [state, *log.topics],
        metadata={"run": about | {"part": "0"}},
        attachments=attachments,
        joint_names=joints,
    )
    return Recorder(writer, on_backlog="wait")


def _finish(
    directory: RunDirectory, plan: Plan, counts: Counts, stop: Mapping[str, Any], log: Path
) -> DataError | None:
    """Write the stop document, with what the rows contain; return what they lack of the run."""
    complete = completeness_of(plan, directory.recordings)
    problem = _lacking(complete, counts, stop, directory.path, log)
    outcome: Outcome = "failed" if problem else stop.get("outcome", "completed")
    reason = problem.message if problem else f"replayed from {log.name}"
    document = {
        **counts_of(counts),
        "complete": complete.to_dict(),
        "unsettled": sorted(complete.unsettled),
        "steps_done": stop.get("steps_done", 0),
        "recorded": recorded_span(counts),
        "exit_code": problem.exit_code if problem else 0,
    }
    directory.write_stop(outcome, reason, document)
    return problem


AT_MOST_S = 0.5
"""Device time that a log may begin later, or end earlier, than the recording [s]."""


def _lacking(
    complete: Completeness, counts: Counts, stop: Mapping[str, Any], run: Path, log: Path
) -> DataError | None:
    """Return the error if the run measured more than the log contains; else None."""
    measured = complete.to_dict()
    lacks = [
        f"{measured.get(kind, {}).get('done', 0)} of {n['done']} {kind} steps"
        for kind, n in (stop.get("complete") or measured).items()
        if measured.get(kind, {}).get("done", 0) < n["done"]
    ]
    # Stop documents of older versions do not say when the recording began and ended.
    first, last = stop.get("recorded") or (counts.first_time, counts.last_time)
    begins, ends = counts.first_time <= first + AT_MOST_S, counts.last_time >= last - AT_MOST_S
    if counts.samples and begins and ends and not lacks:
        return None
    what = ", ".join(lacks) or f"{counts.samples} samples"
    return DataError(
        f"{log} does not hold all that the run has recorded: {what}; what there is, is in {run}",
        hint="is it the whole log of this very run, from before the drives were set up to the end?",
    )
