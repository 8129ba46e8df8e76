"""Studies of a run: each study uses the whole recording and stores its result beside the fits.

The study `load-validation` evaluates the models of a run with the loads of the run
(`judge_under_loads`). The load validation uses the stored models, by paths relative to the run.
Because the load validation uses stored models, no model is fitted twice, and `hil study` and `hil
validate-loads` reproduce the same study.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_info, threadpool_limits

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
    LoadValidation,
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

Watch = Callable[[str, str, int, int], None]
"""Callback that receives the name of a study, its present activity, and the numbers of completed
and total steps."""

OnFitEnd = Callable[[str, Ended], None]
"""Callback that receives the name of a study and the fit of the study that has ended."""

Tell = Callable[[Mapping[str, Any]], None]
"""Callback that receives events: `training` at an epoch, `fit_note`, and `fitted` at the end of
a fit."""

Row = dict[str, Any]
"""Row of a verdict, as a JSON object."""


def unwatched(name: str, what: str, done: int, total: int) -> None:
    """Ignore the progress of the studies."""


def unheard(name: str, ended: Ended) -> None:
    """Ignore the ends of fits within studies."""


@dataclass(frozen=True, slots=True)
class StudiesReport:
    """Result of the studies of a run.

    Attributes:
        run: Run directory.
        made: Folder and result of each completed study.
        problems: Name and error of each study that failed.
    """

    run: Path
    made: tuple[tuple[Path, StudyResult], ...]
    problems: tuple[tuple[str, HilError], ...]

    @property
    def error(self) -> HilError | None:
        """Combined error of all failed studies; None if no study failed.

        The combined error is a `DataError` if all errors are data errors, else a `FitError`.
        """
        if not self.problems:
            return None
        errors = [error for _, error in self.problems]
        kind = DataError if all(isinstance(error, DataError) for error in errors) else FitError
        message = "; ".join(f"the study {name}: {error.message}" for name, error in self.problems)
        hints = list(dict.fromkeys(error.hint for error in errors if error.hint))
        error = kind(message, hint="; ".join(hints) or f"hil study {self.run}")
        error.__cause__ = errors[0]
        return error


def study(
    run: AnyPath,
    name: str | None = None,
    *,
    parameters: dict[str, Any] | None = None,
    watch: Watch | None = None,
) -> tuple[StudyResult, ...]:
    """Run the studies of a run's spec again, or run a different study, and rewrite the report.

    Args:
        run: Run directory.
        name: Name of a study in `hil.studies`; by default all studies in the run's spec.
        parameters: Parameters of the study, which override the parameters in the spec.
        watch: Callback that receives the study, its present activity, and the numbers of completed
            and total steps.

    Returns:
        Results of the studies, as written into the run directory.

    Raises:
        SpecError, PluginError: The study or a parameter does not exist.
        DataError, FitError: A study is not possible with this run; all other studies are complete.
    """
    folder = path_of(run)
    own = values_by_name(parameters, "parameters", "{'seed': 3}")
    report = run_studies(folder, entries_for(folder, name, own), watch or unwatched)
    render_report(folder)
    if report.error is not None:
        raise report.error
    return tuple(result for _, result in report.made)


def entries_for(
    run: Path, name: str | None = None, parameters: Mapping[str, Any] | None = None
) -> tuple[StudyEntry, ...]:
    """Return the studies to run: all studies of the run's spec, or one study by name.

    Args:
        run: Run directory.
        name: Name of the study; by default all studies of the spec.
        parameters: Parameters of the study, which override the parameters in the spec.

    Raises:
        DataError: The path is not a run directory, or the run is still recording.
        SpecError: The spec names no study, or several studies accept the parameters.
    """
    RunDirectory.open(run)
    if is_live(run):
        raise DataError(
            f"{run} is still recording", hint=f"wait until the run ends: hil watch {run}"
        )
    entries = [entry for entry in _entries_of_spec(run) if name in (None, entry.study)]
    if name is not None and not entries:
        entries = [StudyEntry(study=name)]
    if not entries:
        known = ", ".join(plugins.names(GROUP)) or "none is installed"
        raise SpecError(
            f"the spec of {run} names no study", hint=f"choose one with --study: {known}"
        )
    if not parameters:
        return tuple(entries)
    if len(entries) > 1:
        names = ", ".join(entry.study for entry in entries)
        raise SpecError(
            f"the parameters could belong to any of the studies {names}",
            hint="choose one of them with --study",
        )
    (entry,) = entries
    values = {**entry.parameters, **parameters}
    spec = _spec(run)
    if entry.study == STUDY and spec is not None:
        values = as_in_spec(spec, values)
    return (StudyEntry(study=entry.study, **values),)


def missing_studies(run: Path, entries: Sequence[StudyEntry]) -> tuple[StudyEntry, ...]:
    """Return the studies with neither a result nor a recorded problem, for example after a kill.

    Raises:
        SpecError, PluginError: A study or a parameter does not exist.
    """

    def folder(entry: StudyEntry) -> Path:
        parameters = made_study(entry.study, **entry.parameters).get_params()
        return run / STUDIES / folder_of(entry.study, parameters)

    folders = [(entry, folder(entry)) for entry in entries]
    return tuple(
        entry
        for entry, at in folders
        if not ((at / STUDY_FILE).is_file() or (at / PROBLEM_FILE).is_file())
    )


def run_studies(
    run: Path,
    entries: Sequence[StudyEntry],
    watch: Watch = unwatched,
    on_fit_end: OnFitEnd = unheard,
) -> StudiesReport:
    """Run studies of a run; a failed study affects neither the run nor the other studies.

    The recording of the run, including its moves, is read only one time. Each study writes
    `study/<name>-<digest>/study.json`. A failed study writes `problem.json` instead of `study.json`
    if the run's spec contains the study with the same parameters. If the parameters differ from the
    spec, only the caller receives the error, because it is not a problem of the run.

    Args:
        run: Run directory.
        entries: Studies to run, each with its parameters.
        watch: Callback that receives the progress of the studies.
        on_fit_end: Callback that receives every completed fit of a study that fits in worker
            processes.

    Raises:
        SpecError, PluginError: A study or a parameter does not exist; none of the studies was run.
        KeyboardInterrupt: The user interrupted the studies; the results of completed studies remain
            stored.
    """
    studies = [(entry, made_study(entry.study, **entry.parameters)) for entry in entries]
    made: list[tuple[Path, StudyResult]] = []
    problems: list[tuple[str, HilError]] = []
    loaded: tuple[Dataset, RobotModel] | None = None
    for entry, one in studies:
        name = entry.study
        folder = run / STUDIES / folder_of(name, one.get_params())
        try:
            if loaded is None:
                data = load_source(run)
                loaded = data, load_model(data.robot, gravity=data.gravity)
            progress = _Throttled(name, watch, on_fit_end)
            made.append((folder, _make(one, folder, loaded, progress)))
        except HilError as error:
            problems.append((name, error))
            if entry in _entries_of_spec(run):
                write_problem(name, error.message, error.hint, folder)
    return StudiesReport(run, tuple(made), tuple(problems))


def _entries_of_spec(run: Path) -> tuple[StudyEntry, ...]:
    """Return the studies in the run's spec; an empty list for a passive recording."""
    spec = _spec(run)
    return () if spec is None else (*spec.study, *under_loads(run, spec))


