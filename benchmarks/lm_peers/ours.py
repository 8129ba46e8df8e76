"""Our Levenberg–Marquardt."""

from __future__ import annotations

from typing import Any

from benchmarks.lm_peers.course import LAYERS, Problem, Stopwatch, Terms
from hil.networks.lm import train
from hil.networks.mlp import Mlp


def solve(terms: Terms, rows: Problem, watch: Stopwatch, **settings: Any) -> None:
    """Train to the target; preparing the rows counts."""
    train(
        Mlp(LAYERS), rows.X, rows.y, initial=rows.start[None], epochs=terms.iterations,
        callback=lambda epoch: watch.note(lambda: epoch.train_rmse), **settings,
    )  # fmt: skip
