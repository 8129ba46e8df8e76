"""A fleet's runs, some at a time: one process per robot, and nobody ends another's."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hil.core import HilError, Rejected, RobotError, Stopped, errors, exit_code_of
from hil.estimators import models_below
from hil.evaluation import verdict_word
from hil.maintenance.fleet.workers import Manner, Workers
from hil.models import FleetFolder
from hil.recording import RunDirectory
from hil.workflow import Ended

Document = dict[str, Any]
Tell = Callable[[Ended, int, int], object]
"""Told a robot's end, and the how-manieth of how many it was."""


@dataclass(frozen=True, slots=True)
class FleetReport:
    """What came of a fleet.

    Attributes:
        folder: Of the fleet.
        ended: Every robot that was begun, now or before.
        left: Robots that were not begun.
    """

    folder: Path
    ended: tuple[Ended, ...]
    left: tuple[str, ...]

    @property
    def error(self) -> HilError | None:
        """The worst: a stop, a robot that did not measure all, a missing model, a rejection."""
        stopped = [one.error for one in self.ended if isinstance(one.error, Stopped)]
        early = [one.error for one in self.ended if not one.measured and one.error]
        wrong = [one.error for one in self.ended if one.error]
        if self.left and not stopped:
            stopped = [
                Stopped(
                    f"{len(self.left)} robots were not begun",
                    by_signal=True,
                    hint="hil fleet resume FOLDER goes on with them",
                )
            ]
        bad = [one for one in self.ended if one.word == "rejected"]
        missed = [
            Rejected(
                f"{len(bad)} of {len(self.ended)} models missed their criteria",
                hint="hil fleet report FOLDER shows which and by how much",
            )
        ]
        return next(iter([*stopped, *early, *wrong, *(missed if bad else ())]), None)

    def to_dict(self) -> Document:
        """The contract of `hil fleet run --json`."""
        return {
            "fleet": str(self.folder),
            "robots": [one.to_dict() for one in self.ended],
            "left": list(self.left),
            "exit_code": exit_code_of(self.error) if self.error else 0,
        }


def run_fleet(
    folder: FleetFolder, members: Sequence[Document], manner: Manner, tell: Tell
) -> FleetReport:
    """Run what is left of a fleet.

    What a robot has measured and judged is not done again; a run that ended early is gone on with.
    The first signal stops every arm and begins no other, each further one is passed on: the third
    ends the workers as it would end a run.

    Args:
        folder: Held by this process.
        members: Entries of its document.
        manner: How.
        tell: Told every robot that has ended.
    """
    found = [_as_it_stands(folder, one) for one in members]
    todo = deque(i for i, one in enumerate(found) if not one.measured)
    fleet = Workers(folder, manner)
    with fleet.signals():
        while (todo and not fleet.stopping) or fleet.going:
            while todo and not fleet.stopping and len(fleet.going) < manner.workers:
                i = todo.popleft()
                fleet.begin(i, found[i])
            for i, told in fleet.ended():
                found[i] = _ended(folder, found[i], told)
                folder.write([one.to_dict() for one in found])
                tell(found[i], len(found) - len(todo) - len(fleet.going), len(found))
    begun = [i for i in range(len(found)) if i not in todo or found[i].report]
    return FleetReport(
        folder.path,
        tuple(found[i] for i in begun),
        tuple(found[i].robot for i in todo if i not in begun),
    )


def left_of(folder: FleetFolder, members: Sequence[Document]) -> list[str]:
    """Return the robots without a run; resumed runs keep their own confirmation."""
    return [one["robot"] for one in members if folder.run_of(one["robot"]) is None]


def _as_it_stands(folder: FleetFolder, entry: Document) -> Ended:
    """A robot's entry, or what its newest run says where that is more."""
    told = Ended.from_dict({"experiment": folder.head["name"], **entry})
    run = folder.run_of(told.robot)
    if told.measured or run is None:
        return told
    return replace(told, report=_from_disk(run), error=None)


def _from_disk(run: Path) -> Document:
    """A run's report as far as its directory tells it."""
    directory = RunDirectory.open(run)
    judged = directory.status == "completed" and (run / "verdict.json").is_file()
    page = run / "report.html"
    return {
        "run": str(run),
        "uid": directory.start.get("uid", ""),
        "outcome": directory.status if judged or directory.status != "completed" else "interrupted",
        "verdict": verdict_word(run),
        "models": [str(folder) for folder in models_below(run)],
        "report": str(page) if page.is_file() else None,
    }


def _ended(folder: FleetFolder, before: Ended, told: Document) -> Ended:
    """What a worker has answered; one that died is known by its run."""
    error = _error(told.pop("error", None))
    if not told and (run := folder.run_of(before.robot)) is not None:
        told = _from_disk(run)
    found = Ended(before.experiment, before.robot, told, error)
    died_after_all = isinstance(error, RobotError) and found.measured
    return replace(found, error=None) if died_after_all else found


def _error(told: Document | None) -> HilError | None:
    if told is None:
        return None
    kind = getattr(errors, str(told["kind"]), RobotError)
    error = kind(told["message"], hint=told.get("hint", ""))
    if isinstance(error, Stopped):
        error.by_signal = True
    assert isinstance(error, HilError)
    return error
