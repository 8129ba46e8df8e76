"""Fitting recordings: sources in, a stored and validated model out.

The one place where reading recordings, fitting and judging meet; the estimators themselves see
nothing but datasets.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from hil.data.dataset import Dataset
from hil.data.load import load_source, with_payload
from hil.data.splits import assert_disjoint
from hil.dynamics import RobotModel, load_model
from hil.errors import DataError, FitError, SpecError
from hil.evaluate import Evaluation, evaluate
from hil.identify.base import RobotEstimator
from hil.identify.base import estimator as make_estimator
from hil.identify.model_file import json_bytes, load_model_file, model_files, write_whole
from hil.payload import Payload
from hil.typing import FloatArray

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
        validation: One evaluation per held-out source.
    """

    fitted: Fitted
    validation: tuple[tuple[str, Evaluation], ...]

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil fit --json`."""
        return {
            "model": str(self.fitted.folder),
            "estimator": self.fitted.model.estimator,
            "seconds": self.fitted.seconds,
            "validation": [_entry(source, found) for source, found in self.validation],
        }


def fit_sources(
    sources: Sequence[Path],
    *,
    estimator: str,
    robot: str | None = None,
    payload: Payload | None = None,
    validate: Iterable[Path] = (),
    out: Path = Path("models"),
    **params: Any,
) -> FitReport:
    """Fit an estimator to recordings and judge it on others.

    Args:
        sources: Run directories or MCAP files to fit on.
        estimator: Name in `hil.estimators`.
        robot: Built-in arm or URDF; by default what the data says.
        payload: Load of the training sources; by default what the data says.
        validate: Held-out sources, each judged by itself.
        out: Folder in which the model's folder is made.
        **params: The estimator's own parameters.

    Raises:
        DataError: A source cannot be read, or is given for training and validation alike.
        FitError: The data do not allow the fit, or are of different robots.
        PluginError, SpecError: No such estimator, parameter or robot.
    """
    model = make_estimator(estimator, **params)
    train = _pooled([load_source(source) for source in sources])
    if payload is not None:
        train = with_payload(train, payload)
    held_out = [(str(source), load_source(source)) for source in validate]
    for _, data in held_out:
        _require_same_effort(train, data)
        assert_disjoint(train, data)
    fitted = _fit(model, train, load_model(robot or train.robot), out)
    judged = tuple((name, _judged(fitted, data)) for name, data in held_out)
    document = {"validation": [{"source": name, **found.to_dict()} for name, found in judged]}
    write_whole(fitted.folder / "evaluation.json", json_bytes(document))
    return FitReport(fitted, judged)


def fit_dataset(
    dataset: Dataset, estimator: str, robot: RobotModel, *, out: Path, **params: Any
) -> Fitted:
    """Fit an estimator to a dataset and store the model under `out`.

    Raises:
        FitError: The data do not allow it.
        PluginError, SpecError: No such estimator or parameter.
    """
    return _fit(make_estimator(estimator, **params), dataset, robot, out)


def evaluate_sources(model: Path, sources: Iterable[Path]) -> list[dict[str, Any]]:
    """Judge a stored model; one entry per source, with the keys of `FitReport.to_dict`.

    Raises:
        DataError: The model or a source cannot be read, or they do not belong together.
    """
    stored = load_model_file(model)
    return [
        _entry(str(source), evaluate(stored, usable_part(load_source(source), stored)))
        for source in sources
    ]


def usable_part(dataset: Dataset, model: RobotEstimator) -> Dataset:
    """The series of the kinds an estimator learns from, the preferred ones if there are any.

    Raises:
        FitError: There are none.
    """
    for kinds in model.series_kinds:
        chosen = dataset.of_kind(*kinds)
        if len(chosen):
            return chosen
    wanted = " or ".join(kind for kinds in model.series_kinds for kind in kinds)
    have = ", ".join(sorted({condition.kind for condition in dataset.conditions})) or "nothing"
    raise FitError(
        f"{model.estimator} works on {wanted} data, but there is only {have}",
        hint="record the excitation it needs, or choose another estimator",
    )


def parse_payload(text: str) -> Payload:
    """`MASS` or `MASS,X,Y,Z` in kg and m.

    Raises:
        SpecError: It is neither.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 4) or not np.all(np.isfinite(numbers)) or numbers[0] < 0:
        raise SpecError(
            f"the payload {text!r} is neither MASS nor MASS,X,Y,Z",
            hint="for example: --payload 2.8,0,0,0.05 (kg and m, in the flange frame)",
        )
    x, y, z = numbers[1:] or (0.0, 0.0, 0.0)
    return Payload(numbers[0], (x, y, z))


def _fit(model: RobotEstimator, dataset: Dataset, robot: RobotModel, out: Path) -> Fitted:
    train = usable_part(dataset, model)
    begin = time.perf_counter()
    # The matrices are tall and thin: more BLAS threads only spin (measured: 20× slower).
    with threadpool_limits(1):
        model.fit(train, robot)
    seconds = time.perf_counter() - begin
    std = np.asarray(np.std(train["effort"], axis=0))
    return Fitted(model, _store(model, out), seconds, std)


def _store(model: RobotEstimator, out: Path) -> Path:
    """Write the model's folder; an equal model that is there already stays as it is."""
    files = model_files(model)
    digest = hashlib.sha256(b"".join(files.values())).hexdigest()[:DIGEST_LENGTH]
    folder = out / f"{model.estimator}-{digest}"
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        if not (folder / name).exists():
            write_whole(folder / name, content)
    return folder


def _judged(fitted: Fitted, data: Dataset) -> Evaluation:
    return evaluate(fitted.model, usable_part(data, fitted.model), fitted.train_std)


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


def _entry(source: str, found: Evaluation) -> dict[str, Any]:
    total = found.total.to_dict()
    keys = ("rmse_raw", "rmse_filtered", "mean_raw", "mean_filtered", "noise_floor", "nrmse")
    return {"source": source, "unit": found.unit, **{key: total[key] for key in keys}}
