"""Models of a run under its loads: the study `load-validation` of what was fitted, and its verdict.

The study is made of the stored models, relative to the run, so that nothing is fitted twice and
`hil study` or `hil validate-loads` make the same one again.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_limits

from hil.core import FitError, HilError
from hil.dynamics import load_model
from hil.estimators import HONEST, load_model_file
from hil.evaluation import FailedFit
from hil.importers import serial_of
from hil.spec import Accept, ExperimentSpec, Fourier, StudyEntry
from hil.studies import STUDIES, folder_of, mean_of, write_problem, write_study

if TYPE_CHECKING:
    from hil.data import Dataset
    from hil.studies import Failed, UnderLoads
    from hil.workflow.trainings import Tell

STUDY = "load-validation"
WHERE = "under loads"
"""What is named where no model could be judged so."""

Row = dict[str, Any]


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
