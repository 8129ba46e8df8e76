"""An experiment run by many robots of one station, some at a time.

Every robot's run is made by a worker process of its own (`fleet_workers`). What a robot has
measured and judged is not done again; a run that ended early is continued. The folder's document
is written anew after every robot, and where it says less than the runs themselves (this process
was killed), the runs count.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hil.core import HilError, Rejected, RobotError, Stopped, exit_code_of
from hil.estimators import models_below
from hil.evaluation import verdict_word
from hil.maintenance.fleet_workers import Document, Manner, Workers, error_of
from hil.models import FleetFolder
from hil.recording import RunDirectory
from hil.workflow import Ended


@dataclass(frozen=True, slots=True)
class FleetReport:
    """The result of a fleet run.

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


OnEnd = Callable[[Ended, int, int], object]
"""Called with a robot's end, how many have ended, and how many robots there are."""


def run_fleet(
    folder: FleetFolder, members: Sequence[Document], manner: Manner, tell: OnEnd
) -> FleetReport:
    """Run what is left of a fleet.

    Args:
        folder: Held by this process.
        members: Entries of its document.
        manner: How runs are made.
        tell: Called with every robot that has ended.
    """
    entries = [_entry_with_newest_run(folder, one) for one in members]
    todo = deque(i for i, one in enumerate(entries) if not one.measured)
    fleet = Workers(folder, manner)
    with fleet.signals():
        while (todo and not fleet.stopping) or fleet.going:
            while todo and not fleet.stopping and len(fleet.going) < manner.workers:
                i = todo.popleft()
                fleet.begin(i, entries[i])
            for i, answer in fleet.ended():
                entries[i] = _entry_after_worker(folder, entries[i], answer)
                folder.write([one.to_dict() for one in entries])
                tell(entries[i], len(entries) - len(todo) - len(fleet.going), len(entries))
    begun = [i for i in range(len(entries)) if i not in todo or entries[i].report]
    return FleetReport(
        folder.path,
        tuple(entries[i] for i in begun),
        tuple(entries[i].robot for i in todo if i not in begun),
    )


def _entry_with_newest_run(folder: FleetFolder, entry: Document) -> Ended:
    """A robot's entry, or what its newest run says where that is more."""
    known = Ended.from_dict({"experiment": folder.head["name"], **entry})
    run = folder.run_of(known.robot)
    if known.measured or run is None:
        return known
    return replace(known, report=_report_from_disk(run), error=None)


def _report_from_disk(run: Path) -> Document:
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


def _entry_after_worker(folder: FleetFolder, before: Ended, answer: Document) -> Ended:
    """A robot's entry by its worker's answer; of a worker that died, by its run."""
    error = error_of(answer)
    report = {key: value for key, value in answer.items() if key != "error"}
    if not report and (run := folder.run_of(before.robot)) is not None:
        report = _report_from_disk(run)
    after = Ended(before.experiment, before.robot, report, error)
    died_after_all = isinstance(error, RobotError) and after.measured
    return replace(after, error=None) if died_after_all else after


def robots_left(folder: FleetFolder, members: Sequence[Document]) -> list[str]:
    """Return the robots without a run; resumed runs keep their own confirmation."""
    return [one["robot"] for one in members if folder.run_of(one["robot"]) is None]
