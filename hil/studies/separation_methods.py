"""The methods an honest comparison sets side by side, and one fit of one of them.

All of them see the same dwells and are judged on the same poses. Whatever is tuned is tuned inside
the training poses: the epoch at which networks stop and their weight decay by poses held out from
the training, the strength of the hysteresis model's correction by folds of its own.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from hil.core import FloatArray, HilError
from hil.data import Dataset
from hil.dynamics import RobotModel
from hil.estimators import estimator
from hil.networks import ConstantInputWarning
from hil.studies.separation_data import dwell_means
from hil.studies.separation_tasks import Task

WEIGHT_DECAYS = (0.0, 1e-4, 1e-3)
"""Candidates for the networks."""

NETWORK_COST = 10.0
"""Seconds that six networks take until they stop, about."""


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

    def candidates(self) -> tuple[Method, ...]:
        """One for each entry of the grid."""
        return tuple(
            replace(self, params={**self.params, **chosen}, grid=(chosen,)) for chosen in self.grid
        )


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
            {**network, "inputs": angles, "layers": list(layout)}, decays, NETWORK_COST,
        ),
        Method(
            "network-approach", "gravity + network of q2…q5, approach", "static-mlp-lm",
            {**network, **with_approach}, decays, NETWORK_COST,
        ),
        Method("hysteresis", "ours: friction with memory", "static-hysteresis"),
    )  # fmt: skip
    return {method.key: method for method in found}


METHOD_KEYS = tuple(known_methods(alpha=0.001, weights="paper", layout=(4, 1), epochs=1, seed=0))


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What one fit of one method says about the dwells it was not fitted to.

    Attributes:
        effort: (S, n) mean over each dwell; NaN where the model cannot say.
        std: (S, n) one standard deviation of that, NaN where the model cannot say.
        own_error: What the model itself found on poses it held out within its training, mean over
            the joints; of its training where it held out none.
        seconds: The fit took, of one core.
        failed: Why there is nothing, in words; empty when there is.
        chosen: The candidate of the method's grid, in words; empty with only one.
    """

    effort: FloatArray
    std: FloatArray
    own_error: float = np.inf
    seconds: float = 0.0
    failed: str = ""
    chosen: str = ""


def fit_tasks(method: Method, train: Dataset, test: Dataset, robot: RobotModel) -> list[Task]:
    """Fit every candidate of a method to some dwells and predict others."""
    return [
        Task(partial(_fitted, candidate, train, test, robot), candidate.cost)
        for candidate in method.candidates()
    ]


def best_of(outcomes: Sequence[Outcome]) -> Outcome:
    """The candidate with the least error of its own; the time of all of them."""
    best = min(outcomes, key=lambda outcome: outcome.own_error)
    return replace(best, seconds=sum(outcome.seconds for outcome in outcomes))


def _fitted(method: Method, train: Dataset, test: Dataset, robot: RobotModel) -> Outcome:
    nothing = np.full((len(test.conditions), test.n_joints), np.nan)
    begin = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConstantInputWarning)
            model = estimator(method.estimator, **method.params).fit(train, robot)
        seconds = time.process_time() - begin
        predicted = model.predict(test)
    except HilError as error:
        return Outcome(nothing, nothing, failed=error.message)
    # Estimators are plug-ins: one that breaks down must not cost the hour the others took.
    except Exception as error:
        words = f"it broke down: {type(error).__name__}: {error}"
        return Outcome(nothing, nothing, failed=words)
    effort = dwell_means(test, np.where(predicted.valid, predicted.effort, np.nan))
    std = dwell_means(test, np.array(predicted.std))
    chosen = ", ".join(f"{name} {value:g}" for name, value in method.grid[0].items())
    return Outcome(effort, std, float(np.mean(model.sigma_)), seconds, "", chosen)
