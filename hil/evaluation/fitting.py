"""A fitted model, stored and judged on held-out data.

The estimators themselves see nothing but datasets; `hil.workflow.fit` reads the recordings.
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
    """A fitted model and where it was stored.

    Attributes:
        model: Ready to predict.
        folder: `<estimator>-<digest>`; equal models land in the same folder.
        seconds: Wall time of the fit, filtering included.
        train_std: (n,) standard deviation of the training effort, the scale for NRMSE.
    """

    model: RobotEstimator
    folder: Path
    seconds: float
    train_std: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FitReport:
    """What came of fitting sources.

    Attributes:
        fitted: The model.
        validation: One per held-out source.
    """

    fitted: Fitted
    validation: tuple[Validation, ...]

    def __repr__(self) -> str:
        told = f"{len(self.validation)} held-out sources"
        return f"<FitReport {self.fitted.folder}: {self.fitted.seconds:.1f} s, {told}>"

    def _repr_html_(self) -> str:
        """Itself in a notebook: a row per held-out source."""
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
        """The contract of `hil fit --json`."""
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
    """Fit an estimator to a dataset and store the model under `out`.

    Args:
        dataset: To fit to.
        estimator: Name in `hil.estimators`.
        robot: Model of the arm.
        out: Folder in which the model's folder is made.
        watch: Told every epoch of estimators that train networks.
        checkpoints: Folder to keep their training in, and to take it up from; other estimators
            keep nothing.
        serial: Of the robot; by default what the dataset's sources say, where they are here.
        **params: The estimator's own parameters.

    Raises:
        FitError: The data do not allow it.
        PluginError, SpecError: No such estimator or parameter.
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
    """Judge a model that was just fitted on held-out sources; kept in its folder.

    Args:
        fitted: The model.
        train: What it was fitted to.
        held_out: Each source, and its samples.

    Raises:
        DataError: What is kept there already is damaged.
    """
    judged = tuple(_validated(fitted, train, source, data) for source, data in held_out)
    keep(fitted.folder / EVALUATION_FILE, judged)
    return FitReport(fitted, judged)


def judge_source(model: RobotEstimator, source: Path) -> Validation:
    """Judge a stored model on a source that it has not seen.

    Raises:
        DataError: The source cannot be read, does not belong to the model, or was among its
            training data.
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
    """Return the series of the kinds an estimator learns from, the preferred ones if there are any.

    Moves too short for a filter are left out where there are longer ones: an axis that slips in
    the middle of a dwell makes one, and so does a recorded clock that pauses near a move's end.

    Raises:
        FitError: There are none.
    """
    for kinds in model.series_kinds:
        chosen = dataset.of_kind(*kinds)
        if len(chosen):
            return _without_short_moves(chosen)
    wanted = " or ".join(kind for kinds in model.series_kinds for kind in kinds)
    have = ", ".join(sorted({condition.kind for condition in dataset.conditions})) or "nothing"
    raise FitError(
        f"{model.estimator} works on {wanted} data, but there is only {have}",
        hint="record the excitation it needs, or choose another estimator",
    )


def _without_short_moves(dataset: Dataset) -> Dataset:
    lengths = np.diff(dataset.offsets)
    moves = np.array([condition.kind == "move" for condition in dataset.conditions])
    kept = np.flatnonzero(~moves | (lengths >= shortest_series(MEASURED_ORDER)))
    return dataset.take(kept) if 0 < len(kept) < len(lengths) else dataset


def fit_model(
    model: RobotEstimator, dataset: Dataset, robot: RobotModel, out: Path, serial: str
) -> Fitted:
    """Fit an estimator to a dataset and store the model under `out`.

    Args:
        model: Of the estimator, not fitted.
        dataset: To fit to.
        robot: Model of the arm.
        out: Folder in which the model's folder is made.
        serial: Of the robot; empty when nobody said.

    Raises:
        FitError: The data do not allow it.
        RecordingError: The model cannot be written there.
    """
    train = usable_part(dataset, model)
    begin = time.perf_counter()
    # The matrices are tall and thin: more BLAS threads only spin (measured: 20× slower).
    with threadpool_limits(1):
        model.fit(train, robot)
    seconds = time.perf_counter() - begin
    training = replace(Training.of(train), serial=serial)
    model.training_ = training
    return Fitted(model, _store(model, out), seconds, training.effort_std)


def broken_down(estimator: str, error: Exception, subject: str) -> FitError:
    """Return the error of an estimator, usually a plug-in, that raised what none should raise.

    Args:
        estimator: Its name.
        error: What it raised; the place in the estimator's own package is named.
        subject: Begins the message: its name, or `it` where the name stands before.
    """
    package = plugins.find(GROUP, estimator).module.partition(".")[0]
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        if str(frame.f_globals.get("__name__")).partition(".")[0] == package:
            code = frame.f_code
            place = f" (…/{Path(code.co_filename).name}:{line} in {code.co_name})"
    failed = FitError(
        f"{subject} broke down: {type(error).__name__}: {error}{place}",
        hint="this is a fault of the estimator: report it to whoever wrote it",
    )
    failed.__cause__ = error
    return failed


def _store(model: RobotEstimator, out: Path) -> Path:
    """Write the model's folder; an equal model that is there already stays as it is."""
    files = model_files(model)
    digest = hashlib.sha256(b"".join(files.values())).hexdigest()[:DIGEST_LENGTH]
    folder = out / f"{model.estimator}-{digest}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(
            f"cannot make {folder}: {error.strerror}", hint="choose another folder for models"
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
    """Return the serial number of the robot of all sources; empty when nobody said.

    Raises:
        FitError: They are of several robots.
    """
    serials = {serial: source for source in sources if (serial := serial_of(source))}
    if len(serials) > 1:
        listed = ", ".join(f"{serial} ({source.name})" for serial, source in serials.items())
        raise FitError(
            f"the training data are of {len(serials)} different robots, by serial number: {listed}",
            hint="fit each robot by itself; judge its model on the others with --validate",
        )
    return next(iter(serials), "")
