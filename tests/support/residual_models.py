"""A UR5 with dry friction, seen by a physics that smooths it away: much is left to a network."""

from __future__ import annotations

from functools import cache

from hil.data import Dataset
from hil.networks.residual_network import ResidualNetwork
from tests.support.synthetic_motion import moving, nominal

SMOOTH = {"estimator": "rigid-wls", "sign_width": 2.0}
SMALL = {"channels": 6, "dilations": (1, 4), "crop": 32, "split": False}
SHORT = {"epochs": 12, "batch_size": 8, "learning_rate": 1e-2, "warm_up_steps": 5, "device": "cpu"}


@cache
def known() -> Dataset:
    """Four trajectories to learn from."""
    return moving(1, 2, 3, 4, noise_a=0.02)


@cache
def unknown() -> Dataset:
    """Two that nobody has seen."""
    return moving(11, 12, 13, 14, noise_a=0.02)


def unfitted(**changed) -> ResidualNetwork:
    """An estimator that is quick to fit."""
    return ResidualNetwork(
        **{"base": SMOOTH, "network": SMALL, "training": SHORT, "folds": 2} | changed
    )


@cache
def model() -> ResidualNetwork:
    """Fitted to `known`; not to be changed."""
    return unfitted().fit(known(), nominal())
