"""The studies of a run: each by itself on the whole recording, its result beside the fits.

Under the loads of a run its models are judged by one of them, `load-validation`. It is made of the
stored models, relative to the run, so that nothing is fitted twice and `hil study` or
`hil validate-loads` make the same one again.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_limits

from hil.core import (
    AnyPath,
    DataError,
    FitError,
    HilError,
    SpecError,
    Throttle,
    cores,
    is_live,
    json_value,
    path_of,
    plugins,
    values_by_name,
)
from hil.dynamics import RobotModel, load_model
from hil.estimators import HONEST, load_model_file
from hil.evaluation import FailedFit
from hil.importers import load_source, serial_of
from hil.recording import RunDirectory
from hil.report import render_report
from hil.spec import Accept, ExperimentSpec, Fourier, StudyEntry, load_spec
from hil.studies import (
    GROUP,
    PROBLEM_FILE,
    STUDIES,
    STUDY_FILE,
    Ended,
    Study,
    StudyResult,
    folder_of,
    mean_of,
    write_problem,
    write_study,
)
from hil.studies import study as made_study

if TYPE_CHECKING:
    from hil.data import Dataset
    from hil.studies import Failed, UnderLoads

EVERY_S = 0.1
"""Progress within one thing that is done is told no more often than this [s]."""

Watch = Callable[[str, str, int, int], None]
"""Told the study, what it is doing, and how many of how many steps of that are done."""


Tell = Callable[[Mapping[str, Any]], None]
"""Told events: `training` at an epoch, `fit_note`, `fitted` at the end of a fit."""

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Studied:
    """What came of the studies of a run.

    Attributes:
        run: The run directory.
        made: Folder of each study that was made, and what it found.
        problems: Name of each study that failed, and why.
    """

    run: Path
    made: tuple[tuple[Path, StudyResult], ...]
    problems: tuple[tuple[str, HilError], ...]

    @property
    def error(self) -> HilError | None:
        """One error for all studies that are missing; the data are at fault only if they alone."""
        if not self.problems:
            return None
        errors = [error for _, error in self.problems]
        kind = DataError if all(isinstance(error, DataError) for error in errors) else FitError
        told = "; ".join(f"the study {name}: {error.message}" for name, error in self.problems)
        hints = list(dict.fromkeys(error.hint for error in errors if error.hint))
        out = kind(told, hint="; ".join(hints) or f"hil study {self.run}")
        out.__cause__ = errors[0]
        return out


def unwatched(name: str, what: str, done: int, total: int) -> None:
    """Studies that nobody watches."""


Told = Callable[[str, Ended], None]
"""Told the study, and which of its fits is done."""


def unheard(name: str, ended: Ended) -> None:
    """Fits that nobody is told of."""


def study(
    run: AnyPath,
    name: str | None = None,
    *,
    parameters: dict[str, Any] | None = None,
    watch: Watch | None = None,
) -> tuple[StudyResult, ...]:
    """Make the studies of a run's spec again, or another one; also refreshes its report.

    Args:
        run: The run directory.
        name: Name in `hil.studies`; by default all that the run's spec names.
        parameters: The study's own parameters, over those in the spec.
        watch: Told the study, what it is doing, and how many of how many steps of that are done.

    Returns:
        What they found, as it was written into the run directory.

    Raises:
        SpecError, PluginError: There is no such study or parameter.
        DataError, FitError: The run does not allow it; studies beside it have been made.
    """
    folder = path_of(run)
    given = values_by_name(parameters, "parameters", "{'seed': 3}")
    found = run_studies(folder, entries_for(folder, name, given), watch or unwatched)
    render_report(folder)
    if found.error is not None:
        raise found.error
    return tuple(result for _, result in found.made)


def entries_for(
    run: Path, name: str | None = None, parameters: Mapping[str, Any] | None = None
) -> tuple[StudyEntry, ...]:
    """The studies to make: those of the run's spec, or one by name.

    Args:
        run: The run directory.
        name: Which study; by default all of the spec.
        parameters: Laid over those the spec gives it.

    Raises:
        DataError: It is no run directory, or still recording.
        SpecError: There is no study in the spec, or several that the parameters could be for.
    """
    RunDirectory.open(run)
    if is_live(run):
        raise DataError(f"{run} is still recording", hint=f"wait for its end: hil watch {run}")
    wanted = [entry for entry in _written(run) if name in (None, entry.study)]
    if name is not None and not wanted:
        wanted = [StudyEntry(study=name)]
    if not wanted:
        known = ", ".join(plugins.names(GROUP)) or "none is installed"
        raise SpecError(
            f"the spec of {run} names no study", hint=f"choose one with --study: {known}"
        )
    if not parameters:
        return tuple(wanted)
    if len(wanted) > 1:
        told = ", ".join(entry.study for entry in wanted)
        raise SpecError(f"the parameters could be for any of {told}", hint="choose with --study")
    (entry,) = wanted
    asked = {**entry.parameters, **parameters}
    spec = _spec(run)
    if entry.study == STUDY and spec is not None:
        asked = as_in_spec(spec, asked)
    return (StudyEntry(study=entry.study, **asked),)


def missing_studies(run: Path, entries: Sequence[StudyEntry]) -> tuple[StudyEntry, ...]:
    """Return the studies with neither a result nor a recorded problem, as after a kill.

    Raises:
        SpecError, PluginError: A study or a parameter does not exist.
    """

    def folder(entry: StudyEntry) -> Path:
        made = made_study(entry.study, **entry.parameters)
        return run / STUDIES / folder_of(entry.study, made.get_params())

    folders = [(entry, folder(entry)) for entry in entries]
    return tuple(
        entry
        for entry, at in folders
        if not ((at / STUDY_FILE).is_file() or (at / PROBLEM_FILE).is_file())
    )


def run_studies(
    run: Path, entries: Sequence[StudyEntry], watch: Watch = unwatched, told: Told = unheard
) -> Studied:
    """Make studies of a run; one that fails leaves the run and the others as they are.

    The recording is read once, moves included. Writes `study/<name>-<digest>/study.json` each, or
    `problem.json` beside it where the run's spec asks for just that study: what somebody tries
    with other parameters is told to them, and is no fault of the run.

    Args:
        run: The run directory.
        entries: Which studies, with their parameters.
        watch: Told how far they are.
        told: Told every fit that is done, of studies that spread theirs.

    Raises:
        SpecError, PluginError: A study or a parameter does not exist; nothing has been done.
        KeyboardInterrupt: As it came; what was made before is kept.
    """
    studies = [(entry, made_study(entry.study, **entry.parameters)) for entry in entries]
    made: list[tuple[Path, StudyResult]] = []
    problems: list[tuple[str, HilError]] = []
    of: tuple[Dataset, RobotModel] | None = None
    for entry, one in studies:
        name = entry.study
        folder = run / STUDIES / folder_of(name, one.get_params())
        try:
            of = of or _loaded(run)
            made.append((folder, _make(one, folder, of, _Throttled(name, watch, told))))
        except HilError as error:
            problems.append((name, error))
            if entry in _written(run):
                write_problem(name, error.message, error.hint, folder)
    return Studied(run, tuple(made), tuple(problems))


def _written(run: Path) -> tuple[StudyEntry, ...]:
    """The studies of the run's spec; a recording of somebody else's program has none."""
    spec = _spec(run)
    return () if spec is None else (*spec.study, *under_loads(run, spec))


def _spec(run: Path) -> ExperimentSpec | None:
    file = run / "spec.yaml"
    return load_spec(file, look_up=False) if file.is_file() else None


def _loaded(run: Path) -> tuple[Dataset, RobotModel]:
    data = load_source(run)
    return data, load_model(data.robot, gravity=data.gravity)


def _make(
    one: Study, folder: Path, of: tuple[Dataset, RobotModel], progress: _Throttled
) -> StudyResult:
    from threadpoolctl import threadpool_limits

    begin = time.perf_counter()
    try:
        with threadpool_limits(_blas_threads()):
            found = one.run(*of, progress)
        seconds = time.perf_counter() - begin
        asked: dict[str, Any] = json_value(one.get_params())
        found = replace(found, study=progress.name, parameters=asked, seconds=seconds)
        if progress.name == STUDY:
            others = of_other_arms(folder.parent.parent, asked.get("models") or ())
            found = replace(found, warnings=(*others, *found.warnings))
        write_study(found, folder)
    except (HilError, OSError):
        raise
    # Studies are plug-ins: whatever one of them raises must not cost the others.
    except Exception as error:
        raise FitError(
            f"{progress.name} broke down: {type(error).__name__}: {error}",
            hint="this is a fault of the study: report it to whoever wrote it",
        ) from error
    return found


def _blas_threads() -> int:
    """As many as there are, but no more than cores: threads beyond those only spin."""
    from threadpoolctl import threadpool_info

    return min(cores(), max((pool["num_threads"] for pool in threadpool_info()), default=1))


class _Throttled:
    """Progress of one study, without the thousands of steps between two looks at a screen."""

    def __init__(self, name: str, watch: Watch, told: Told) -> None:
        self.name, self._watch, self._told = name, watch, told
        self._what, self._often = "", Throttle(EVERY_S)

    def __call__(self, what: str, done: int, total: int) -> None:
        if self._often.due(anyway=what != self._what or done >= total):
            self._what = what
            self._watch(self.name, what, done, total)

    def ended(self, ended: Ended) -> None:
        """A fit that is done: none of them is left out."""
        self._told(self.name, ended)


STUDY = "load-validation"

WHERE = "under loads"
"""What is named where no model could be judged so."""


def under_loads(run: Path, spec: ExperimentSpec) -> tuple[StudyEntry, ...]:
    """What the spec asks to be studied of the run's models; nothing without any.

    Only honest ones: others have seen what they would be judged on.
    """
    if not spec.validation.under_loads:
        return ()
    order = list(dict.fromkeys(fit.estimator for fit in spec.fit))
    found = []
    for file in run.glob("fit/*/evaluation.json"):
        told = json.loads(file.read_text("utf-8"))
        if told.get("protocol") == HONEST and told.get("estimator") in order:
            place = f"fit/{file.parent.name}"
            found.append((order.index(told["estimator"]), place))
    models = [place for _, place in sorted(found)]
    return (StudyEntry(study=STUDY, estimators=[], models=models),) if models else ()


def as_in_spec(spec: ExperimentSpec, given: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of the study, estimators with the settings and motions held out of the spec.

    The same question has one answer, whoever asks it: the spec, or `hil validate-loads -e`.
    """
    known = {fit.estimator: fit.parameters for fit in reversed(spec.fit)}
    asked: dict[str, Any] = dict(given)
    if asked.get("estimators"):
        asked["estimators"] = [
            {"estimator": one, **known[one]} if isinstance(one, str) and known.get(one) else one
            for one in asked["estimators"]
        ]
    if isinstance(spec.excitation, Fourier) and spec.fit:
        held = spec.hold_out.trajectories_of(spec.excitation.trajectories)
        if held:
            asked.setdefault("hold_out", held)
    return asked


