"""What a model keeps of the training of its networks, and the poses that stop it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from hil.core import DataError, FitError, FloatArray
from hil.data import Dataset, split
from hil.networks.lm.network import Mlp
from hil.networks.lm.scaling import Scaling
from hil.networks.lm.trained import History, Trained

_SCALING = tuple(each.name for each in fields(Scaling))


@dataclass(frozen=True, slots=True)
class NetworkResult:
    """How the training of one joint's network went, as `model.json` keeps it.

    Attributes:
        epochs: Done.
        best_epoch: Whose weights were kept.
        stopped: Why it ended, see `hil.networks.lm.trained.History`.
        train_rmse, validation_rmse: Of the weights kept, over all rows, in effort units; None
            without validation poses.
    """

    epochs: int
    best_epoch: int
    stopped: str
    train_rmse: float
    validation_rmse: float | None

    @staticmethod
    def of(history: History) -> NetworkResult:
        """From the history of a training."""
        held_out = history.final_validation_rmse
        return NetworkResult(
            history.epochs, history.best_epoch, history.stopped, history.final_train_rmse,
            held_out if np.isfinite(held_out) else None,
        )  # fmt: skip

    @staticmethod
    def restored(fact: dict[str, Any]) -> NetworkResult:
        """From what `model.json` says of one network."""
        return NetworkResult(**{each.name: fact[each.name] for each in fields(NetworkResult)})


def arrays_of(networks: Trained) -> dict[str, FloatArray]:
    """Weights and scaling, by their names in a model file."""
    scaling = {name: getattr(networks.scaling, name) for name in _SCALING}
    arrays = {"weights": networks.weights, **scaling}
    return {f"network.{name}": values for name, values in arrays.items()}


def networks_from(mlp: Mlp, arrays: dict[str, FloatArray]) -> Trained:
    """Inverse of `arrays_of`; how the training went is not in it."""
    scaling = Scaling(**{name: arrays[f"network.{name}"] for name in _SCALING})
    return Trained(mlp, arrays["network.weights"], scaling)


def held_out_poses(dwells: Dataset, percent: float, seed: int) -> tuple[Dataset, Dataset | None]:
    """Dwells to train on, and those of whole poses to stop by; None with 0 %.

    Raises:
        FitError: There are not enough poses.
    """
    if percent == 0:
        return dwells, None
    try:
        parts = split(dwells, "pose", percent / 100.0, seed)
    except DataError as error:
        raise FitError(
            f"no poses can be held out to stop the training by: {error.message}",
            hint="give more poses, or validation_percent: 0",
        ) from error
    return parts.train, parts.test
