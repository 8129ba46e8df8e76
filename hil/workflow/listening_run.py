"""A passive recording under way: rows in, segments found, an end that is written down."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import HilError, RobotTimeout, StructArray, exit_code_of
from hil.data import FOUND_FILE, FoundSteps, StayFinder
from hil.engine import SignalWatch
from hil.importers import found_plan
from hil.recording import Recorder, RunDirectory
from hil.robot import STATE_TOPIC, HasTopics, Listens, Robot
from hil.workflow.listened import Listened, Wanted
from hil.workflow.listening_files import open_recorder
from hil.workflow.listening_notes import NOT_USABLE, fit_notes, unusable_notes
from hil.workflow.sink import RunSink, counts_of

STOPPED_FOR_S = 1.0
"""A program that is replaced by another one stops in between, for less than this [s]."""

SILENT_FOR_S = 5.0
"""A robot that has nothing to say for so long is taken to be gone [s]."""

Tell = Callable[[str], object]


class ListeningRun:
    """One recording, from its first row to its stop document."""

    def __init__(
        self,
        directory: RunDirectory,
        wanted: Wanted,
        robot: Robot,
        signals: SignalWatch,
        tell: Tell,
    ) -> None:
        self._directory, self._wanted, self._robot = directory, wanted, robot
        self._signals, self._tell = signals, tell
        self._finder, self._found = StayFinder(), FoundSteps()
        self._first = self._last = float("nan")
        self._began = False
        self._running_at = float("nan")
        self._unusable = 0

    def run(self) -> Listened:
        """Record until the end; whatever ends it is written down."""
        recorder: Recorder | None = None
        sink: RunSink | None = None
        error: HilError | None = None
        reason = ""
        try:
            recorder = open_recorder(self._directory, self._robot, self._wanted)
            sink = RunSink(self._directory, recorder)
            sink.event("listening", robot=self._wanted.robot)
            while not reason:
                self._take(sink)
                reason = self._signals.reason if self._signals.seen else self._over(sink)
        except HilError as problem:
            error, reason = problem, problem.message
        return self._finish(recorder, sink, reason, error)

    def _take(self, sink: RunSink) -> None:
        try:
            rows = self._robot.read(SILENT_FOR_S if not self._signals.seen else 0.1)
        except RobotTimeout:
            if self._signals.seen:
                return
            raise
        if not len(rows):
            return
        self._first = float(rows["device_time"][0]) if math.isnan(self._first) else self._first
        self._last = float(rows["device_time"][-1])
        self._unusable += int(np.count_nonzero(rows["status"] & NOT_USABLE))
        self._put(sink, self._finder.feed(rows))
        if isinstance(self._robot, HasTopics):
            for topic, further in self._robot.drain().items():
                sink.put_topic(topic, further)

    def _put(self, sink: RunSink, rows: StructArray) -> None:
        if len(rows):
            self._found.add(rows)
            sink.put(rows)

    def _over(self, sink: RunSink) -> str:
        """Why the recording is over; empty while it is not."""
        assert isinstance(self._robot, Listens)
        if self._robot.program_running:
            if not self._began:
                self._tell("a program is running")
                sink.event("program", running=True, device_time=self._last)
            self._began, self._running_at = True, self._last
        elif self._began and self._last - self._running_at >= STOPPED_FOR_S:
            self._began = False
            self._tell("the program has stopped")
            sink.event("program", running=False, device_time=self._last)
            if self._wanted.until_program_stops:
                return "the program has stopped"
        for_s = self._wanted.for_s
        if for_s is not None and self._last - self._first >= for_s:
            return f"{for_s:g} s are over"
        return ""

    def _finish(
        self,
        recorder: Recorder | None,
        sink: RunSink | None,
        reason: str,
        error: HilError | None,
    ) -> Listened:
        problems: list[HilError] = []
        if sink is not None:
            held = self._finder.flush()
            if held is not None:
                with contextlib.suppress(HilError):  # closing says what it is
                    self._put(sink, held)
            problems = sink.close()
        error = error or (problems[0] if problems else None)
        steps, found = self._found.steps(), self._found.counts()
        self._write_found(steps)
        counts = counts_of(recorder.counts[STATE_TOPIC]) if recorder else {}
        device_s = self._last - self._first if math.isfinite(self._last) else 0.0
        notes = (
            *_notes(self._wanted, counts),
            *unusable_notes(self._unusable, counts),
            *fit_notes(found, self._directory.start["robot"]),
        )
        document = {
            **counts,
            "steps_done": len(steps),
            "unsettled": [],
            "complete": {kind: {"done": n, "of": n} for kind, n in found.items()},
            "device_s": device_s,
            "exit_code": exit_code_of(error) if error else 0,
            "problems": [*(one.message for one in problems)],
        }
        self._directory.write_stop("failed" if error else "completed", reason, document)
        return Listened(self._directory.path, reason, counts, device_s, found, notes, error)

    def _write_found(self, steps: list[dict[str, Any]]) -> None:
        found = found_plan(
            steps,
            name=self._wanted.name,
            robot=self._directory.start["robot"],
            payload=self._wanted.payload or Payload(),
        )
        with contextlib.suppress(HilError):  # it can be found again from the rows
            self._directory.write_json(FOUND_FILE, found)


def _notes(wanted: Wanted, counts: dict[str, int]) -> tuple[str, ...]:
    notes = []
    if wanted.payload is None:
        notes.append(
            "no load declared: 0 kg assumed; declare one with --payload MASS_KG[,X_M,Y_M,Z_M]"
        )
    if counts.get("missing"):
        notes.append(f"{counts['missing']} samples are missing in {counts['gaps']} gaps")
    return tuple(notes)
