"""Fit of a model to a dataset, storage of the model, and evaluation on held-out data.

Estimators use only datasets; the module `hil.workflow.fit` reads the recordings.
"""

from __future__ import annotations

import hashlib
import time
import traceback
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from hil.core import (
    FitError,
    FloatArray,
    PluginError,
    RecordingError,
    card,
    number,
    plugins,
    require_installed,
    write_whole,
)
from hil.data import Dataset, shortest_series
from hil.dynamics import RobotModel
from hil.estimators import GROUP, RobotEstimator, Training, model_files
from hil.estimators import estimator as make_estimator
from hil.evaluation.evaluation import MEASURED_ORDER, evaluate
from hil.evaluation.validation import (
    EVALUATION_FILE,
    Validation,
    keep,
    motion_notes,
    require_unseen,
    serial_notes,
    under_load,
)
from hil.importers import load_source, serial_of
from hil.networks import Watch, attach, keeps_checkpoints

DIGEST_LENGTH = 12


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """Fitted model with the model folder that stores it.

    Attributes:
        model: Fitted model.
        folder: Model folder `<estimator>-<digest>`; equal models have the same folder name.
        seconds: Wall time of the fit, including filtering [s].
        train_std: (n,) standard deviation of the training effort, which is the scale of the NRMSE.
    """

    model: RobotEstimator
    folder: Path
    seconds: float
    train_std: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FitReport:
    """Result of a fit: the fitted model and its validation on held-out sources.

    Attributes:
        fitted: Fitted model.
        validation: List of the validations on each held-out source.
    """

    fitted: Fitted
    validation: tuple[Validation, ...]

    def __repr__(self) -> str:
        held_out = f"{len(self.validation)} held-out sources"
        return f"<FitReport {self.fitted.folder}: {self.fitted.seconds:.1f} s, {held_out}>"

    def _repr_html_(self) -> str:
        """Return the validation as an HTML table for a notebook, one row per held-out source."""
        model = self.fitted.model
        unit = "A" if model.effort_kind_ == "current" else "N·m"
        head = (f"RMSE raw [{unit}] on", *model.joint_names_, "mean")
        rows = [
            (one.source, *map(number, one.errors.total.rmse_raw),
             number(one.errors.total.mean("rmse_raw")))
            for one in self.validation
        ]  # fmt: skip
        facts = {"model": self.fitted.folder, "fitted in": f"{self.fitted.seconds:.1f} s"}
        notes = dict.fromkeys(note for one in self.validation for note in one.notes)
        table = (head, rows) if rows else None
        return card("Fit", model.estimator, facts, table=table, notes=notes)

    def to_dict(self) -> dict[str, Any]:
        """Return the fit report in the format of `hil fit --json`."""
        return {
            "model": str(self.fitted.folder),
            "estimator": self.fitted.model.estimator,
            "seconds": self.fitted.seconds,
            "validation": [one.to_dict() for one in self.validation],
        }


def fit_dataset(
    dataset: Dataset,
    estimator: str,
    robot: RobotModel,
    *,
    out: Path,
    watch: Watch | None = None,
    checkpoints: Path | None = None,
    serial: str | None = None,
    **params: Any,
) -> Fitted:
    """Fit an estimator to a dataset, and store the model under `out`.

    Args:
        dataset: Training data.
        estimator: Name of the estimator in `hil.estimators`.
        robot: Robot model of the arm.
        out: Folder in which the model folder is created.
        watch: Callback for each epoch of an estimator that trains a network.
        checkpoints: Folder for training checkpoints of networks, from which an interrupted training
            is resumed; other estimators ignore the folder.
        serial: Serial number of the robot; if None, the serial number is read from the sources of
            the dataset.
        **params: Parameters of the estimator.

    Raises:
        FitError: The model cannot be fitted to the data.
        PluginError, SpecError: The estimator or a parameter does not exist.
    """
    if serial is None:
        named = dict.fromkeys(condition.source for condition in dataset.conditions)
        serial = one_serial([Path(one) for one in named if one and Path(one).exists()])
    model = make_estimator(estimator, **params)
    require_installed([(estimator, model)])
    attach(model, watch, checkpoints if keeps_checkpoints(model) else None)
    return fit_model(model, dataset, robot, out, serial)


def judge_fit(
    fitted: Fitted, train: Dataset, held_out: Iterable[tuple[Path, Dataset]]
) -> FitReport:
    """Evaluate a newly fitted model on held-out sources, and store the result in its folder.

    Args:
        fitted: Fitted model.
        train: Training data of the model.
        held_out: Pairs of a held-out source and its dataset.

    Raises:
        DataError: The existing evaluation file is damaged.
    """
    judged = tuple(_validated(fitted, train, source, data) for source, data in held_out)
    keep(fitted.folder / EVALUATION_FILE, judged)
    return FitReport(fitted, judged)


def judge_source(model: RobotEstimator, source: Path) -> Validation:
    """Return the validation of a stored model on a new source.

    Raises:
        DataError: The source cannot be read, does not match the model, or contains training data of
            the model.
    """
    trained = model.training_
    data = usable_part(load_source(source), model)
    require_unseen(model, source, data)
    with threadpool_limits(1):
        errors = evaluate(model, data, trained.effort_std if trained else None)
        under = under_load(model, data, trained.payloads if trained else None)
    notes = serial_notes(trained.serial if trained else "", source)
    return Validation(str(source), errors, tuple(notes), under)


