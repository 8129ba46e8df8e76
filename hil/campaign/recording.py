"""One recorded run: robot, plan, preflight, motion, run directory. No fitting in here."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from hil import plugins
from hil.campaign.experiment import Experiment
from hil.engine import Engine, Observers, RunResult
from hil.engine.engine import Prompt
from hil.engine.interlocks import from_spec
from hil.engine.signals import stop_on_signals
from hil.errors import HilError
from hil.plan.build import build_plan
from hil.plan.plan import Plan
from hil.preflight import preflight_context, require_preflight
from hil.record.provenance import collect_provenance
from hil.record.recorder import Recorder
from hil.record.rundir import RunDirectory
from hil.record.topic import STATE_TOPIC, state_topic
from hil.record.writer import Attachment, McapWriter
from hil.robot import Robot
from hil.spec.load import spec_hash
from hil.spec.station import StationRobot
from hil.typing import FloatArray, StructArray

AT_SET_POINT_RAD = 0.01
NO_WAIVERS: Mapping[str, str] = {}


@dataclass(frozen=True, slots=True)
class Recorded:
    """What the motion left behind.

    Attributes:
        directory: The run directory, complete up to `stop.json`.
        result: How the motion ended.
        counts: `samples`, `gaps`, `missing`, `duplicates`, `overruns` of the robot record.
    """

    directory: RunDirectory
    result: RunResult
    counts: Mapping[str, int]


@runtime_checkable
class Simulated(Protocol):
    """A robot that must be told how it is mounted: a real one feels it."""

    def set_gravity(self, gravity_m_s2: tuple[float, float, float]) -> None:
        """Gravity in the base frame, before `connect`."""


class RunSink:
    """What the engine writes to: samples to the recorder, events to the log and the recorder."""

    def __init__(self, directory: RunDirectory, recorder: Recorder) -> None:
        self._log = directory.event_log()
        self._recorder = recorder

    def put(self, rows: StructArray) -> None:
        """See `hil.engine.Sink`."""
        self._recorder.put(STATE_TOPIC, rows)

    def event(self, kind: str, **details: Any) -> None:
        """See `hil.engine.Sink`."""
        self._recorder.put_event(self._log.append(kind, **details))

    def close(self) -> None:
        """Wait until every event is on the disk."""
        self._log.close()


def open_robot(name: str, station_robot: StationRobot) -> Robot:
    """The driver's robot, not yet connected; a simulated one is mounted as the station says.

    Raises:
        PluginError: There is no such driver, or it does not load.
        SpecError: The driver does not accept the station's options, or they contradict its gravity.
    """
    driver = plugins.load("hil.drivers", station_robot.driver)
    robot: Robot = driver(name, station_robot.model, **station_robot.options)
    if isinstance(robot, Simulated):
        robot.set_gravity(station_robot.gravity_m_s2)
    return robot


@contextlib.contextmanager
def connected(name: str, station_robot: StationRobot) -> Iterator[Robot]:
    """The robot, connected while inside and closed on every way out."""
    robot = open_robot(name, station_robot)
    try:
        robot.connect()
        yield robot
    finally:
        robot.close()


def plan_for(experiment: Experiment, robot: Robot) -> Plan:
    """The plan from where the robot stands now, at the robot's own rate."""
    newest = robot.read()[-1]
    return build_plan(
        experiment.spec,
        experiment.robot,
        start_q=_standing_at(newest),
        rate_hz=robot.capabilities.rate_hz,
    )


def record(
    experiment: Experiment,
    *,
    runs: Path,
    operator: str = "",
    observers: Observers,
    prompt: Prompt,
    waivers: Mapping[str, str] = NO_WAIVERS,
) -> Recorded:
    """Plan, check and execute; leaves a complete run directory however it ends.

    Args:
        experiment: What to do, and where.
        runs: Where run directories are kept.
        operator: Who is at the robot; by default the user of this process.
        observers: Told about progress.
        prompt: Asks the operator; a robot on a virtual clock confirms by itself.
        waivers: Preflight check → why its failure is accepted.

    Raises:
        SpecError, PlanError, PluginError, RobotError: Before a run directory exists.
        RecordingError: The run directory cannot be made.
    """
    with connected(experiment.spec.robot, experiment.robot) as robot:
        observers.publish({"kind": "stage", "stage": "planning"})
        plan = plan_for(experiment, robot)
        directory = RunDirectory.create(runs, experiment.spec.robot, experiment.spec.name)
        _write_beginning(directory, experiment, robot, plan, operator, waivers)
        observers.publish({"kind": "stage", "stage": f"running {plan.name} → {directory.path}"})
        recorder = _recorder(directory, robot, experiment)
        sink = RunSink(directory, recorder)
        engine = Engine(
            plan,
            robot,
            sink,
            interlocks=from_spec(experiment.spec.interlocks),
            observers=observers,
            prompt=_mounts_by_itself if robot.capabilities.clock == "virtual" else prompt,
        )
        with stop_on_signals(engine):
            result = engine.run(_preflight(directory, plan, robot, experiment, tuple(waivers)))
        return _finish(directory, result, recorder, sink)


