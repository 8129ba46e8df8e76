"""MCAP recording, columnar reading and the run directory."""

from hil.record.continuity import Counts
from hil.record.events import EventLog, read_events
from hil.record.provenance import collect_provenance
from hil.record.reader import RecordingInfo, TopicInfo, read_info, read_topic
from hil.record.recorder import Recorder
from hil.record.rundir import Outcome, RunDirectory, RunStatus
from hil.record.writer import Attachment, McapWriter
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
