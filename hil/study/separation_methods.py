"""The methods an honest comparison sets side by side, and one fit of one of them.

All of them see the same dwells and are judged on the same poses. Whatever is tuned is tuned inside
the training poses: the epoch at which networks stop and their weight decay by poses held out from
the training, the strength of the hysteresis model's correction by folds of its own.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from hil.data.dataset import Dataset
from hil.dynamics import RobotModel
from hil.errors import HilError
from hil.identify.base import RobotEstimator, estimator
from hil.identify.lm.scaling import ConstantInputWarning
from hil.study.separation_data import dwell_means
from hil.study.separation_tasks import Task
from hil.typing import FloatArray

WEIGHT_DECAYS = (0.0, 1e-4, 1e-3)
"""Candidates for the networks."""


@dataclass(frozen=True, slots=True)
class Method:
    """A way to predict the current of a dwell.

    Attributes:
        key: In the spec.
        words: In tables.
        estimator: Name it is registered under.
        params: Of the estimator.
        grid: Further parameters to choose among by the poses a network holds out.
        cost: How long a fit takes compared with others.
    """

    key: str
    words: str
    estimator: str
    params: Mapping[str, Any] = field(default_factory=dict)
    grid: tuple[Mapping[str, Any], ...] = ({},)
    cost: float = 1.0


def known_methods(
    *, alpha: float, weights: str, layout: tuple[int, ...], epochs: int, seed: int
) -> dict[str, Method]:
    """All methods by key, gravity alone first and ours last."""
    linear = {"alpha": alpha}
    decays = tuple({"weight_decay": decay} for decay in WEIGHT_DECAYS)
    network = {"epochs": epochs, "seed": seed}
    angles = ["q2", "q3", "q4", "q5"]
    with_approach = {"inputs": [*angles, "approach"], "layers": [5, *layout[1:]]}
    found = (
        Method("gravity", "gravity by WLS, shared", "static-wls"),
        Method("gravity-paper", "gravity by WLS, eq. 15", "static-wls", {"form": "paper"}),
        Method("ls", "least squares", "static-linear", {"method": "ls"}),
        Method("ridge", "ridge", "static-linear", {"method": "ridge", **linear}),
        Method("lasso", "LASSO", "static-linear", {"method": "lasso", **linear}),
        Method("elastic-net", "elastic net", "static-linear", {"method": "elastic-net", **linear}),
        Method("wls", "WLS", "static-linear", {"method": "wls", "weights": weights}),
        Method("inverse", "eq. 16 inverted", "static-inverse"),
        Method("coulomb", "gravity + Fc·sign(approach)", "static-coulomb"),
        Method(
            "network", "gravity + network of q2…q5", "static-mlp-lm",
            {**network, "inputs": angles, "layers": list(layout)}, decays, 100.0,
        ),
        Method(
            "network-approach", "gravity + network of q2…q5, approach", "static-mlp-lm",
            {**network, **with_approach}, decays, 100.0,
        ),
        Method("hysteresis", "ours: friction with memory", "static-hysteresis", cost=5.0),
    )  # fmt: skip
    return {method.key: method for method in found}


METHOD_KEYS = tuple(known_methods(alpha=0.001, weights="paper", layout=(4, 1), epochs=1, seed=0))


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What one fit of one method says about the dwells it was not fitted to.

    Attributes:
        effort: (S, n) mean over each dwell; NaN where the model cannot say.
        std: (S, n) one standard deviation of that, NaN where the model cannot say.
        seconds: The fit took, tuning included.
        failed: Why there is nothing, in words; empty when there is.
        chosen: What was chosen from the method's grid, in words.
    """

    effort: FloatArray
    std: FloatArray
    seconds: float = 0.0
    failed: str = ""
    chosen: str = ""


def fit_task(method: Method, train: Dataset, test: Dataset, robot: RobotModel) -> Task:
    """Fit a method to some dwells and predict others."""
    return Task(partial(_fitted, method, train, test, robot), method.cost)


def _fitted(method: Method, train: Dataset, test: Dataset, robot: RobotModel) -> Outcome:
    nothing = np.full((len(test.conditions), test.n_joints), np.nan)
    begin = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConstantInputWarning)
            model, chosen = _best(method, train, robot)
        seconds = time.perf_counter() - begin
        predicted = model.predict(test)
    except HilError as error:
        return Outcome(nothing, nothing, failed=error.message)
    effort = dwell_means(test, np.where(predicted.valid, predicted.effort, np.nan))
    return Outcome(effort, dwell_means(test, np.array(predicted.std)), seconds, "", chosen)


def _best(method: Method, train: Dataset, robot: RobotModel) -> tuple[RobotEstimator, str]:
    """The candidate of the grid with the least error at the poses it held out itself."""
    fitted = [
        estimator(method.estimator, **{**method.params, **candidate}).fit(train, robot)
        for candidate in method.grid
    ]
    if len(fitted) == 1:
        return fitted[0], ""
    errors = [float(np.mean(model.sigma_)) for model in fitted]
    best = int(np.argmin(errors))
    chosen = ", ".join(f"{name} {value:g}" for name, value in method.grid[best].items())
    return fitted[best], chosen