def _mounts_by_itself(text: str) -> bool:
    """A robot on a virtual clock is a mock: it mounts the declared load when it is told to."""
    return True


def _preflight(
    directory: RunDirectory,
    plan: Plan,
    robot: Robot,
    experiment: Experiment,
    waivers: tuple[str, ...],
) -> Callable[[], None]:
    def check() -> None:
        context = preflight_context(experiment.robot, directory.path, waivers=waivers)
        require_preflight(plan, robot, context, keep=directory.write_json)

    return check


def _finish(
    directory: RunDirectory, result: RunResult, recorder: Recorder, sink: RunSink
) -> Recorded:
    """Close everything, then write the stop document, whatever went wrong in closing."""
    reason, outcome = result.reason, str(result.outcome)
    problems = list(result.notes)
    for close in (recorder.close, sink.close):
        try:
            close()
        except HilError as error:
            problems.append(error.message)
            if not reason:
                outcome, reason = "failed", error.message
    counts = _counts_of(recorder)
    document = {
        **counts,
        "steps_done": result.steps_done,
        "unsettled": list(result.unsettled),
        "device_s": result.device_s,
        "wall_s": result.wall_s,
        "problems": problems,
    }
    directory.write_stop(outcome, reason, document)  # type: ignore[arg-type]
    return Recorded(directory, result, counts)


def _counts_of(recorder: Recorder) -> dict[str, int]:
    counts = recorder.counts[STATE_TOPIC]
    names = ("samples", "gaps", "missing", "duplicates", "overruns")
    return {name: int(getattr(counts, name)) for name in names}


def _write_beginning(
    directory: RunDirectory,
    experiment: Experiment,
    robot: Robot,
    plan: Plan,
    operator: str,
    waivers: Mapping[str, str],
) -> None:
    directory.write_text("spec.yaml", experiment.spec_text)
    directory.write_text("station.yaml", experiment.station_text)
    directory.write_json("plan.json", plan.to_dict())
    provenance = collect_provenance()
    if operator:
        provenance["operator"] = operator
    directory.write_start(
        provenance
        | {
            "experiment": experiment.spec.name,
            "plan_hash": plan.hash,
            "spec_hash": spec_hash(experiment.spec),
            "station": experiment.station_source,
            "robot_name": experiment.spec.robot,
            "robot": _describe(robot, experiment.robot),
            "seed": experiment.spec.excitation.seed,
            "waivers": [
                {"check": check, "reason": reason, "who": provenance["operator"]}
                for check, reason in waivers.items()
            ],
        }
    )


def _describe(robot: Robot, station_robot: StationRobot) -> dict[str, Any]:
    can = robot.capabilities
    return {
        "model": station_robot.model,
        "gravity_m_s2": list(station_robot.gravity_m_s2),
        "identity": asdict(robot.identity),
        "joint_names": list(can.joint_names),
        "rate_hz": can.rate_hz,
        "clock": can.clock,
        "effort_kind": can.effort_kind,
        "drive_gains": list(can.drive_gains),
        "drive_gains_source": can.drive_gains_source,
    }


def _recorder(directory: RunDirectory, robot: Robot, experiment: Experiment) -> Recorder:
    can = robot.capabilities
    unit = "A" if can.effort_kind == "current" else "N·m"
    topic = state_topic(len(can.joint_names), can.rate_hz, clock=can.clock, effort_unit=unit)
    names = ("spec.yaml", "station.yaml", "plan.json", "start.json")
    attachments = [
        Attachment(name, _media_type(name), (directory.path / name).read_bytes()) for name in names
    ]
    writer = McapWriter(
        directory.next_recording(),
        [topic],
        metadata={"run": {"uid": str(directory.start["uid"]), "name": experiment.spec.name}},
        attachments=attachments,
        joint_names=can.joint_names,
    )
    return Recorder(writer, on_backlog="wait" if can.clock == "virtual" else "raise")


def _media_type(name: str) -> str:
    return "application/json" if name.endswith(".json") else "application/yaml"


def _standing_at(row: np.void) -> FloatArray:
    """The set-point the robot holds, or where it is when it holds none that makes sense."""
    q, target = np.array(row["q"]), np.array(row["q_target"])
    holds = np.abs(q - target) < AT_SET_POINT_RAD
    return np.where(holds, target, q)
