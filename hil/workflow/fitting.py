"""`hil fit` and `hil evaluate`: a model from recordings, stored and judged, with a page about it.

Here reading recordings, fitting, judging and reporting meet outside a run (`judging` does it in
one).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from inspect import signature
from typing import Any

from hil.arms import AnyPayload, payload_of
from hil.core import (
    AnyPath,
    DataError,
    FitError,
    HilError,
    RecordingError,
    SpecError,
    path_of,
    paths_of,
    require_installed,
    sources_of,
    values_by_name,
)
from hil.data import Dataset, assert_disjoint
from hil.dynamics import load_model
from hil.estimators import estimator as make_estimator
from hil.estimators import load_model_file, read_gains
from hil.evaluation import (
    FitReport,
    broken_down,
    fit_model,
    judge_fit,
    judge_source,
    one_serial,
    usable_part,
)
from hil.importers import load_source, require_arm_as_recorded, with_payload
from hil.networks import HearsBeginning, Watch, attach, keeps_checkpoints
from hil.report import render_fit_report


def fit(
    sources: AnyPath | Iterable[AnyPath],
    *,
    estimator: str,
    robot: str | None = None,
    payload: AnyPayload | None = None,
    gains: AnyPath | None = None,
    validate: AnyPath | Iterable[AnyPath] = (),
    parameters: dict[str, Any] | None = None,
    out: AnyPath = "models",
    page: AnyPath | None = None,
    checkpoints: AnyPath | None = None,
    watch: Watch | None = None,
) -> FitReport:
    """Fit an estimator to recordings, judge it on others, and return the result.

    Args:
        sources: Run directories or MCAP files to fit to, or just one.
        estimator: Name in `hil.estimators`.
        robot: Built-in arm or URDF; by default that of the data.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a `Payload`; 0 for nothing
            mounted; by default that of the data.
        gains: File with `drive_gains_nm_a`; by default the gains of the data.
        validate: Held-out sources, or just one.
        parameters: The estimator's own parameters.
        out: Folder in which the model's folder is made.
        page: File for an HTML report about the held-out sources; None for no report.
        checkpoints: Folder in which estimators that train networks keep their training, and from
            which they continue it.
        watch: Called with every epoch of such a training.

    Raises:
        DataError: A source cannot be read, or is named for training and validation alike; or the
            checkpoints are of another training.
        FitError: The data do not allow the fit, or are of different robots or individuals.
        PluginError: No such estimator, or it needs extras that are not installed; all are named.
        SpecError: No such parameter or robot, or an argument is invalid.
        RecordingError: The model cannot be written there.
    """
    fitted_to, judged_on = sources_of(sources), paths_of(validate)
    load, calibrated = payload_of(payload), read_gains(path_of(gains)) if gains else None
    folder, trainings = path_of(out), None if checkpoints is None else path_of(checkpoints)
    if page is not None and not judged_on:
        raise SpecError(
            "a page shows how a model does on held-out recordings, and none was given",
            hint="name one: hil.fit(…, validate=…)",
        )
    model = make_estimator(estimator, **_own_parameters(parameters))
    require_installed([(estimator, model)])
    if folder.exists() and not folder.is_dir():  # before hours of training
        raise RecordingError(f"{folder} is a file", hint="choose another folder for models")
    attach(model, watch, trainings)
    named = robot is not None
    parts = [load_source(source, any_arm=named) for source in fitted_to]
    train = _pooled([calibrated.of(part) for part in parts] if calibrated else parts)
    if load is not None:
        train = with_payload(train, load)
    serial = one_serial(fitted_to)
    for source in () if named else fitted_to:
        require_arm_as_recorded(source)
    held_out = [(source, load_source(source, any_arm=named)) for source in judged_on]
    for _, data in held_out:
        _require_same_effort(train, data)
        # Only the parts that are used must differ: warm-ups of two runs on a mock are the same.
        assert_disjoint(usable_part(train, model), usable_part(data, model))
    arm = load_model(robot or train.robot, gravity=train.gravity)
    if isinstance(watch, HearsBeginning) and keeps_checkpoints(model):
        part = usable_part(train, model)
        size = f"{len(part)} samples in {len(part.conditions)} series"
        watch.began(f"training {estimator} on {size}")
    try:
        report = judge_fit(fit_model(model, train, arm, folder, serial), train, held_out)
    except (HilError, OSError):
        raise
    except Exception as error:  # estimators are plug-ins, which may raise anything
        raise broken_down(estimator, error, estimator) from error
    if page is not None:
        shown = {str(source): usable_part(data, model) for source, data in held_out}
        render_fit_report(report.fitted.folder, shown, path_of(page))
    return report


def evaluate(model: AnyPath, sources: AnyPath | Iterable[AnyPath]) -> list[dict[str, Any]]:
    """Judge a saved model; return an entry per source, with the keys of `FitReport.to_dict`.

    Raises:
        DataError: A source cannot be read, or was among the model's training data.
    """
    judged_on = sources_of(sources)
    stored = load_model_file(path_of(model))
    return [judge_source(stored, source).to_dict() for source in judged_on]


def _own_parameters(parameters: dict[str, Any] | None) -> dict[str, Any]:
    """Return an estimator's own parameters.

    Raises:
        SpecError: They are no values by name, or one is an argument of `fit`.
    """
    own = values_by_name(parameters, "parameters", "{'weighted': True}")
    if taken := sorted(own.keys() & signature(fit).parameters.keys()):
        raise SpecError(
            f"{taken[0]} is no parameter of an estimator", hint=f"hil.fit(…, {taken[0]}=…)"
        )
    return own


def _pooled(parts: Sequence[Dataset]) -> Dataset:
    try:
        return Dataset.concatenate(parts)
    except DataError as error:
        raise FitError(error.message, hint=error.hint) from error


def _require_same_effort(train: Dataset, test: Dataset) -> None:
    if train.effort_kind != test.effort_kind:
        raise FitError(
            f"the training data hold a {train.effort_kind} [{train.effort_unit}], the validation "
            f"data a {test.effort_kind} [{test.effort_unit}]",
            hint="fit and validate on recordings of the same quantity",
        )