def _spec(run: Path) -> ExperimentSpec | None:
    file = run / "spec.yaml"
    return load_spec(file, look_up=False) if file.is_file() else None


def _make(
    one: Study, folder: Path, loaded: tuple[Dataset, RobotModel], progress: _Throttled
) -> StudyResult:
    begin = time.perf_counter()
    try:
        with threadpool_limits(_blas_threads()):
            result = one.run(*loaded, progress)
        seconds = time.perf_counter() - begin
        parameters: dict[str, Any] = json_value(one.get_params())
        result = replace(result, study=progress.name, parameters=parameters, seconds=seconds)
        if progress.name == STUDY:
            others = of_other_arms(folder.parent.parent, parameters.get("models") or ())
            result = replace(result, warnings=(*others, *result.warnings))
        write_study(result, folder)
    except (HilError, OSError):
        raise
    # Studies are plug-ins: an error of one must not prevent the others.
    except Exception as error:
        raise FitError(
            f"{progress.name} failed: {type(error).__name__}: {error}",
            hint="the study has a bug: report it to its author",
        ) from error
    return result


def _blas_threads() -> int:
    """Return the number of BLAS threads of this process, at most the number of cores."""
    return min(cores(), max((pool["num_threads"] for pool in threadpool_info()), default=1))


EVERY_S = 0.1
"""Minimum time between two progress callbacks within one activity of a study [s]."""


class _Throttled:
    """Progress of one study, reported at most at the rate that a screen can show."""

    def __init__(self, name: str, watch: Watch, on_fit_end: OnFitEnd) -> None:
        self.name, self._watch, self._on_fit_end = name, watch, on_fit_end
        self._what, self._often = "", Throttle(EVERY_S)

    def __call__(self, what: str, done: int, total: int) -> None:
        if self._often.due(anyway=what != self._what or done >= total):
            self._what = what
            self._watch(self.name, what, done, total)

    def ended(self, ended: Ended) -> None:
        """Report a completed fit; the rate of these reports is not limited."""
        self._on_fit_end(self.name, ended)


STUDY = "load-validation"


def under_loads(run: Path, spec: ExperimentSpec) -> tuple[StudyEntry, ...]:
    """Return the load validation of a run's models; None if the spec does not require it.

    Only models with the protocol `honest` are validated; other models have used the data on which
    they would be evaluated.
    """
    if not spec.validation.under_loads:
        return ()
    order = list(dict.fromkeys(fit.estimator for fit in spec.fit))
    ordered = []
    for file in run.glob("fit/*/evaluation.json"):
        evaluation = json.loads(file.read_text("utf-8"))
        if evaluation.get("protocol") == HONEST and evaluation.get("estimator") in order:
            place = f"fit/{file.parent.name}"
            ordered.append((order.index(evaluation["estimator"]), place))
    models = [place for _, place in sorted(ordered)]
    return (StudyEntry(study=STUDY, estimators=[], models=models),) if models else ()


