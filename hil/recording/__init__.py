"""MCAP recording, columnar reading and the run directory."""

from hil.recording.continuity import Counts
from hil.recording.events import EventLog, read_events
from hil.recording.provenance import collect_provenance
from hil.recording.reader import RecordingInfo, TopicInfo, read_info, read_topic
from hil.recording.recorder import Recorder
from hil.recording.rundir import Outcome, RunDirectory, RunStatus
from hil.recording.writer import Attachment, McapWriter
from hil.robot.topic import STATE_TOPIC, Topic, state_topic

__all__ = [
    "STATE_TOPIC",
    "Attachment",
    "Counts",
    "EventLog",
    "McapWriter",
    "Outcome",
    "Recorder",
    "RecordingInfo",
    "RunDirectory",
    "RunStatus",
    "Topic",
    "TopicInfo",
    "collect_provenance",
    "read_events",
    "read_info",
    "read_topic",
    "state_topic",
]