def of_other_arms(run: Path, models: Sequence[str]) -> tuple[str, ...]:
    """Of every stored model that was fitted to another individual than the run's, that it was."""
    mine = serial_of(run)
    told = []
    for name in models:
        place = run / name if (run / name).exists() and not Path(name).exists() else Path(name)
        training = load_model_file(place).training_
        if mine and training and training.serial and training.serial != mine:
            told.append(
                f"{name} IS OF ANOTHER ROBOT: it was fitted to serial {training.serial}, this run "
                f"is of {mine}; what differs between the two counts as its error, and tells of "
                "loads what is not so"
            )
    return tuple(told)


def judge_under_loads(
    run: Path, spec: ExperimentSpec, data: Dataset, tell: Tell
) -> tuple[list[Row], list[FailedFit]]:
    """Judge a run's models under its loads, and write the study, or why there is none.

    Returns:
        Rows of the verdict, without any where there is no criterion about loads; and what could
        not be judged so.
    """
    tell({"kind": "stage", "stage": "judging under loads"})
    try:
        found, failed = _studied(run, spec, data, tell)
    except HilError as error:
        return [], [FailedFit(WHERE, error)]
    finally:
        tell({"kind": "study", "study": ""})
    return list(rows_of(spec.accept, found)), [FailedFit(*one) for one in failed]


