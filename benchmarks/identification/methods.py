"""Every method with the parameters it is compared with, and how it fares on data."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from hil.core import plugins
from hil.core.errors import HilError, PluginError
from hil.core.typing import FloatArray
from hil.data.dataset import Dataset
from hil.dynamics import RobotModel
from hil.estimators.base import GROUP, RobotEstimator, estimator
from hil.evaluation import Errors, evaluate

DEFAULT = "default"
"""Title of the model `hil fit` should be given when nobody has reasons for another."""

SMOOTH = {"sign_width": 0.01}
"""As in the baselines; so are the filters of all methods but the default, which chooses its own."""

CLASSICAL = SMOOTH | {"filter_columns": False}

METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "OLS": ("rigid-linear", CLASSICAL | {"method": "ols"}),
    "WLS": ("rigid-wls", SMOOTH),
    "ridge": ("rigid-linear", CLASSICAL | {"method": "ridge"}),
    "TLS": ("rigid-linear", CLASSICAL | {"method": "tls"}),
    "IRLS": (
        "rigid-irls",
        CLASSICAL | {"loss": "huber", "exponent": False, "feasible": False},
    ),
    "IRLS, 3 loops": ("rigid-irls", CLASSICAL),
    "LMI": ("rigid-lmi", CLASSICAL),
    "LMI, weighted": ("rigid-lmi", CLASSICAL | {"weighted": True}),
    "DiffNEA": ("rigid-diffnea", SMOOTH),
    DEFAULT: ("rigid-hysteresis", {}),
}
"""Title → estimator and its parameters."""


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A fitted model and what it took.

    Attributes:
        model: Ready to predict.
        cpu_s: CPU time of the fit, filtering included.
    """

    model: RobotEstimator
    cpu_s: float


def unavailable(title: str) -> str:
    """Why a method cannot take part; empty when it can."""
    name = METHODS[title][0]
    try:
        plugins.load(GROUP, name)
    except PluginError as error:
        return f"{name}: {error.message}"
    return ""


def titles(wanted: Sequence[str] = tuple(METHODS)) -> tuple[list[str], dict[str, str]]:
    """Return the methods that can take part, and why the others cannot."""
    reasons = {title: unavailable(title) for title in wanted}
    return [title for title in wanted if not reasons[title]], {
        title: reason for title, reason in reasons.items() if reason
    }


def fitted(title: str, parts: Sequence[Dataset], robot: RobotModel, **changed: Any) -> Fitted:
    """Fit a method to whole trajectories, with one BLAS thread.

    Raises:
        HilError: The data do not allow it.
    """
    name, parameters = METHODS[title]
    model = estimator(name, **(parameters | changed))
    with threadpool_limits(1):
        begin = time.process_time()
        model.fit(Dataset.concatenate(list(parts)), robot)
        cpu_s = time.process_time() - begin
    return Fitted(model, cpu_s)


def left_out(title: str, parts: Sequence[Dataset], robot: RobotModel, **changed: Any) -> float:
    """Mean filtered RMSE on each trajectory of a model fitted to all others, then their mean.

    Raises:
        HilError: The data do not allow it.
    """
    scores = []
    for i, held in enumerate(parts):
        rest = [part for j, part in enumerate(parts) if j != i]
        found = fitted(title, rest, robot, **changed)
        scores.append(errors(found.model, held).mean("rmse_filtered"))
    return float(np.mean(scores))


def errors(model: RobotEstimator, dataset: Dataset) -> Errors:
    """Errors of a model on all rows of a dataset."""
    return evaluate(model, dataset).total


def relative(found: Errors, dataset: Dataset) -> FloatArray:
    """(n,) raw RMSE in per cent of the measured effort's RMS."""
    size: FloatArray = np.sqrt(np.mean(dataset["effort"] ** 2, axis=0))
    return 100.0 * found.rmse_raw / size


def with_gains(dataset: Dataset, gains: FloatArray, source: str) -> Dataset:
    """Return the same samples with other drive gains."""
    return replace(dataset, drive_gains=gains, drive_gains_source=source)


def reason(error: HilError) -> str:
    """Return an error in one line."""
    return str(error.message).splitlines()[0]
