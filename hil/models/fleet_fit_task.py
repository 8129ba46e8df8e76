"""One robot's fit as a worker computes it: the same bits, whoever computes it and wherever."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from hil.core import HilError, json_document
from hil.dynamics import load_model
from hil.estimators import estimator as make_estimator
from hil.evaluation import EVALUATION_FILE, Parts, fit_dataset, hold_out, judged_model, usable_part
from hil.importers import load_source, serial_of
from hil.models.drift.history import identity
from hil.spec import Accept, load_spec


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
        parts: To fit to and to judge on, as the run's spec says.
        serial: Of the robot.
        accept: Criteria of the run's spec.
    """

    parts: Parts
    serial: str
    accept: Accept


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """What came of one fit.

    Attributes:
        folder: Name of the model's folder, `<estimator>-<digest>`.
        files: Its content, by name; empty when there is no model.
        rmse: (n,) raw, on what was held out.
        passed: Whether that meets all criteria for models in the run's spec; None if it has none,
            if they do not apply to such a model, or if some are about loads: only a run judges
            those.
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
        DataError: The run cannot be read, or nothing can be held out.
        FitError: It has nothing the estimator works on.
        SpecError: Its spec cannot be read.
    """
    data = usable_part(load_source(run), make_estimator(how.estimator, **how.parameters))
    spec = load_spec(run / "spec.yaml", look_up=False)
    return Learnt(hold_out(data, spec.hold_out), serial_of(run), spec.accept)


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
            return partial, (_fitted_of, learnt_of(self.run, self.how), self.how)
        except HilError as error:
            return partial, (FitResult, "", {}, (), None, error.message)


def _fitted_of(learnt: Learnt, how: How) -> FitResult:
    return _tried(lambda: fit_learnt(learnt, how))


def fit_learnt(learnt: Learnt, how: How) -> FitResult:
    """Fit, judge, and give the model's files.

    Raises:
        FitError: The data do not allow it.
        PluginError, SpecError: No such estimator, parameter or robot.
    """
    train = learnt.parts.train
    robot = load_model(train.robot, gravity=train.gravity)
    with tempfile.TemporaryDirectory(prefix="hil-fit-") as folder:
        fitted = fit_dataset(
            train, how.estimator, robot, out=Path(folder), serial=learnt.serial, **how.parameters
        )
        files = {path.name: path.read_bytes() for path in sorted(fitted.folder.iterdir())}
    judged = judged_model(how.estimator, fitted, learnt.parts, learnt.accept)
    verdict = judged.verdict
    passed = verdict.passed if verdict.judged else None
    return FitResult(
        fitted.folder.name,
        files | {EVALUATION_FILE: json_document(judged.document)},
        tuple(map(float, judged.held_out.total.rmse_raw)),
        None if passed and learnt.accept.under_loads else passed,
    )


def _tried(fit: Callable[[], FitResult]) -> FitResult:
    try:
        return fit()
    except HilError as error:
        return FitResult(error=error.message)
    # Estimators are plug-ins: one that breaks down must not cost the other robots.
    except Exception as error:
        return FitResult(error=f"it broke down: {type(error).__name__}: {error}")