def _studied(
    run: Path, spec: ExperimentSpec, data: Dataset, tell: Tell
) -> tuple[Sequence[UnderLoads], Sequence[Failed]]:
    from hil.studies import LoadValidation, study

    entries = under_loads(run, spec)
    if not entries:
        raise FitError("there is no honest model to judge", hint=f"hil show {run}")
    made = study(STUDY, **entries[0].parameters)
    assert isinstance(made, LoadValidation)
    folder = run / STUDIES / folder_of(STUDY, made.get_params())

    def progress(what: str, done: int, total: int) -> None:
        tell({"kind": "study", "study": STUDY, "what": what, "done": done, "total": total})

    begin = time.perf_counter()
    try:
        with threadpool_limits(1):
            found, failed = made.found(data, load_model(data.robot, gravity=data.gravity), progress)
        result = made.told(found, failed)
        write_study(replace(result, seconds=time.perf_counter() - begin), folder)
    except HilError as error:
        write_problem(STUDY, error.message, error.hint, folder)
        raise
    return found, failed


def rows_of(accept: Accept, found: Sequence[UnderLoads]) -> Iterator[Row]:
    """Criteria about loads, as rows of a verdict."""
    if (limit := accept.load_error_ratio) is not None:
        for model in found if limit.of == "every" else found[:1]:
            ratio = model.worst(limit.told)[1]
            yield _row(model, "load_error_ratio", _errors(model, limit.told), ratio, limit.max)
    if (most := accept.contradicted_loads) is not None:
        wrong = found[0].contradicted()
        what = f"run ({', '.join(wrong)})" if wrong else "run"
        yield _row(found[0], "contradicted_loads", what, len(wrong), most.max)


def _errors(model: UnderLoads, told: str) -> str:
    """Both errors: a model that is bad on the bare arm has a small ratio too."""
    load, bare = model.worst(told)[0], model.loads[0]
    errors = [mean_of(one.errors[told]) for one, told in ((load, told), (bare, "declared"))]
    return f"{load.case.name} {told}, {errors[0]:.3g} N·m; {bare.case.name}, {errors[1]:.3g} N·m"


def _row(model: UnderLoads, metric: str, what: str, value: float, limit: float) -> Row:
    return {
        "estimator": model.name,
        "metric": metric,
        "per": "run",
        "what": what,
        "value": value if math.isfinite(value) else None,
        "max": limit,
        "unit": "1",
        "passed": bool(value <= limit),
    }
