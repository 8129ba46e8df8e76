"""How much device time recordings cover, from their first and last samples alone."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby
from pathlib import Path

import numpy as np

from hil.core import DataError, FloatArray
from hil.recording.chunks import rows_at
from hil.recording.mcap_records import Torn
from hil.recording.recording import Recording
from hil.recording.recording_files import attempt_of
from hil.robot import STATE_TOPIC


def recorded_s(recordings: Iterable[Path]) -> float:
    """Device time from the first to the last sample of every attempt, added up [s].

    Args:
        recordings: `RunDirectory.recordings`; what cannot be read counts nothing.
    """
    total = 0.0
    for _, files in groupby(recordings, attempt_of):
        spans = [span for file in files if (span := _span(file)) is not None]
        covered = spans[-1][1] - spans[0][0] if spans else 0.0
        total += covered if 0 < covered < np.inf else 0.0
    return total


def _span(path: Path) -> tuple[float, float] | None:
    """Device time of the first and the last sample [s]; None where none is whole."""
    try:
        with path.open("rb") as file:
            recording = Recording(file, path)
            ends = [_first(recording, units) for units in (recording.units, recording.units[::-1])]
    except (DataError, OSError):
        return None
    first, last = ends
    return None if first is None or last is None else (float(first[0]), float(last[-1]))


def _first(recording: Recording, units: Iterable[int]) -> FloatArray | None:
    """The device times in the first of these units that has any."""
    channels = recording.channels_of(STATE_TOPIC)
    dtype = recording.dtype_of(channels[0])
    if "device_time" not in (dtype.names or ()):  # another tool's topic of the same name
        return None
    of_topic = np.zeros(1 << 16, np.bool_)
    of_topic[[channel.id for channel in channels]] = True
    for unit in units:
        try:
            content = recording.content(unit)
            recording.distrust_index(unit)
            offsets = np.sort(recording.offsets(unit, of_topic))
            if len(offsets):
                rows = rows_at(content, offsets, of_topic, dtype).view(dtype)
                times: FloatArray = rows["device_time"]
                return times
        except Torn:
            continue
    return None
