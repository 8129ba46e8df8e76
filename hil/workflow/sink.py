"""What the engine writes to: samples to the recorder, events to the log and the recorder."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hil.core import HilError, StructArray
from hil.recording import Counts, Recorder, RunDirectory
from hil.robot import STATE_TOPIC

COUNTED = ("samples", "gaps", "missing", "duplicates", "overruns")


class RunSink:
    """The engine's sink for one attempt.

    Args:
        directory: Of the run; its event log is continued.
        recorder: Of the attempt.
    """

    def __init__(self, directory: RunDirectory, recorder: Recorder) -> None:
        self._log = directory.event_log()
        self._recorder = recorder

    def put(self, rows: StructArray) -> None:
        """See `hil.engine.Sink`."""
        self._recorder.put(STATE_TOPIC, rows)

    def put_topic(self, topic: str, rows: StructArray) -> None:
        """See `hil.engine.Sink`."""
        self._recorder.put(topic, rows)

    def event(self, kind: str, **details: Any) -> None:
        """See `hil.engine.Sink`."""
        self._recorder.put_event(self._log.append(kind, **details))

    def health(self) -> Mapping[str, float]:
        """How the recording is doing, for progress events."""
        counts = self._recorder.counts[STATE_TOPIC]
        told = {name: int(getattr(counts, name)) for name in COUNTED if name != "samples"}
        return told | {"behind_s": self._recorder.behind_s}

    def close(self) -> list[HilError]:
        """Finish recording and log; returns what went wrong in either."""
        problems = []
        for close in (self._recorder.close, self._log.close):
            try:
                close()
            except HilError as error:
                problems.append(error)
        return problems


def counts_of(counts: Counts) -> dict[str, int]:
    """The figures of a recording that stop documents and verdicts use."""
    return {name: int(getattr(counts, name)) for name in COUNTED}


def recorded_span(counts: Counts) -> list[float]:
    """Device time of the first and the last sample [s]; empty where there is none."""
    return [counts.first_time, counts.last_time] if counts.samples else []
