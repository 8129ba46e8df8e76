"""One robot's fit as a worker computes it: the same bits, whoever computes it and wherever."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hil.campaign.judging import criteria_of
from hil.campaign.parts import hold_out
from hil.data.dataset import Dataset
from hil.data.load import load_source, serial_of
from hil.drift.history import identity
from hil.dynamics import load_model
from hil.errors import DataError, HilError
from hil.evaluate import Criterion, evaluate, judge
from hil.fitting import fit_dataset, usable_part
from hil.identify.base import estimator as make_estimator
from hil.record.files import json_document
from hil.spec.load import load_spec
from hil.validation import EVALUATION_FILE


@dataclass(frozen=True, slots=True)
class How:
    """What is fitted.

    Attributes:
        estimator: Name in `hil.estimators`.
        parameters: Its own.
    """

    estimator: str
    parameters: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Learnt:
    """What a fit needs of a run.

    Attributes:
        train: To fit to.
        test: Held out as the run's spec says; None where it holds nothing out.
        held_out: What `test` is, in words.
        serial: Of the robot.
        criteria: Of the run's spec.
    """

    train: Dataset
    test: Dataset | None
    held_out: str
    serial: str
    criteria: tuple[Criterion, ...]


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """What came of one fit.

    Attributes:
        folder: Name of the model's folder, `<estimator>-<digest>`.
        files: Its content, by name; empty when there is no model.
        rmse: (n,) raw, on what was held out; empty if nothing was.
        passed: Whether that meets the run's criteria; None if it has none.
        error: Why there is no model.
    """

    folder: str = ""
    files: Mapping[str, bytes] = field(default_factory=dict)
    rmse: tuple[float, ...] = ()
    passed: bool | None = None
    error: str = ""


def learnt_of(run: Path, how: How) -> Learnt:
    """What of a run is fitted to, and what is held out.

    Raises:
        DataError: The run cannot be read.
        FitError: It has nothing the estimator works on.
        SpecError: Its spec cannot be read.
    """
    data = usable_part(load_source(run), make_estimator(how.estimator, **how.parameters))
    spec = load_spec(run / "spec.yaml", look_up=False)
    criteria = tuple(criteria_of(spec.accept))
    try:
        parts = hold_out(data, spec.hold_out)
    except DataError:  # a program of one trajectory: all there is is fitted to
        return Learnt(data, None, "", serial_of(run), ())
    return Learnt(parts.train, parts.test, parts.held_out, serial_of(run), criteria)


def fit_at(run: Path, uid: str, how: How) -> FitResult | None:
    """Fit a run by its path; None where that run is not to be found.

    Args:
        run: Its directory.
        uid: Its identity.
        how: What to fit.
    """
    try:
        seen = identity(run)[0] == uid
    except HilError:
        seen = False
    return _tried(lambda: fit_learnt(learnt_of(run, how), how)) if seen else None


@dataclass(frozen=True, slots=True)
class Sent:
    """A fit of a run that the worker cannot see: the samples are read when they are sent.

    Attributes:
        run: Its directory, here.
        how: What to fit.
    """

    run: Path
    how: How

    def __call__(self) -> FitResult:
        """Fit it here."""
        return _tried(lambda: fit_learnt(learnt_of(self.run, self.how), self.how))

    def __reduce__(self) -> tuple[Any, ...]:
        try:
            return _fit_sent, (learnt_of(self.run, self.how), self.how)
        except HilError as error:
            return _no_model, (error.message,)


class _fit_sent:  # noqa: N801 - what arrives at a worker in place of `Sent`
    def __init__(self, learnt: Learnt, how: How) -> None:
        self._learnt, self._how = learnt, how

    def __call__(self) -> FitResult:
        return _tried(lambda: fit_learnt(self._learnt, self._how))


class _no_model:  # noqa: N801
    def __init__(self, error: str) -> None:
        self._error = error

    def __call__(self) -> FitResult:
        return FitResult(error=self._error)


def fit_learnt(learnt: Learnt, how: How) -> FitResult:
    """Fit, judge, and give the model's files.

    Raises:
        FitError: The data do not allow it.
        PluginError, SpecError: No such estimator, parameter or robot.
    """
    train = learnt.train
    robot = load_model(train.robot, gravity=train.gravity)
    with tempfile.TemporaryDirectory(prefix="hil-fit-") as folder:
        fitted = fit_dataset(
            train, how.estimator, robot, out=Path(folder), serial=learnt.serial, **how.parameters
        )
        files = {path.name: path.read_bytes() for path in sorted(fitted.folder.iterdir())}
    if learnt.test is None:
        return FitResult(fitted.folder.name, files)
    found = evaluate(fitted.model, learnt.test, fitted.train_std)
    verdict = judge(found, list(learnt.criteria))
    document = {
        "estimator": how.estimator,
        "protocol": fitted.model.protocol,
        "notes": list(fitted.model.notes_),
        "held_out": {"what": learnt.held_out, **found.to_dict()},
        "verdict": verdict.to_dict(),
    }
    return FitResult(
        fitted.folder.name,
        files | {EVALUATION_FILE: json_document(document)},
        tuple(map(float, found.total.rmse_raw)),
        verdict.passed if verdict.judged else None,
    )


def _tried(fit: Callable[[], FitResult]) -> FitResult:
    try:
        return fit()
    except HilError as error:
        return FitResult(error=error.message)
    # Estimators are plug-ins: one that breaks down must not cost the other robots.
    except Exception as error:
        return FitResult(error=f"it broke down: {type(error).__name__}: {error}")
