"""What a training leaves behind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from hil.core import FloatArray
from hil.networks.lm.network import Mlp
from hil.networks.lm.scaling import Scaling


@dataclass(frozen=True, slots=True)
class Epoch:
    """Where one network is after an epoch; errors in the unit of the target.

    Attributes:
        network: Number within the batch.
        epoch: 0 is the start.
        train_rmse: On all training rows, averaged or not.
        validation_rmse: NaN without validation rows.
        damping: That the next step starts with.
    """

    network: int
    epoch: int
    train_rmse: float
    validation_rmse: float
    damping: float


Callback: TypeAlias = Callable[[Epoch], object]


@dataclass(frozen=True, slots=True, eq=False)
class History:
    """How the training of one network went.

    Attributes:
        train_rmse: (E + 1,) in the unit of the target, the start first. Never rises without weight
            decay; with it the sum of both does not, and this may.
        validation_rmse: (E + 1,), NaN without validation rows.
        damping: (E + 1,).
        best_epoch: Whose weights were kept.
        stopped: Why it ended: `epochs`, `patience` (the validation error fell no more),
            `target` (`target_rmse` reached), or `converged` (no step lowers the cost any more).
    """

    train_rmse: FloatArray
    validation_rmse: FloatArray
    damping: FloatArray
    best_epoch: int
    stopped: str

    @staticmethod
    def of(epochs: list[Epoch], best_epoch: int, stopped: str) -> History:
        """From the epochs of one network."""
        columns = np.array([(e.train_rmse, e.validation_rmse, e.damping) for e in epochs])
        return History(columns[:, 0], columns[:, 1], columns[:, 2], best_epoch, stopped)

    @property
    def epochs(self) -> int:
        """Epochs done, the start not counted."""
        return len(self.train_rmse) - 1

    @property
    def final_train_rmse(self) -> float:
        """Of the weights that were kept."""
        return float(self.train_rmse[self.best_epoch])

    @property
    def final_validation_rmse(self) -> float:
        """Of the weights that were kept; NaN without validation rows."""
        return float(self.validation_rmse[self.best_epoch])


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """B trained networks of one layout.

    Attributes:
        mlp: Their layout.
        weights: (B, P), for standardised inputs and targets.
        scaling: From and to the units of the data.
        histories: How each was trained.
    """

    mlp: Mlp
    weights: FloatArray
    scaling: Scaling
    histories: tuple[History, ...] = ()

    def predict(self, X: FloatArray) -> FloatArray:
        """(N, B) outputs for inputs (N, d) or (B, N, d), in the unit of the targets."""
        return self.scaling.outputs(self.mlp.predict(self.weights, self.scaling.inputs(X)))
