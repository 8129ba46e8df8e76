"""A series: experiments that are run one after the other, each an ordinary run.

A run that ends early ends the series: what stopped one motion may well stop the next one, or worse.
A model that is rejected or cannot be fitted does not. After every run the document of the series is
written anew (`hil.recording.SeriesGroup`), and so is its overview, which `hil.report` makes; a
series that ended early is resumed from them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hil.core import DataError, HilError, Source, SpecError, Stopped, exit_code_of
from hil.planning import Commissioning, Experiment
from hil.planning import load as load_experiment
from hil.recording import Member, SeriesGroup, worst_error
from hil.report import render_series
from hil.spec import SeriesSpec, load_series_spec

Document = dict[str, Any]

Execute = Callable[[Experiment, Document], tuple[Document, HilError | None]]
"""Runs an experiment, or resumes its run; called with the report of that run, empty without one.

Returns the run's report as `hil run --json` has it, and what ended it early or is wrong with its
models."""


@dataclass(frozen=True, slots=True)
class Series:
    """A series bound to the stations its experiments run at.

    Attributes:
        spec: What the file says.
        experiments: In the order they are run in.
        source: The file.
    """

    spec: SeriesSpec
    experiments: tuple[Experiment, ...]
    source: Path

    def create_group(
        self, runs: Path, station: Path | None = None, part: Commissioning | None = None
    ) -> SeriesGroup:
        """Make the folder of the series, which starts now.

        Args:
            runs: Where run directories are kept.
            station: Named in place of those in the files.
            part: What of each experiment is executed, and how fast; None for all of it.
        """
        return SeriesGroup.create(
            runs,
            self.spec.name,
            self.source,
            description=self.spec.description,
            station=station,
            commissioning=part.to_dict() if part else None,
        )

    def is_finished(self, members: Sequence[Member]) -> bool:
        """Return whether every experiment was run to its end, whatever its models are worth."""
        return len(members) == len(self.experiments) and all(each.measured for each in members)

    def without_run(self, members: Sequence[Member]) -> tuple[Experiment, ...]:
        """Return the experiments without a run; resumed runs keep their own confirmation."""
        begun = [i for i, member in enumerate(members) if member.run is not None]
        return tuple(each for i, each in enumerate(self.experiments) if i not in begun)


def load_series(file: Path | Source, station: Path | None = None) -> Series:
    """Read a series, its experiments and their stations.

    Args:
        file: The YAML file, or what was read from it.
        station: In place of every station the files name.

    Raises:
        SpecError: With every problem of all the files.
    """
    spec = load_series_spec(file)
    experiments: list[Experiment] = []
    problems: list[SpecError] = []
    for entry in spec.series:
        named = station or entry.station or spec.station
        try:
            experiments.append(load_experiment(Path(entry.spec), Path(named) if named else None))
        except SpecError as error:
            problems.append(error)
    if problems:
        lines = dict.fromkeys(line for error in problems for line in error.message.splitlines())
        raise SpecError("\n".join(lines), hint=problems[0].hint)
    return Series(spec, tuple(experiments), Path(file.name) if isinstance(file, Source) else file)


def commissioning_of_series(group: SeriesGroup) -> Commissioning | None:
    """Return what of each experiment is executed, and how fast; None for all of it."""
    recorded = group.head.get("commissioning")
    return Commissioning.from_dict(recorded) if recorded else None


@dataclass(frozen=True, slots=True)
class SeriesReport:
    """The result of a series.

    Attributes:
        folder: Where its overview is.
        page: The overview; None if it could not be made.
        members: The experiments that were begun.
        left: Names of those that were not.
    """

    folder: Path
    page: Path | None
    members: tuple[Member, ...]
    left: tuple[str, ...]

    @property
    def error(self) -> HilError | None:
        """The worst: what ended the series, else what is wrong with a model, else a rejection."""
        return worst_error(self.members)

    def to_dict(self) -> dict[str, Any]:
        """Return the contract of `hil run SERIES --json`."""
        return {
            "series": str(self.folder),
            "page": str(self.page) if self.page else None,
            "runs": [each.to_dict() for each in self.members],
            "left": list(self.left),
            "exit_code": exit_code_of(self.error) if self.error else 0,
        }


def run_series(series: Series, group: SeriesGroup, execute: Execute) -> SeriesReport:
    """Run the experiments of a series one after the other, or those that are left of it.

    Args:
        series: What is to be done.
        group: Its folder, held by this process; kept up to date after every run.
        execute: Runs one experiment, or resumes its run.

    Raises:
        DataError: The file names other experiments than those that were run.
    """
    members = group.members()
    _require_same_experiments(series, members)
    for i, experiment in enumerate(series.experiments):
        if i < len(members) and members[i].measured:
            continue
        _write(group, members)
        before = members[i].report if i < len(members) else {}
        members[i:] = [_executed(experiment, execute, before)]
        if not members[i].measured:
            break
    left = tuple(each.spec.name for each in series.experiments[len(members) :])
    return SeriesReport(group.path, _write(group, members), tuple(members), left)


def _require_same_experiments(series: Series, members: Sequence[Member]) -> None:
    now = [each.spec.name for each in series.experiments]
    then = [each.experiment for each in members]
    if then != now[: len(then)]:
        raise DataError(
            f"{series.source} now begins with {', '.join(now)}, but {', '.join(then)} were run",
            hint=f"begin it anew: hil run {series.source}",
        )


def _executed(experiment: Experiment, execute: Execute, before: Document) -> Member:
    blank = Member(experiment.spec.name, experiment.spec.robot, before)
    try:
        report, wrong = execute(experiment, before)
    except HilError as error:
        return replace(blank, error=error)
    except KeyboardInterrupt:  # between two runs; a run itself says what stopped it
        stopped = Stopped(
            "stopped between two runs of the series",
            by_signal=True,
            hint="hil resume with the folder of the series goes on",
        )
        return replace(blank, error=stopped)
    return replace(blank, report=report, error=wrong)


def _write(group: SeriesGroup, members: Sequence[Member]) -> Path | None:
    """Replace document and overview; return None if the latter could not be made."""
    group.write(members)
    try:
        return render_series(group.path)
    except HilError:
        return None
