"""Imported samples as an MCAP file that is as well described as one of our own recordings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hil.core import IntArray, StructArray
from hil.data import sample_rate
from hil.importers.import_map import ImportMap, Window
from hil.importers.load import WINDOW_PAYLOAD
from hil.importers.raw import Raw
from hil.importers.series import TARGET
from hil.recording import McapWriter
from hil.robot import Topic, state_topic, torque_target_topic
from hil.spec import Load

ROBOT_METADATA = "robot"
PAYLOAD_METADATA = "payload"
IMPORT_METADATA = "import"


def robot_metadata(layout: ImportMap) -> dict[str, str]:
    """Whose samples these are, and in which unit; lists as JSON."""
    gains = layout.drive_gains_nm_a
    return {
        "model": layout.robot,
        "joint_names": json.dumps(layout.joint_names),
        "effort_kind": layout.effort_kind,
        "drive_gains": json.dumps(gains) if gains else "",
        "drive_gains_source": layout.drive_gains_source,
        "serial": layout.serial,
    }


def payload_metadata(load: Load) -> dict[str, str]:
    """A load that was mounted."""
    return {
        "mass_kg": repr(load.mass_kg),
        "com_m": json.dumps(load.com_m),
        "inertia_kgm2": json.dumps(load.inertia_kgm2),
    }


def write_recording(
    out: Path,
    samples: Raw,
    segments: IntArray,
    layout: ImportMap,
    origin: Mapping[str, str],
    windows: tuple[Window, ...] = (),
) -> None:
    """Write the MCAP; it appears under its name when it is whole, and not at all otherwise.

    Args:
        out: The file to be made.
        samples: Good rows in SI units.
        segments: (N,) number of the window each row belongs to, −1 outside.
        layout: What was imported.
        origin: Where it came from, for the file's metadata.
        windows: What the segments are; those with a load of their own keep it.

    Raises:
        RecordingError: The file exists already or cannot be written.
    """
    unit = "A" if layout.effort_kind == "current" else "N·m"
    rate = sample_rate(samples.columns["t"])
    topics = [state_topic(layout.n_joints, rate, clock="file", effort_unit=unit)]
    if TARGET in samples.columns:
        topics.append(torque_target_topic(layout.n_joints, rate, clock="file"))
    metadata: dict[str, Mapping[str, str]] = {
        ROBOT_METADATA: robot_metadata(layout),
        PAYLOAD_METADATA: payload_metadata(layout.payload),
        IMPORT_METADATA: origin,
    }
    for number, window in enumerate(windows):
        if window.payload is not None:
            metadata[WINDOW_PAYLOAD.format(number)] = payload_metadata(window.payload)
    writer = McapWriter(out, topics, metadata=metadata, joint_names=layout.joint_names)
    try:
        with writer:
            for topic in topics:
                writer.write(topic.name, _rows(topic, samples, segments))
    except BaseException:
        writer.partial_path.unlink(missing_ok=True)
        raise


def segments_of(rows: IntArray, windows: tuple[Window, ...]) -> IntArray:
    """(N,) index of the window each row (numbered from 1) lies in; −1 outside all of them.

    Without windows, everything is one segment.
    """
    if not windows:
        return np.zeros(len(rows), dtype=np.int64)
    segments = np.full(len(rows), -1, dtype=np.int64)
    for number, window in enumerate(windows):
        first, last = window.span
        segments[(rows >= first) & (rows <= last)] = number
    return segments


def _rows(topic: Topic, samples: Raw, segments: IntArray) -> StructArray:
    block = topic.blank(len(samples))
    block["device_time"] = samples.columns["t"]
    for name, values in (samples.columns | {"segment": segments}).items():
        if name in (topic.dtype.names or ()):
            block[name] = values
    return block
