"""Networks that are trained for an epoch, for tests of what they refuse."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from hil.data import Dataset
from hil.estimators import estimator
from hil.estimators.base import RobotEstimator
from tests.support.synthetic_motion import moving, nominal

TRAINING = {"epochs": 1, "batch_size": 300, "device": "cpu"}
PHYSICS = {"estimator": "rigid-wls", "sign_width": 2.0}
TCN = {"channels": 2, "dilations": (1, 4), "crop": 16, "split": False}

LAGRANGIAN = {"network": {"hidden": [8, 8]}, "training": TRAINING}
RESIDUAL = {"base": PHYSICS, "network": TCN, "training": TRAINING, "folds": 2, "margin": 0.0}
NETWORKS = {
    "lagrangian": ("lagrangian", LAGRANGIAN),
    "memory": ("lagrangian", {**LAGRANGIAN, "direction": "dahl"}),
    "dissipative": ("lagrangian", {**LAGRANGIAN, "friction": "dissipative"}),
    "residual": ("residual", RESIDUAL),
    "on a network": ("residual", {**RESIDUAL, "base": {"estimator": "lagrangian", **LAGRANGIAN}}),
}


def unfitted(name: str) -> RobotEstimator:
    """An estimator by its name in `NETWORKS`."""
    kind, params = NETWORKS[name]
    return estimator(kind, **params)


@cache
def fitted(name: str) -> RobotEstimator:
    """The same, fitted; not to be changed."""
    return unfitted(name).fit(moving(1, 2, 3, noise_a=0.02), nominal())


def recorded(*seeds: int, **changed) -> Dataset:
    """As recorded: nothing is filtered yet."""
    data = moving(*seeds, **changed)
    raw = {name: v for name, v in data.columns.items() if not name.endswith("_f")}
    return replace(data, columns=raw)


def spoilt(data: Dataset, column: str, value: float, rows: slice = slice(30, 31)) -> Dataset:
    """One value (or several rows) of a column replaced, in the third joint."""
    values = np.array(data[column])
    values[(rows, 2) if values.ndim == 2 else rows] = value
    return data.with_columns(**{column: values})
