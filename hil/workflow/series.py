"""Series of experiments, which are ordinary runs executed in sequence.

A run that ends early ends the series, because the cause possibly stops or endangers the next
motion, too. A model that is rejected or cannot be fitted does not end the series. After every run,
the document of the series (`hil.recording.SeriesGroup`) and its overview page (`hil.report`) are
rewritten. A series that ended early is resumed from its document.
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
"""Function that runs an experiment or resumes its run.

The second argument of the function is the report of the earlier run; empty if there is none. The
return value is the report of the run in the format of `hil run --json`, and the error that ended
the run early or concerns its models.
"""


@dataclass(frozen=True, slots=True)
class Series:
    """Series of experiments, each with its station.

    Attributes:
        spec: Validated content of the series file.
        experiments: List of the experiments in the order of execution.
        source: Path of the series file.
    """

    spec: SeriesSpec
    experiments: tuple[Experiment, ...]
    source: Path

    def create_group(
        self, runs: Path, station: Path | None = None, part: Commissioning | None = None
    ) -> SeriesGroup:
        """Create the folder of a series and record the start of the series.

        Args:
            runs: Folder in which the run directories are created.
            station: Path of a station file that replaces the stations named in the files.
            part: Executed part of each experiment and its speed; None for complete experiments.
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
        """Return whether every experiment of the series ran to its end, whatever its verdict."""
        return len(members) == len(self.experiments) and all(each.measured for each in members)

    def without_run(self, members: Sequence[Member]) -> tuple[Experiment, ...]:
        """Return the experiments without a run; resumed runs retain their earlier confirmation."""
        begun = [i for i, member in enumerate(members) if member.run is not None]
        return tuple(each for i, each in enumerate(self.experiments) if i not in begun)


def load_series(file: Path | Source, station: Path | None = None) -> Series:
    """Read a series, its experiments and their stations.

    Args:
        file: YAML file of the series, or the source that was read from this file.
        station: Path of a station file that replaces every station named in the files.

    Raises:
        SpecError: At least one file has problems; the message lists the problems of all files.
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
    """Return the executed part of each experiment and its speed; None for complete experiments."""
    recorded = group.head.get("commissioning")
    return Commissioning.from_dict(recorded) if recorded else None


@dataclass(frozen=True, slots=True)
class SeriesReport:
    """Result of a series.

    Attributes:
        folder: Folder of the series, which contains the overview page.
        page: Path of the overview page; None if the page could not be written.
        members: Experiments of the series that were started.
        left: Names of the experiments that were not started.
    """

    folder: Path
    page: Path | None
    members: tuple[Member, ...]
    left: tuple[str, ...]

    @property
    def error(self) -> HilError | None:
        """Most severe error of the series: its final error, a model error, or a rejection."""
        return worst_error(self.members)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON output of `hil run SERIES --json`."""
        return {
            "series": str(self.folder),
            "page": str(self.page) if self.page else None,
            "runs": [each.to_dict() for each in self.members],
            "left": list(self.left),
            "exit_code": exit_code_of(self.error) if self.error else 0,
        }


def run_series(series: Series, group: SeriesGroup, execute: Execute) -> SeriesReport:
    """Run the experiments of a series in sequence, or only those that remain.

    Args:
        series: Series whose experiments are run.
        group: Folder of the series, which this process has locked; updated after every run.
        execute: Function that runs one experiment, or resumes the run of the experiment.

    Raises:
        DataError: The series file names other experiments than those that were already run.
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
            hint=f"start a new series: hil run {series.source}",
        )


def _executed(experiment: Experiment, execute: Execute, before: Document) -> Member:
    blank = Member(experiment.spec.name, experiment.spec.robot, before)
    try:
        report, wrong = execute(experiment, before)
    except HilError as error:
        return replace(blank, error=error)
    except KeyboardInterrupt:  # between two runs; a run handles this error itself
        stopped = Stopped(
            "stopped between two runs of the series",
            by_signal=True,
            hint="continue with: hil resume FOLDER_OF_THE_SERIES",
        )
        return replace(blank, error=stopped)
    return replace(blank, report=report, error=wrong)


def _write(group: SeriesGroup, members: Sequence[Member]) -> Path | None:
    """Rewrite document and overview page of a series; return None if the page is not written."""
    group.write(members)
    try:
        return render_series(group.path)
    except HilError:
        return None
