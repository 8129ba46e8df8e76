"""Models whose samples are timed: a mock UR5's, fitted to as little as serves."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np

from benchmarks.identification.mock_gap import observed
from hil.dynamics import load_model
from hil.estimators import estimator
from hil.estimators.base import RobotEstimator
from hil.networks.residual_tcn import TrainedTcn

ARM, SEED = "ur5", 1
TRAJECTORIES, QUICK_TRAJECTORIES = 8, 3
SAYS = 0.2
"""Standard deviation of the last layer's weights, which training begins at 0."""


def models(quick: bool) -> dict[str, RobotEstimator]:
    """By name: friction with `memory`, with a residual `network`, and a `lagrangian` network.

    How long a network takes does not depend on how well it was trained, so neither is.

    Args:
        quick: Little data, less friction, and no Lagrangian network.
    """
    robot = load_model(ARM)
    data = observed(SEED, ARM, QUICK_TRAJECTORIES if quick else TRAJECTORIES).data
    kept = {k: v for k, v in data.columns.items() if k in ("t", "q", "qd", "effort")}
    data = replace(data, columns=kept)
    chosen: dict[str, Any] = {"friction": ["core"], "fit_shapes": False} if quick else {}
    memory = estimator("rigid-hysteresis", consistent=False, **chosen).fit(data, robot)
    found: dict[str, RobotEstimator] = {"memory": memory}
    if find_spec("torch") is None:
        return found
    once = {"epochs": 1, "device": "cpu"}
    base = {"estimator": memory.estimator, "consistent": False, **chosen}
    network: Any = estimator("residual", base=base, training=once)
    found["network"] = _talking(network.fit_on(memory, data, robot))
    if not quick:
        found["lagrangian"] = estimator("lagrangian", training=once).fit(data, robot)
    return found


def _talking(network: Any) -> RobotEstimator:
    """Return the same model with nonzero networks for every joint, so that a comparison counts."""
    correction, random = network.correction_, np.random.default_rng(SEED)
    every = np.ones(len(correction.kept), dtype=bool)
    networks = tuple(_drawn(one, random) for one in correction.networks)
    network.correction_ = replace(correction, kept=every, networks=networks)
    return network  # type: ignore[no-any-return]


def _drawn(network: TrainedTcn, random: np.random.Generator) -> TrainedTcn:
    leave = network.weights.leave
    weights = SAYS * random.standard_normal(leave.shape)
    drawn = replace(network.weights, leave=weights.astype(leave.dtype))
    return replace(network, weights=drawn)
