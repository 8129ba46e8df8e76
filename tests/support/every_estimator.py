"""A small case of every registered estimator: parameters, data to fit and to predict, models.

Fits are shared: what `fitted` returns is not to be changed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import pytest

from hil.core import plugins
from hil.data import Dataset
from hil.estimators import GROUP, RobotEstimator
from tests.support.synthetic_motion import arriving, moving, nominal

EXACT = 1e-9
SINGLE = 1e-5
"""Networks predict in single precision [A]."""

TRAINING = {"epochs": 1, "batch_size": 300, "device": "cpu"}
LAGRANGIAN: Mapping[str, Any] = {"network": {"hidden": [8, 8]}, "training": TRAINING}
RESIDUAL: Mapping[str, Any] = {
    "base": {"estimator": "rigid-wls", "sign_width": 2.0},
    "network": {"channels": 4, "dilations": (1, 4), "crop": 32, "split": False},
    "training": {
        "epochs": 5, "batch_size": 8, "learning_rate": 1e-2, "warm_up_steps": 5, "device": "cpu",
    },
    "folds": 2,
    "margin": 0.0,
}  # fmt: skip
"""Enough for the network of some joint to be kept."""
FIXED = {"fit_shapes": False, "consistent": False}


@dataclass(frozen=True)
class Case:
    """An estimator with parameters.

    Attributes:
        params: What differs from the defaults.
        stream: By how much a stream may differ from a prediction [A]; None if there is no stream.
        thorough: Whether the fit takes seconds.
    """

    params: Mapping[str, Any] = field(default_factory=dict)
    stream: float | None = EXACT
    thorough: bool = False


CASES: Mapping[str, Case] = {
    "rigid-wls": Case(),
    "rigid-linear": Case(),
    "rigid-linear ols": Case({"method": "ols"}),
    "rigid-linear ridge": Case({"method": "ridge"}),
    "rigid-linear tls": Case({"method": "tls"}),
    "rigid-lmi": Case(),
    "rigid-lmi weighted": Case({"weighted": True}),
    "rigid-irls": Case({"exponent": False, "feasible": False}),
    "rigid-irls full": Case(thorough=True),
    "rigid-diffnea": Case({"friction": "coulomb-viscous"}),
    "rigid-diffnea stribeck": Case({"friction": "stribeck"}, thorough=True),
    # The path is the integral of the velocity for one, differences of positions for the other.
    "rigid-diffnea memory": Case({"friction": "memory"}, 1e-3, thorough=True),
    # A prediction filters friction as the effort was, a stream does not.
    "rigid-hysteresis": Case({"friction": ("load", "speed p", "memory 30"), **FIXED}, 0.1),
    "rigid-hysteresis full": Case({}, 0.1, thorough=True),
    "static-wls": Case(),
    "static-wls paper": Case({"form": "paper"}),
    "static-wls current": Case({"form": "paper", "current_term": True}, None),
    "static-linear": Case(),
    "static-linear shared": Case({"form": "shared", "method": "wls"}),
    "static-linear lasso": Case({"method": "lasso"}),
    "static-inverse": Case(),
    "static-inverse shared": Case({"form": "shared"}),
    "static-coulomb": Case(),
    "static-hysteresis": Case({"lengths_rad": [1e-4, 3e-4]}),
    "static-mlp-lm": Case({"layers": (4, 3, 1), "epochs": 2}),
    "static-mlp-lm sided": Case(
        {
            "layers": (5, 3, 1),
            "inputs": ["q2", "q3", "q4", "q5", "approach"],
            "activations": ["linear", "linear"],
            "epochs": 2,
        },
        None,
    ),
    "lagrangian": Case(LAGRANGIAN, SINGLE),
    "lagrangian memory": Case({**LAGRANGIAN, "direction": "dahl"}, 2e-3),
    "lagrangian dissipative": Case({**LAGRANGIAN, "friction": "dissipative"}, SINGLE),
    "lagrangian coulomb": Case({**LAGRANGIAN, "friction": "coulomb"}, SINGLE, thorough=True),
    "lagrangian unconstrained": Case(
        {**LAGRANGIAN, "friction": "unconstrained"}, SINGLE, thorough=True
    ),
    "lagrangian none": Case({**LAGRANGIAN, "friction": "none"}, SINGLE, thorough=True),
    "residual": Case(RESIDUAL, SINGLE),
    "residual on a network": Case(
        {**RESIDUAL, "base": {"estimator": "lagrangian", **LAGRANGIAN}}, 1e-4
    ),
    "residual history": Case({**RESIDUAL, "inputs": "history"}, None),
}
"""Name of the estimator, with a word where there are several cases of it."""

NETWORKS = ("lagrangian", "residual")
"""Estimators that need torch."""


@cache
def kind_of(name: str) -> type[RobotEstimator]:
    """The class registered under a name; entry points are looked up once."""
    kind: type[RobotEstimator] = plugins.load(GROUP, name)
    return kind


def unfitted(case: str) -> RobotEstimator:
    """An estimator by its name in `CASES`."""
    name = case.split()[0]
    if name in NETWORKS:
        pytest.importorskip("torch", reason="torch is not installed")
    return kind_of(name)(**CASES[case].params)


@cache
def fitted(case: str) -> RobotEstimator:
    """The same, fitted."""
    return unfitted(case).fit(known(case), nominal())


def at_rest(case: str) -> bool:
    """Whether it learns from dwells."""
    return case.startswith("static")


@cache
def _data(rest: bool, new: bool) -> Dataset:
    if rest:
        return arriving(10, seed=5) if new else arriving(40, seed=1, load_share=0.05)
    return moving(9, samples=200) if new else moving(1, 2, 3, samples=300, noise_a=0.02)


def known(case: str) -> Dataset:
    """What it was fitted to."""
    return _data(at_rest(case), new=False)


def new(case: str) -> Dataset:
    """What it has not seen."""
    return _data(at_rest(case), new=True)
