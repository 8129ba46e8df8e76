"""A small run for the study of inverse dynamics, and networks that need no training."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any, Self

import numpy as np

from hil.core.typing import FloatArray
from hil.data.dataset import Dataset
from hil.data.prediction import Prediction
from hil.dynamics import RobotModel
from hil.estimators.rigid_linear import RigidWls
from hil.networks.residual_selection import Selection
from hil.studies.inverse_methods import ROWS, Row
from tests.support.synthetic_motion import LOAD, moving, raw

SMALL: dict[str, Any] = {
    "cutoff_hz": 20.0,
    "rate_hz": 50.0,
    "seeds": 1,
    "jobs": 1,
    "methods": ["wls", "proposed", "rc-history", "rc-motion"],
}

SAMPLES = 300
"""Of every trajectory, at 100 Hz."""


@cache
def run_of(trajectories: int = 4, *, loaded: bool = True, noise_a: float = 0.05) -> Dataset:
    """Trajectories of a bare UR5, and the same with 2 kg as load 1."""
    seeds = tuple(range(1, trajectories + 1))
    parts = [moving(*seeds, noise_a=noise_a, samples=SAMPLES)]
    if loaded:
        heavy = moving(*seeds, noise_a=noise_a, load=LOAD, samples=SAMPLES)
        conditions = (replace(c, load=1, id=f"{c.id} loaded") for c in heavy.conditions)
        parts.append(replace(heavy, conditions=tuple(conditions)))
    return raw(Dataset.concatenate(parts))


class Toy(RigidWls):
    """Stands for a network: least squares, and a correction that takes a share of what is left."""

    fits = 0
    share = 0.0
    base: Any = None

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """As least squares; counted."""
        type(self).fits += 1
        return super().fit(dataset, robot)

    def fit_on(self, base: Any, dataset: Dataset, robot: RobotModel) -> Self:
        """Nothing is learned: half of the error is known beforehand."""
        self.base, self.share = base, 0.5
        kept = np.arange(robot.n) != 1
        one = np.ones(robot.n)
        self.selection_ = Selection(kept, 0.4 * one, 0.2 * one, one, 0.0)
        return self

    def predict(self, dataset: Dataset) -> Prediction:
        """Least squares, or the base with half of its error taken away."""
        if self.base is None:
            return super().predict(dataset)
        told = self.base.predict(dataset)
        correction: FloatArray = self.share * (dataset["effort_f"] - told.effort)
        parts = {**told.components, "residual": correction}
        std = np.full_like(correction, np.nan)
        return Prediction(told.effort + correction, std, told.valid, parts)


def toys(row: Row, seed: int, sign_width: float, filters: Any, effort: float) -> Any:
    """In the place of `hil.studies.inverse_fits.unfitted`: no row is a network."""
    if ROWS[row.key].learns:
        return Toy(filters=filters, sign_width=sign_width)
    return RigidWls(filters=filters, sign_width=sign_width)
