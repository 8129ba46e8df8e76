"""Replay of a run (`hil replay`): create the recording of the run again from a log of its bus.

The log contains the raw data of the bus; spec, plan and robot of the replay are those of the run. A
replay creates an ordinary run directory, whose start document names the original run and the log.
If the log covers the whole run, the dataset of the replay is bit-identical to the dataset of the
run (decision 0019).
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
    """Result of a replay.

    Attributes:
        run: Directory of the new run.
        counts: Number of samples, gaps and other counts of the new recording.
        recorded: Number of samples and other counts of the original recording; empty if the
            original run has no stop document.
    """

    run: Path
    counts: Mapping[str, int]
    recorded: Mapping[str, int]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON output of `hil replay --json`."""
        return {
            "run": str(self.run),
            "counts": dict(self.counts),
            "recorded": dict(self.recorded),
        }


def replay(source: Path, log: Path, runs: Path) -> Replay:
    """Create the recording of a run again from a log of its bus.

    Args:
        source: Run directory.
        log: File with the bus data that were logged during the run.
        runs: Folder in which the new run directory is created.

    Raises:
        DataError: The run or the log cannot be read, or the log belongs to a different run.
        PluginError: The bus data that the driver decodes lack quantities that a recording needs.
        RecordingError: The directory of the new run cannot be written.
    """
    run = RunDirectory.open(source)
    if run.attempts > 1:
        raise DataError(
            f"{source} has {run.attempts} attempts, but a log contains only one",
            hint="replay the log of a run that was not resumed",
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
    """Return the decoded log of a bus, which the driver of the run's robot decodes.

    Raises:
        DataError: The station of the run does not contain the robot, or the log cannot be read.
        PluginError: The driver of the robot cannot decode logs.
    """
    name = str(run.start.get("robot_name", ""))
    entry = load_station(run.path / "station.yaml").robots.get(name)
    if entry is None:
        raise DataError(
            f"{run.path / 'station.yaml'} has no robot {name!r}",
            hint="the run directory is damaged or was edited: restore it from a copy",
        )
    driver = plugins.load("hil.drivers", entry.driver)
    if not isinstance(driver, ReadsLogs):
        raise PluginError(
            f"a bus log of the driver {entry.driver!r} does not contain all data of a recording",
            hint="repair the damaged recording instead: hil recover RUN",
        )
    return driver.read_log(log, entry.model, entry.options, run.start["robot"])


COPIED_FILES = ("spec.yaml", "station.yaml", "plan.json")
COPIED_FACTS = (
    "experiment", "plan_hash", "spec_hash", "station", "robot_name", "robot", "loads", "seed",
    "commissioning", "waivers",
)  # fmt: skip
"""Keys of the start document that the new run copies from the original run."""


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
    """Return the device times at the start and at the end of the recording [s].

    A complete log begins earlier and ends later than the recording.
    """
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
    """Write the stop document of the replay; return an error if the log lacks parts of the run."""
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
"""Maximum device time by which a log may begin later or end earlier than the recording [s]."""


def _lacking(
    complete: Completeness, counts: Counts, stop: Mapping[str, Any], run: Path, log: Path
) -> DataError | None:
    """Return the error if the run recorded more than the log contains; else None."""
    measured = complete.to_dict()
    lacks = [
        f"{measured.get(kind, {}).get('done', 0)} of {n['done']} {kind} steps"
        for kind, n in (stop.get("complete") or measured).items()
        if measured.get(kind, {}).get("done", 0) < n["done"]
    ]
    # Stop documents of older versions lack the start and end of the recording.
    first, last = stop.get("recorded") or (counts.first_time, counts.last_time)
    begins, ends = counts.first_time <= first + AT_MOST_S, counts.last_time >= last - AT_MOST_S
    if counts.samples and begins and ends and not lacks:
        return None
    what = ", ".join(lacks) or f"{counts.samples} samples"
    return DataError(
        f"{log} contains only a part of the data of the run: {what}; this part is in {run}",
        hint="check that the log belongs to this run, begins before the set-up of the drives, and "
        "reaches to the end",
    )
