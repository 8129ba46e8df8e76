"""What the run directory of a passive recording begins with."""

from __future__ import annotations

from hil.arms import Payload
from hil.recording import Attachment, McapWriter, Recorder, RunDirectory, collect_provenance
from hil.robot import HasTopics, Robot, state_topic
from hil.spec import StationRobot
from hil.workflow.beginning import describe_robot
from hil.workflow.listened import Wanted

ROTATE_BYTES = 1e9


def write_start(
    directory: RunDirectory,
    wanted: Wanted,
    robot: Robot,
    entry: StationRobot,
    station_text: str,
    station_source: str,
) -> None:
    """Store the station and the start document; `passive` tells it from a run.

    Raises:
        RecordingError: The disk refuses.
    """
    directory.write_text("station.yaml", station_text)
    provenance = collect_provenance()
    if wanted.operator:
        provenance["operator"] = wanted.operator
    payload = wanted.payload or Payload()
    directory.write_start(
        provenance
        | {
            "passive": True,
            "experiment": wanted.name,
            "station": station_source,
            "robot_name": wanted.robot,
            "robot": describe_robot(robot, entry),
            "loads": [
                {
                    "mass_kg": payload.mass,
                    "com_m": list(payload.com),
                    "inertia_kgm2": list(payload.inertia),
                    "declared": wanted.payload is not None,
                }
            ],
        }
    )


def open_recorder(directory: RunDirectory, robot: Robot, wanted: Wanted) -> Recorder:
    """The recorder of the robot record and of whatever else the robot tells.

    Raises:
        RecordingError: The file cannot be made.
    """
    can, start = robot.capabilities, directory.start
    unit = "A" if can.effort_kind == "current" else "N·m"
    topics = [
        state_topic(len(can.joint_names), can.rate_hz, clock=can.clock, effort_unit=unit),
        *(robot.topics if isinstance(robot, HasTopics) else ()),
    ]
    text = (directory.path / "start.json").read_bytes()

    def open_part(part: int) -> McapWriter:
        about = {"uid": str(start["uid"]), "name": wanted.name, "attempt": "0", "part": str(part)}
        return McapWriter(
            directory.part_path(0, part),
            topics,
            metadata={"run": about},
            attachments=[Attachment("start.json", "application/json", text)],
            joint_names=can.joint_names,
        )

    return Recorder(
        open_part(0),
        next_part=open_part,
        rotate_bytes=ROTATE_BYTES,
        on_backlog="wait" if can.clock == "virtual" else "raise",
    )
