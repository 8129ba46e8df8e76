"""A series: experiments run one after the other, each an ordinary run, and what came of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hil.core import DataError, HilError, Rejected, Source, SpecError, Stopped, errors, exit_code_of
from hil.planning import Experiment
from hil.planning import load as load_experiment
from hil.runs import SeriesFolder
from hil.spec import SeriesSpec, load_series_spec

Document = dict[str, Any]

NOT_OF_THE_RUN = ("experiment", "robot", "error")

Execute = Callable[[Experiment, Document], tuple[Document, HilError | None]]
"""Runs an experiment, or goes on with the run that a document of it tells of; returns the run's
report as JSON has it, and what ended it early or is wrong with its models."""


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


@dataclass(frozen=True, slots=True)
class Ended:
    """One experiment of a series, as far as it came.

    Attributes:
        experiment: Its name.
        robot: Name of its robot.
        report: The run's own report as JSON has it; empty when there is no run directory.
        error: What ended it early, or what is wrong with its models; None when all is well.
    """

    experiment: str
    robot: str
    report: Document
    error: HilError | None = None

    @property
    def measured(self) -> bool:
        """Whether the robot did all it should: the next experiment may move one."""
        return self.report.get("outcome") == "completed" and not isinstance(self.error, Stopped)

    @property
    def word(self) -> str:
        """How it ended, or what its models are worth, in a word or two."""
        outcome = str(self.report.get("outcome", "not run"))
        if not self.measured:
            return outcome if outcome != "completed" else "stopped after the motion"
        return str(self.report.get("verdict"))

    @classmethod
    def from_dict(cls, entry: Document) -> Ended:
        """Inverse of `to_dict`."""
        report = {key: value for key, value in entry.items() if key not in NOT_OF_THE_RUN}
        told = entry.get("error")
        kind = getattr(errors, str(told.get("kind")), HilError) if isinstance(told, dict) else None
        error = kind(str(told.get("message"))) if kind and isinstance(told, dict) else None
        return cls(str(entry.get("experiment")), str(entry.get("robot")), report, error)

    def to_dict(self) -> Document:
        """One entry of `hil run --json` and of `series.json`."""
        error = self.error and {"kind": type(self.error).__name__, "message": self.error.message}
        return {
            "experiment": self.experiment,
            "robot": self.robot,
            **self.report,
            **({"error": error} if error else {}),
        }


@dataclass(frozen=True, slots=True)
class SeriesReport:
    """What came of a series.

    Attributes:
        folder: Where its overview is.
        page: The overview; None if it could not be made.
        ended: The experiments that were begun.
        left: Names of those that were not.
    """

    folder: Path
    page: Path | None
    ended: tuple[Ended, ...]
    left: tuple[str, ...]

    @property
    def error(self) -> HilError | None:
        """The worst: what ended the series, else what is wrong with a model, else a rejection."""
        told = [each.error for each in self.ended if each.error is not None]
        stopped = [each.error for each in self.ended if not each.measured and each.error]
        wrong = [error for error in told if not isinstance(error, Rejected)]
        return next(iter([*stopped, *wrong, *told]), None)

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil run SERIES --json`."""
        return {
            "series": str(self.folder),
            "page": str(self.page) if self.page else None,
            "runs": [each.to_dict() for each in self.ended],
            "left": list(self.left),
            "exit_code": exit_code_of(self.error) if self.error else 0,
        }


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
        told = dict.fromkeys(line for error in problems for line in error.message.splitlines())
        raise SpecError("\n".join(told), hint=problems[0].hint)
    return Series(spec, tuple(experiments), Path(file.name) if isinstance(file, Source) else file)


def run_series(
    series: Series, folder: SeriesFolder, execute: Execute, before: Sequence[Document] = ()
) -> SeriesReport:
    """Run the experiments of a series one after the other, or those that are left of it.

    A run that ends early ends the series: what stopped one motion may well stop the next one, or
    worse. A model that is rejected or cannot be fitted does not.

    Args:
        series: What is to be done.
        folder: Of this series; kept up to date after every run.
        execute: Runs one of them.
        before: What its document tells of an earlier attempt.

    Raises:
        DataError: The file names other experiments than it did then.
    """
    ended = [Ended.from_dict(entry) for entry in before]
    _require_same(series, ended)
    for i, experiment in enumerate(series.experiments):
        if i < len(ended) and ended[i].measured:
            continue
        folder.write([each.to_dict() for each in ended])
        ended[i:] = [_ended(experiment, execute, ended[i].report if i < len(ended) else {})]
        if not ended[i].measured:
            break
    left = tuple(each.spec.name for each in series.experiments[len(ended) :])
    page = folder.write([each.to_dict() for each in ended])
    return SeriesReport(folder.path, page, tuple(ended), left)


def nothing_left(series: Series, before: Sequence[Document]) -> bool:
    """Whether every experiment was run to its end, whatever its models are worth."""
    ended = [Ended.from_dict(entry) for entry in before]
    return len(ended) == len(series.experiments) and all(each.measured for each in ended)


def not_begun(series: Series, before: Sequence[Document]) -> tuple[Experiment, ...]:
    """Return the experiments without a run; resumed runs keep their own confirmation."""
    begun = [i for i, entry in enumerate(before) if Ended.from_dict(entry).report.get("run")]
    return tuple(each for i, each in enumerate(series.experiments) if i not in begun)


def _require_same(series: Series, ended: Sequence[Ended]) -> None:
    now = [each.spec.name for each in series.experiments]
    then = [each.experiment for each in ended]
    if then != now[: len(then)]:
        raise DataError(
            f"{series.source} now begins with {', '.join(now)}, but {', '.join(then)} were run",
            hint=f"begin it anew: hil run {series.source}",
        )


def _ended(experiment: Experiment, execute: Execute, before: Document) -> Ended:
    blank = Ended(experiment.spec.name, experiment.spec.robot, before)
    try:
        report, wrong = execute(experiment, before)
    except HilError as error:
        return replace(blank, error=error)
    except KeyboardInterrupt:  # between two runs; a run itself says what stopped it
        told = Stopped(
            "stopped between two runs of the series",
            by_signal=True,
            hint="hil resume with the folder of the series goes on",
        )
        return replace(blank, error=told)
    return replace(blank, report=report, error=wrong)
