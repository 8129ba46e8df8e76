"""A small study for tests, and how it is registered for as long as a test takes."""

from __future__ import annotations

import json
import math
import os
import signal
import time
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import numpy as np
import pytest

from hil.core import json_document, plugins
from hil.core.errors import FitError, SpecError
from hil.data.dataset import Dataset
from hil.dynamics import RobotModel
from hil.studies.base import GROUP, Ended, Progress, Study, silent, tell_ended
from hil.studies.figure import Curve, Figure, Panel
from hil.studies.result import Part, StudyResult, Table


class Counted(Study):
    """Counts the series of each kind; can be made to fail, to break down or to be interrupted."""

    study = "counted"

    def __init__(self, *, rounds: int = 3, ending: str = "") -> None:
        if rounds < 1:
            raise SpecError(f"rounds is {rounds}, but must be at least 1")
        self.rounds = rounds
        self.ending = ending

    def run(self, dataset: Dataset, robot: RobotModel, progress: Progress = silent) -> StudyResult:
        """Tables of counts; NaN where a number is not known."""
        for done in range(self.rounds):
            progress("counting", done + 1, self.rounds)
            tell_ended(progress, Ended(done + 1, self.rounds, "a round", 0.5))
        if self.ending == "fails":
            raise FitError("there are too few poses", hint="record more poses")
        if self.ending == "breaks":
            raise ZeroDivisionError("division by zero")
        if self.ending == "ctrl-c":
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)  # the signal comes at once
        kinds = [condition.kind for condition in dataset.conditions]
        rows = tuple((kind, kinds.count(kind), math.nan) for kind in sorted(set(kinds)))
        table = Table("table-1", "Series by kind", ("kind", "series", "share"), rows)
        parts = (
            Part("Counts", "honest", ("One row per kind.",), (table,), (six_panels(),)),
            Part("Counts again", "paper: the counts are among the inputs", (), (table,)),
        )
        told = (f"{robot.name} has {len(kinds)} series, {kinds.count('move')} of them moves.",)
        return StudyResult(self.study, "Counted series", told, parts, warnings=("No share.",))


def six_panels(n: int = 200) -> Figure:
    """Measured and estimated, one panel per joint, with everything a panel may have."""
    x = np.arange(n) / 10.0
    panels = []
    for j in range(6):
        y = np.sin(x + j)
        panels.append(
            Panel(
                f"J{j + 1}",
                "time [s]",
                "current [A]",
                (
                    curve("measured", x, y),
                    curve("estimated", x, y + 0.1, style="points"),
                    Curve("perfect", style="identity"),
                ),
                corner=f"R = 0.99{j}",
            )
        )
    return Figure("fig-7", "Measured and estimated", "Held-out dwells.", tuple(panels), 3)


def bars(names: tuple[str, ...] = ("J1", "J2", "J3")) -> Figure:
    """Two groups of bars with errors, the second with a number that is not known."""
    values = tuple(float(i + 1) for i in range(len(names)))
    curves = (
        Curve("LS", names, values, "bars", tuple(0.1 for _ in names)),
        Curve("WLS", names, (*values[:-1], math.nan), "bars", tuple(0.2 for _ in names)),
    )
    panel = Panel("Parameters", "parameter", "value [A]", curves)
    return Figure("fig-4", "Parameters", "With standard errors.", (panel,), 1)


def curve(name: str, x: Any, y: Any, style: Any = "line") -> Curve:
    """A curve of arrays."""
    return Curve(name, tuple(map(float, x)), tuple(map(float, y)), style)


def result(*figures: Figure, tables: tuple[Table, ...] = (), study: str = "counted") -> StudyResult:
    """A result with one honest part."""
    part = Part("Honest", "honest", ("What it means.",), tables, figures)
    return StudyResult(study, "A study", ("Ours is best.",), (part,), {"epochs": 3})


def assert_figures_survive_json(found: StudyResult) -> None:
    """What is read from `study.json` is what was written; compared as text, where NaN is NaN."""
    again = StudyResult.from_dict(json.loads(json_document(found.to_dict())))
    for before, after in zip(found.parts, again.parts, strict=True):
        for one, other in zip(before.figures, after.figures, strict=True):
            assert repr(other) == repr(one)


def register(monkeypatch: pytest.MonkeyPatch, **studies: str) -> None:
    """Register studies (`counted` by default) beside the plug-ins that are installed."""
    named = studies or {"counted": "tests.support.study_parts:Counted"}
    points = [EntryPoint(name, value, GROUP) for name, value in named.items()]

    def found(*, group: str) -> list[EntryPoint]:
        return points if group == GROUP else list(entry_points(group=group))

    monkeypatch.setattr(plugins, "entry_points", found)
