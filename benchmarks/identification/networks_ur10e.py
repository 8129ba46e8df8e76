"""Networks on the UR10e: four trajectories to learn from, another one of a fortnight later."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks.identification import recordings
from benchmarks.identification.methods import errors
from benchmarks.identification.networks_fits import (
    JOBS,
    SIGN_WIDTH,
    computed,
    decided,
    tasks_of,
)
from hil.core.typing import FloatArray
from hil.data.dataset import Dataset
from hil.data.filters import FilterSettings
from hil.dynamics import load_model
from hil.estimators.base import RobotEstimator, estimator
from hil.studies.inverse_fits import fitted_family
from hil.studies.inverse_methods import DEFAULT_KEYS, ROWS, USUAL_EPOCHS, unfitted
from hil.studies.tasks import Task

ARM = "ur10e"
RIGID = ("wls", "ours")
"""Methods without chance that stand beside the networks."""

PRODUCT = "ours-residual"
KEYS = (*RIGID, *(key for key in DEFAULT_KEYS if ROWS[key].learns))
QUICK_KEYS = ("wls", "delan-coulomb")
SEEDS, QUICK_SEEDS = (0, 1, 2), (0,)
"""Of start weights, mini-batches and what is held out to stop by."""

OWN_FILTERS = ("ours", PRODUCT)
"""Fitted as `hil fit` does, with filters of their own; all others have those of the anchors."""


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """One fit, judged on the whole of 14h50 [A].

    Attributes:
        raw, filtered: (n,) RMSE against the measured current, and that current filtered.
        noise: (n,) measured minus filtered.
        seconds: CPU time.
        decided: Of a residual network, joint by joint.
        protocol: What the model says of what it saw.
        failed: Why there is nothing else.
    """

    raw: FloatArray
    filtered: FloatArray
    noise: FloatArray
    seconds: float
    decided: str = ""
    protocol: str = ""
    failed: str = ""


def scores(
    *,
    quick: bool = False,
    effort: float = 1.0,
    jobs: int = JOBS,
    keys: Sequence[str] | None = None,
    seeds: Sequence[int] | None = None,
) -> dict[str, list[Score]]:
    """By method, one score per seed; one for what knows no chance.

    Args:
        quick: Few methods, one training trajectory, one seed.
        effort: Share of the usual epochs.
        jobs: Processes.
        keys: Of `ROWS`, others than usual.
        seeds: Others than usual.
    """
    train = recordings.ur10e_train()
    learn = Dataset.concatenate(train[:1] if quick else train)
    judge = recordings.ur10e_validation()
    chosen = tuple(keys or (QUICK_KEYS if quick else KEYS))
    draws = tuple(seeds or (QUICK_SEEDS if quick else SEEDS))
    tasks: list[Task] = []
    for seed in draws:
        rows = [key for key in chosen if ROWS[key].learns or seed == draws[0]]
        tasks += tasks_of(rows, family, learn, judge, seed, effort)
    found: dict[str, list[Score]] = {key: [] for key in chosen}
    for told in computed(tasks, jobs):
        for key, score in told.items():
            found[key].append(score)
    return found


def family(
    root: str, keys: Sequence[str], learn: Dataset, judge: Dataset, seed: int, effort: float
) -> dict[str, Score]:
    """Fit a model and its correction, and evaluate both."""
    fits = fitted_family(root, keys, partial(_new, seed=seed, effort=effort), learn,
                         load_model(ARM))  # fmt: skip
    return {
        key: _nothing(judge.n_joints, why) if model is None else _score(model, judge, seconds)
        for key, model, seconds, why in fits
    }


def _new(key: str, seed: int, effort: float) -> RobotEstimator:
    row = ROWS[key]
    if key not in OWN_FILTERS:
        return unfitted(row, seed, SIGN_WIDTH, FilterSettings(), effort)
    chance: dict[str, Any] = {"seed": seed} if row.learns else {}
    if row.learns and effort != 1.0:
        chance["training"] = {"epochs": max(1, round(effort * USUAL_EPOCHS[row.estimator]))}
    return estimator(row.estimator, **row.params, **chance)


def _score(model: RobotEstimator, judge: Dataset, seconds: float) -> Score:
    found = errors(model, judge)
    return Score(
        found.rmse_raw, found.rmse_filtered, found.noise_floor, seconds, decided(model),
        model.protocol,
    )  # fmt: skip


def _nothing(n: int, why: str) -> Score:
    empty = np.full(n, np.nan)
    return Score(empty, empty, empty, float("nan"), failed=why)
