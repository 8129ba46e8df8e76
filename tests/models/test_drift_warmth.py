"""What warmth does to friction, by a model's own law."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hil.core.errors import DataError
from hil.data.dataset import Dataset
from hil.models.drift import friction_change
from tests.support.synthetic_motion import moving

PER_K = np.array([-0.01, 0.0, 0.002, -0.004, -0.01, -0.02])


class Law:
    """A model whose friction goes with temperature by known shares, and by nothing else."""

    estimator = "law"

    def predict(self, data: Dataset) -> SimpleNamespace:
        friction = np.sign(data["qd"]) * (1.0 + PER_K * (data["temperature"] - 20.0))
        valid = np.ones(friction.shape, dtype=bool)
        return SimpleNamespace(valid=valid, components={"friction": friction})


class Silent(Law):
    def predict(self, data: Dataset) -> SimpleNamespace:
        return SimpleNamespace(valid=None, components={})


def test_friction_changes_by_what_the_law_says_between_two_temperatures() -> None:
    found = friction_change(Law(), moving(1), np.full(6, 20.0), 20.0 + np.arange(6.0))
    assert found == pytest.approx(PER_K * np.arange(6.0))


def test_a_model_that_does_not_tell_friction_apart_is_refused() -> None:
    with pytest.raises(DataError, match="which part of its prediction is friction"):
        friction_change(Silent(), moving(1), np.zeros(6), np.ones(6))