def usable_part(dataset: Dataset, model: RobotEstimator) -> Dataset:
    """Return the series of the kinds that an estimator uses, if possible of its preferred kinds.

    Moves that are too short for a filter are left out if the dataset contains longer moves. Such
    short moves occur if an axis slips during a dwell, or if a recorded clock pauses near the end of
    a move.

    Raises:
        FitError: The dataset contains no series of the kinds that the estimator uses.
    """
    for kinds in model.series_kinds:
        chosen = dataset.of_kind(*kinds)
        if len(chosen):
            return _without_short_moves(chosen)
    wanted = " or ".join(kind for kinds in model.series_kinds for kind in kinds)
    have = ", ".join(sorted({condition.kind for condition in dataset.conditions})) or "nothing"
    raise FitError(
        f"{model.estimator} needs {wanted} data, the recording contains: {have}",
        hint="record such an excitation, or choose a different estimator",
    )


def _without_short_moves(dataset: Dataset) -> Dataset:
    lengths = np.diff(dataset.offsets)
    moves = np.array([condition.kind == "move" for condition in dataset.conditions])
    kept = np.flatnonzero(~moves | (lengths >= shortest_series(MEASURED_ORDER)))
    return dataset.take(kept) if 0 < len(kept) < len(lengths) else dataset


SET_BY_FIT = ("robot_", "joint_names_", "effort_kind_", "torque_scale_", "sigma_", "samples_")
"""Names of the attributes that every fitted estimator has."""


def fit_model(
    model: RobotEstimator, dataset: Dataset, robot: RobotModel, out: Path, serial: str
) -> Fitted:
    """Fit an estimator to a dataset, and store the model under `out`.

    Args:
        model: Estimator that is not fitted yet.
        dataset: Training data.
        robot: Robot model of the arm.
        out: Folder in which the model folder is created.
        serial: Serial number of the robot; empty if unknown.

    Raises:
        FitError: The model cannot be fitted to the data.
        PluginError: The method `fit` of the estimator does not set an attribute that every fitted
            estimator has.
        RecordingError: The model folder cannot be written.
    """
    train = usable_part(dataset, model)
    begin = time.perf_counter()
    # With tall and thin matrices, several BLAS threads are 20 times slower than one (measured).
    with threadpool_limits(1):
        model.fit(train, robot)
    if missing := [name for name in SET_BY_FIT if not hasattr(model, name)]:
        raise PluginError(
            f"fit() of {plugins.origin_of(model)} does not set {', '.join(missing)}",
            hint="set them, or derive the estimator from hil.estimators.RigidLinear",
        )
    seconds = time.perf_counter() - begin
    training = replace(Training.of(train), serial=serial)
    model.training_ = training
    return Fitted(model, _store(model, out), seconds, training.effort_std)


def broken_down(estimator: str, error: Exception, subject: str) -> FitError:
    """Return a FitError for an unexpected exception of an estimator, usually a plug-in.

    Args:
        estimator: Name of the estimator that raised the exception.
        error: Unexpected exception; the message contains the place where it was raised in the
            package of the estimator.
        subject: First word of the message: the name of the estimator, or `it` if the message
            already contains the name.
    """
    package = plugins.find(GROUP, estimator).module.partition(".")[0]
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        if str(frame.f_globals.get("__name__")).partition(".")[0] == package:
            code = frame.f_code
            place = f" (…/{Path(code.co_filename).name}:{line} in {code.co_name})"
    failed = FitError(
        f"{subject} failed: {type(error).__name__}: {error}{place}",
        hint="the estimator has a bug: report it to its author",
    )
    failed.__cause__ = error
    return failed


def _store(model: RobotEstimator, out: Path) -> Path:
    """Write the model folder and return its path; the folder of an equal model is not changed."""
    files = model_files(model)
    digest = hashlib.sha256(b"".join(files.values())).hexdigest()[:DIGEST_LENGTH]
    folder = out / f"{model.estimator}-{digest}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(
            f"cannot create {folder}: {error.strerror}", hint="choose a different folder for models"
        ) from None
    for name, content in files.items():
        if not (folder / name).exists():
            write_whole(folder / name, content)
    return folder


def _validated(fitted: Fitted, train: Dataset, source: Path, data: Dataset) -> Validation:
    model = fitted.model
    judged = usable_part(data, model)
    errors = evaluate(model, judged, fitted.train_std)
    serial = model.training_.serial if model.training_ else ""
    seen = motion_notes(usable_part(train, model), judged)
    notes = (*model.notes_, *serial_notes(serial, source), *seen)
    known = {condition.payload for condition in usable_part(train, model).conditions}
    with threadpool_limits(1):
        under = under_load(model, judged, known)
    return Validation(str(source), errors, notes, under)


def one_serial(sources: Sequence[Path]) -> str:
    """Return the serial number of the robot of all sources; empty if it is unknown.

    Raises:
        FitError: The sources are recordings of several robots.
    """
    serials = {serial: source for source in sources if (serial := serial_of(source))}
    if len(serials) > 1:
        listed = ", ".join(f"{serial} ({source.name})" for serial, source in serials.items())
        raise FitError(
            f"the training data are of {len(serials)} different robots, by serial number: {listed}",
            hint="fit each robot separately; evaluate its model on the others with --validate",
        )
    return next(iter(serials), "")
