"""What a run directory holds before anything moves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hil.arms import model_sha256
from hil.planning import Experiment, Plan
from hil.recording import (
    Attachment,
    McapWriter,
    Recorder,
    RunDirectory,
    collect_provenance,
    name_of_attempt,
)
from hil.robot import HasTopics, Robot, state_topic
from hil.spec import StationRobot, spec_hash
from hil.workflow.confirmation import loads_document


def write_beginning(
    directory: RunDirectory,
    experiment: Experiment,
    robot: Robot,
    plan: Plan,
    operator: str,
    waivers: Mapping[str, str],
    confirmation: Mapping[str, Any] | None = None,
) -> None:
    """Store what the run starts from: spec, station, plan and start document.

    Args:
        directory: Of the run.
        experiment: What is done, and where.
        robot: Connected.
        plan: What is executed.
        operator: Who is at the robot; empty for the user of this process.
        waivers: Preflight check → why its failure is accepted.
        confirmation: How the motion of a real robot was confirmed; None where it need not be.

    Raises:
        RecordingError: The disk refuses.
    """
    directory.write_text("spec.yaml", experiment.spec_text)
    directory.write_text("station.yaml", experiment.station_text)
    directory.write_json("plan.json", plan.to_dict())
    provenance = collect_provenance(spec_folder=experiment.folder)
    if operator:
        provenance["operator"] = operator
    directory.write_start(
        provenance
        | {
            "experiment": experiment.spec.name,
            "plan_hash": plan.hash,
            "spec_hash": spec_hash(experiment.spec),
            **({"spec": whole(experiment.spec_source)} if experiment.spec_source else {}),
            **({"overrides": dict(experiment.overrides)} if experiment.overrides else {}),
            "station": whole(experiment.station_source),
            "robot_name": experiment.spec.robot,
            "robot": describe_robot(robot, experiment.robot),
            "loads": loads_document(plan.loads),
            "seed": experiment.spec.excitation.seed,
            **_commissioning(experiment),
            **({"occasion": experiment.occasion} if experiment.occasion else {}),
            **({"confirmation": dict(confirmation)} if confirmation else {}),
            "waivers": [
                {"check": check, "reason": reason, "who": provenance["operator"]}
                for check, reason in waivers.items()
            ],
        }
    )


def _commissioning(experiment: Experiment) -> dict[str, Any]:
    given = experiment.commissioning
    return {} if given is None else {"commissioning": given.to_dict()}


def describe_robot(robot: Robot, station_robot: StationRobot) -> dict[str, Any]:
    """What the start document says about the robot."""
    can = robot.capabilities
    digest = model_sha256(station_robot.model)
    return {
        "model": station_robot.model,
        **({"model_sha256": digest} if digest else {}),
        "gravity_m_s2": list(station_robot.gravity_m_s2),
        "identity": asdict(robot.identity),
        "joint_names": list(can.joint_names),
        "rate_hz": can.rate_hz,
        "clock": can.clock,
        "effort_kind": can.effort_kind,
        "drive_gains": list(can.drive_gains),
        "drive_gains_source": can.drive_gains_source,
    }


def open_recorder(
    directory: RunDirectory, attempt: int, robot: Robot, experiment: Experiment
) -> Recorder:
    """The recorder of a new attempt, with what explains the data at the start of the file.

    Raises:
        RecordingError: The file cannot be made.
    """
    can, uid = robot.capabilities, str(directory.start["uid"])
    unit = "A" if can.effort_kind == "current" else "N·m"
    topic = state_topic(len(can.joint_names), can.rate_hz, clock=can.clock, effort_unit=unit)
    names = ["spec.yaml", "station.yaml", "plan.json", "start.json"]
    names += [name_of_attempt("resume.json", attempt)] if attempt else []
    attachments = [
        Attachment(name, _media_type(name), (directory.path / name).read_bytes()) for name in names
    ]

    def open_part(part: int) -> McapWriter:
        about = {"attempt": str(attempt), "part": str(part)}
        return McapWriter(
            directory.part_path(attempt, part),
            [topic, *(robot.topics if isinstance(robot, HasTopics) else ())],
            metadata={"run": {"uid": uid, "name": experiment.spec.name, **about}},
            attachments=attachments,
            joint_names=can.joint_names,
        )

    return Recorder(
        open_part(0),
        next_part=open_part,
        rotate_bytes=experiment.spec.record.rotate_mb * 1e6,
        on_backlog="wait" if can.clock == "virtual" else "raise",
    )


def whole(source: str) -> str:
    """A file as anybody finds it: whoever goes on starts somewhere else, perhaps."""
    return str(Path(source).resolve()) if Path(source).is_file() else source


def _media_type(name: str) -> str:
    return "application/json" if name.endswith(".json") else "application/yaml"