def as_in_spec(spec: ExperimentSpec, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a study, with the estimator settings and hold-out set of the spec.

    With these parameters, the study has the same result for the spec and for `hil validate-loads
    -e`.
    """
    settings = {fit.estimator: fit.parameters for fit in reversed(spec.fit)}
    values: dict[str, Any] = dict(parameters)
    if values.get("estimators"):
        values["estimators"] = [
            {"estimator": one, **settings[one]}
            if isinstance(one, str) and settings.get(one)
            else one
            for one in values["estimators"]
        ]
    if isinstance(spec.excitation, Fourier) and spec.fit:
        held = spec.hold_out.trajectories_of(spec.excitation.trajectories)
        if held:
            values.setdefault("hold_out", held)
    return values


def of_other_arms(run: Path, models: Sequence[str]) -> tuple[str, ...]:
    """Return a warning for every stored model that was fitted to a different individual robot."""
    mine = serial_of(run)
    warnings = []
    for name in models:
        place = run / name if (run / name).exists() and not Path(name).exists() else Path(name)
        training = load_model_file(place).training_
        if mine and training and training.serial and training.serial != mine:
            warnings.append(
                f"{name} BELONGS TO A DIFFERENT ROBOT: the model was fitted to serial "
                f"{training.serial}, this run was measured on serial {mine}; "
                "differences between the robots count as model errors and make the results on "
                "loads wrong"
            )
    return tuple(warnings)


WHERE = "under loads"
"""Name under which a failed load validation appears in the verdict."""


def judge_under_loads(
    run: Path, spec: ExperimentSpec, data: Dataset, tell: Tell
) -> tuple[list[Row], list[FailedFit]]:
    """Evaluate a run's models with its loads, and write the study or the reason of its failure.

    Returns:
        Rows of the verdict, one row per criterion about loads, and the models that could not be
        evaluated.
    """
    tell({"kind": "stage", "stage": "evaluating models with loads"})
    try:
        results, failed = _load_validation(run, spec, data, tell)
    except HilError as error:
        return [], [FailedFit(WHERE, error)]
    finally:
        tell({"kind": "study", "study": ""})
    return list(rows_of(spec.accept, results)), [FailedFit(*one) for one in failed]


def _load_validation(
    run: Path, spec: ExperimentSpec, data: Dataset, tell: Tell
) -> tuple[Sequence[UnderLoads], Sequence[Failed]]:
    entries = under_loads(run, spec)
    if not entries:
        raise FitError(
            "there is no model with the protocol `honest` to evaluate", hint=f"hil show {run}"
        )
    validation = made_study(STUDY, **entries[0].parameters)
    assert isinstance(validation, LoadValidation)
    folder = run / STUDIES / folder_of(STUDY, validation.get_params())

    def progress(what: str, done: int, total: int) -> None:
        tell({"kind": "study", "study": STUDY, "what": what, "done": done, "total": total})

    begin = time.perf_counter()
    try:
        with threadpool_limits(1):
            robot = load_model(data.robot, gravity=data.gravity)
            results, failed = validation.found(data, robot, progress)
        result = validation.told(results, failed)
        write_study(replace(result, seconds=time.perf_counter() - begin), folder)
    except HilError as error:
        write_problem(STUDY, error.message, error.hint, folder)
        raise
    return results, failed


def rows_of(accept: Accept, results: Sequence[UnderLoads]) -> Iterator[Row]:
    """Yield one row of a verdict for each criterion about loads."""
    if (limit := accept.load_error_ratio) is not None:
        for model in results if limit.of == "every" else results[:1]:
            ratio = model.worst(limit.told)[1]
            yield _row(model, "load_error_ratio", _errors(model, limit.told), ratio, limit.max)
    if (most := accept.contradicted_loads) is not None:
        wrong = results[0].contradicted()
        what = f"run ({', '.join(wrong)})" if wrong else "run"
        yield _row(results[0], "contradicted_loads", what, len(wrong), most.max)


def _errors(model: UnderLoads, payload: str) -> str:
    """Return a text with the two errors from which a ratio was computed.

    The two errors are shown with the ratio, because a model with a large error without a load has a
    small ratio.

    Args:
        model: Name of the model that was evaluated with loads.
        payload: Source of the payload that the model knows: `declared`, `calibrated`, …
    """
    load, bare = model.worst(payload)[0], model.loads[0]
    loaded_nm, bare_nm = mean_of(load.errors[payload]), mean_of(bare.errors["declared"])
    return f"{load.case.name} {payload}, {loaded_nm:.3g} N·m; {bare.case.name}, {bare_nm:.3g} N·m"


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
