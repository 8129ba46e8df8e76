"""A run once more, from a log of its bus in place of its recording: `hil replay`.

The log says what the wire carried; spec, plan and robot are the run's own. What comes out is a run
directory like any other, which says what it was made from.
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
from hil.spec import StationRobot, load_station
from hil.workflow.recording import counts_of, recorded_span

COPIED_FILES = ("spec.yaml", "station.yaml", "plan.json")
COPIED_FACTS = (
    "experiment", "plan_hash", "spec_hash", "station", "robot_name", "robot", "loads", "seed",
    "commissioning", "waivers",
)  # fmt: skip
"""What the start document of the new run has from the old one."""

AT_MOST_S = 0.5
"""Device time that a log may begin later, or end earlier, than the recording [s]."""


@dataclass(frozen=True, slots=True)
class Replayed:
    """What came of it.

    Attributes:
        run: The new run directory.
        counts: Samples, gaps, … of its recording.
        recorded: The same of the run that the log is of; empty where it has no stop document.
    """

    run: Path
    counts: Mapping[str, int]
    recorded: Mapping[str, int]

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "run": str(self.run),
            "counts": dict(self.counts),
            "recorded": dict(self.recorded),
        }


def replay(source: Path, log: Path, runs: Path) -> Replayed:
    """Make the recording of a run anew from a log of its bus.

    Args:
        source: Run directory.
        log: What was logged on the bus while it ran.
        runs: Where run directories are kept.

    Raises:
        DataError: The run or the log cannot be read, or do not belong together.
        PluginError: The driver's wire does not tell everything.
        RecordingError: The new run directory cannot be written.
    """
    run = RunDirectory.open(source)
    if run.attempts > 1:
        raise DataError(
            f"{source} has {run.attempts} attempts, a log is of one",
            hint="replay logs of runs that were not resumed",
        )
    require_arm_as_recorded(source)
    opened, plan = _opened(run, log), read_plan(run.path / "plan.json")
    directory = RunDirectory.create(
        runs, str(run.start["robot_name"]), _name(run), begin=lambda draft: _begin(draft, run, log)
    )
    stop = run.stop or {}
    with hold_run(directory.path):
        found = _record(directory, opened, _span(stop))
        counts = counts_of(found)
        problem = _finish(directory, plan, found, stop, log)
    if problem is not None:
        raise problem
    recorded = {key: stop[key] for key in counts if isinstance(stop.get(key), int)}
    return Replayed(directory.path, counts, recorded)


def _finish(
    directory: RunDirectory, plan: Plan, found: Counts, stop: Mapping[str, Any], log: Path
) -> DataError | None:
    """Write the end: what is measured is what the rows hold, not what the run has said."""
    complete = completeness_of(plan, directory.recordings)
    problem = _lacking(complete, found, stop, directory.path, log)
    outcome: Outcome = "failed" if problem else stop.get("outcome", "completed")
    reason = problem.message if problem else f"replayed from {log.name}"
    told = {
        **counts_of(found),
        "complete": complete.to_dict(),
        "unsettled": sorted(complete.unsettled),
        "steps_done": stop.get("steps_done", 0),
        "recorded": recorded_span(found),
        "exit_code": problem.exit_code if problem else 0,
    }
    directory.write_stop(outcome, reason, told)
    return problem


def _lacking(
    complete: Completeness, found: Counts, stop: Mapping[str, Any], run: Path, log: Path
) -> DataError | None:
    """Why the log does not hold the run: it measured more than these rows have."""
    said = stop.get("complete") or complete.to_dict()
    has = complete.to_dict()
    lacks = [
        f"{has.get(kind, {}).get('done', 0)} of {n['done']} {kind} steps"
        for kind, n in said.items()
        if has.get(kind, {}).get("done", 0) < n["done"]
    ]
    if _covers(found, stop) and not lacks:
        return None
    what = ", ".join(lacks) or f"{found.samples} samples"
    return DataError(
        f"{log} does not hold all that the run has recorded: {what}; what there is, is in {run}",
        hint="is it the whole log of this very run, from before the drives were set up to the end?",
    )


def _covers(found: Counts, stop: Mapping[str, Any]) -> bool:
    """Whether the rows begin and end where those of the run did; of an old run nobody knows."""
    first, last = stop.get("recorded") or (found.first_time, found.last_time)
    begins, ends = found.first_time <= first + AT_MOST_S, found.last_time >= last - AT_MOST_S
    return bool(found.samples and begins and ends)


def _name(run: RunDirectory) -> str:
    return f"{run.start.get('experiment', 'run')}-replay"


def _opened(run: RunDirectory, log: Path) -> RecordedLog:
    entry = _entry(run)
    driver = plugins.load("hil.drivers", entry.driver)
    if not isinstance(driver, ReadsLogs):
        raise PluginError(
            f"a log of the driver {entry.driver!r}'s wire does not hold what a recording holds",
            hint="hil recover mends torn recordings of any driver",
        )
    return driver.read_log(log, entry.model, entry.options, run.start["robot"])


def _entry(run: RunDirectory) -> StationRobot:
    name = str(run.start.get("robot_name", ""))
    entry = load_station(run.path / "station.yaml").robots.get(name)
    if entry is None:
        raise DataError(
            f"{run.path / 'station.yaml'} has no robot {name!r}",
            hint="the run directory is damaged or was edited: take it from a copy",
        )
    return entry


def _begin(directory: RunDirectory, run: RunDirectory, log: Path) -> None:
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
    """Device time that the run recorded [s]: a log holds what was before and after, too."""
    told = stop.get("recorded") or (-math.inf, math.inf)
    return float(told[0]), float(told[1])


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
