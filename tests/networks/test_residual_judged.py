"""Left-out rows judge a correction as predictions give it: within its limits."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.core.typing import FloatArray
from hil.networks.residual_data import Motions, ResidualSettings
from hil.networks.residual_selection import NO_FOLD, Judged, Learnt, Physics
from tests.support.residual_models import known


class Wild:
    """A network that knows all that is left, but shouts now and then."""

    settings = ResidualSettings()

    def __init__(self, left: FloatArray) -> None:
        self.said = left.copy()
        self.said[::100] *= 1e3

    def predict(self, motions: Motions) -> FloatArray:
        return self.said


def verdict() -> tuple[Judged, FloatArray, FloatArray]:
    """The verdict on such a network, what the physics left, and what predictions add to it."""
    data, everything = known(), np.ones(len(known()), dtype=bool)
    left = np.random.default_rng(5).normal(size=data["effort_f"].shape)
    physics: Any = None
    predicted = data["effort_f"] - left
    of = Physics(physics, predicted, everything, np.full(len(data), NO_FOLD))
    network: Any = Wild(left)
    learnt = Learnt((network,), network.said, everything, everything, ())
    found = Judged.of(data, of, learnt, margin=0.02, coverage=0.9)
    return found, left, found.correction.predict(data, predicted)


def test_what_no_prediction_says_does_not_cost_a_joint_its_network() -> None:
    found, left, _ = verdict()
    assert found.selection.kept.all()
    assert np.allclose(found.correction.limit, np.max(np.abs(left), axis=0))


def test_the_errors_told_are_those_of_predictions() -> None:
    found, left, added = verdict()
    errors = np.sqrt(np.mean((left - added) ** 2, axis=0))
    assert np.allclose(found.selection.corrected, errors)
    raw = known()["effort"] - known()["effort_f"] + left - added
    assert np.allclose(found.sigma, np.sqrt(np.mean(raw**2, axis=0)))
