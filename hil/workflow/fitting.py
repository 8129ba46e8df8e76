"""Fit and evaluation of a model outside a run (`hil fit`, `hil evaluate`), with a report page.

The module reads recordings, fits and evaluates a model, and writes the report page; the module
`judging` does the same within a run.
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
    """Fit an estimator to recordings, evaluate the model on other recordings, return the result.

    Args:
        sources: Run directories or MCAP files of the training data; a single path is also accepted.
        estimator: Name of an estimator in `hil.estimators`.
        robot: Name of a built-in arm or path of a URDF; by default the robot of the recordings.
        payload: Payload of the recordings: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a
            `Payload`; 0 for an empty flange; by default the payload that the recordings state.
        gains: File with `drive_gains_nm_a`; by default the drive gains that the recordings state.
        validate: Run directories or MCAP files of held-out recordings; a single path is also
            accepted.
        parameters: Parameters of the estimator, by name.
        out: Folder in which the folder of the model is created.
        page: Path of the HTML report about the held-out recordings; None for no report.
        checkpoints: Folder in which an estimator that trains networks stores its training state,
            and from which the estimator continues an earlier training.
        watch: Callback that receives every epoch of the training of a network.

    Raises:
        DataError: A source cannot be read, the same source is named for training and for
            validation, or the checkpoints belong to a different training.
        FitError: The data do not allow the fit, or come from different robots.
        PluginError: The estimator does not exist, or needs extras that are not installed; the
            message lists all missing extras.
        SpecError: A parameter or the robot does not exist, or an argument is invalid.
        RecordingError: The model cannot be written to `out`.
    """
    fitted_to, judged_on = sources_of(sources), paths_of(validate)
    load, calibrated = payload_of(payload), read_gains(path_of(gains)) if gains else None
    folder, trainings = path_of(out), None if checkpoints is None else path_of(checkpoints)
    if page is not None and not judged_on:
        raise SpecError(
            "the report page needs a hold-out recording, and none was passed",
            hint="pass a recording: hil.fit(…, validate=…)",
        )
    model = make_estimator(estimator, **_own_parameters(parameters))
    require_installed([(estimator, model)])
    if folder.exists() and not folder.is_dir():  # checked before hours of training
        raise RecordingError(f"{folder} is a file", hint="choose a different folder for models")
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
        # Only the used parts must differ, because warm-ups of two runs on a mock are identical.
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
    """Evaluate a saved model; return one entry per source, with the keys of `FitReport.to_dict`.

    Raises:
        DataError: A source cannot be read, or belongs to the training data of the model.
    """
    judged_on = sources_of(sources)
    stored = load_model_file(path_of(model))
    return [judge_source(stored, source).to_dict() for source in judged_on]


def _own_parameters(parameters: dict[str, Any] | None) -> dict[str, Any]:
    """Return the parameters of an estimator as a dict.

    Raises:
        SpecError: `parameters` is not a mapping from names to values, or a parameter has the name
            of an argument of `fit`.
    """
    own = values_by_name(parameters, "parameters", "{'weighted': True}")
    if taken := sorted(own.keys() & signature(fit).parameters.keys()):
        raise SpecError(
            f"{taken[0]} is not an estimator parameter, but an argument of `fit`",
            hint=f"hil.fit(…, {taken[0]}=…)",
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
            f"the training data contain a {train.effort_kind} [{train.effort_unit}], the "
            f"validation data a {test.effort_kind} [{test.effort_unit}]",
            hint="fit and validate on recordings of the same quantity",
        )
