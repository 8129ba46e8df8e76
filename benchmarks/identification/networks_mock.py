"""Networks and ours on mock robots: what each leaves, beside the noise, and what it knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks.identification import component_truth as components
from benchmarks.identification.mock_gap import (
    CUTOFF_HZ,
    FIT_HZ,
    TRAJECTORIES,
    TRUE,
    observed,
)
from benchmarks.identification.networks_fits import (
    JOBS,
    SIGN_WIDTH,
    computed,
    decided,
    tasks_of,
)
from hil.core.typing import FloatArray
from hil.data.dataset import Dataset
from hil.dynamics import load_model
from hil.estimators.base import RobotEstimator
from hil.studies.dynamic_methods import held_out
from hil.studies.inverse_cases import Case, honest_case, recorded
from hil.studies.inverse_fits import Judged, fitted_family, judged, nothing
from hil.studies.inverse_methods import ONE_TO_SIX, ROWS, unfitted
from hil.studies.tasks import Task
from hil_mock_robot.plant.truth import draw_truth

ARM = "ur5"
PROPOSED, CORRECTED, OURS, PRODUCT = "proposed", "rc-grouped", "ours", "ours-residual"
KEYS = (*ONE_TO_SIX, PROPOSED, CORRECTED, OURS, PRODUCT)
QUICK_KEYS = ("wls", "delan-coulomb", OURS)
QUICK_TRAJECTORIES = 4
KNOWING = ("delan-coulomb", PROPOSED, OURS)
"""Whose parts are set beside the truth."""


@dataclass(frozen=True, slots=True, eq=False)
class Robot:
    """One mock robot, its judged trajectories held out.

    Attributes:
        seed: Which; also of the split and of every network.
        case: What methods are handed and judged on: no column of it is the truth.
        noise, raw_noise: (n,) RMS of the measured torque less the true one, filtered and raw [N·m].
        true: Its parts along the judged motions.
    """

    seed: int
    case: Case
    noise: FloatArray
    raw_noise: FloatArray
    true: components.Parts


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """One method on one robot.

    Attributes:
        judged: Its errors.
        parts: Errors of its parts, where it has any and they are wanted.
        decided: Of a residual network, joint by joint.
    """

    judged: Judged
    parts: components.Errors | None = None
    decided: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Contest:
    """All methods on one robot."""

    seed: int
    told: dict[str, Told]
    noise: FloatArray
    raw_noise: FloatArray

    def error(self, key: str) -> float:
        """Mean filtered RMSE over the joints [N·m]; NaN where a method failed or is not here."""
        if key not in self.told:
            return float("nan")
        return float(np.mean(self.told[key].judged.filtered))

    @property
    def oracle(self) -> float:
        """What the noise alone leaves."""
        return float(np.mean(self.noise))

    @property
    def best(self) -> str:
        """Key of the best of Methods 1 to 6 on the judged trajectories; empty if all failed."""
        known = [key for key in ONE_TO_SIX if np.isfinite(self.error(key))]
        return min(known, key=self.error, default="")

    def left(self, key: str) -> float:
        """Error of a method over that of the best of Methods 1 to 6."""
        return self.error(key) / self.error(self.best)

    def gap_left(self, key: str) -> float:
        """Of the way from the best of Methods 1 to 6 to the oracle, how much is left to go."""
        return (self.error(key) - self.oracle) / (self.error(self.best) - self.oracle)


def contests(
    seeds: Sequence[int], *, quick: bool = False, effort: float = 1.0, jobs: int = JOBS
) -> list[Contest]:
    """One per seed.

    Args:
        seeds: Which robots.
        quick: Few methods on few trajectories.
        effort: Share of the usual epochs.
        jobs: Processes.
    """
    robots = computed([Task(partial(drawn, seed, quick)) for seed in seeds], jobs)
    chosen = QUICK_KEYS if quick else KEYS
    tasks = [task for robot in robots for task in tasks_of(chosen, family, robot, effort)]
    found = computed(tasks, jobs)
    each = len(found) // len(robots)
    return [
        Contest(
            robot.seed,
            {key: one for told in found[i * each : (i + 1) * each] for key, one in told.items()},
            robot.noise,
            robot.raw_noise,
        )
        for i, robot in enumerate(robots)
    ]


def drawn(seed: int, quick: bool = False) -> Robot:
    """Simulate one robot and hold its judged trajectories out."""
    of = observed(seed, ARM, QUICK_TRAJECTORIES if quick else TRAJECTORIES)
    test = held_out(of, seed).test
    measured = _without_truth(of.data)
    case = honest_case(recorded(measured, load_model(ARM), CUTOFF_HZ, FIT_HZ), seed)
    noise, raw = (_rms(test["effort" + f] - test[TRUE + f]) * of.scale for f in ("_f", ""))
    true = components.true_parts(draw_truth(ARM, seed, "full"), test, test[TRUE + "_f"])
    return Robot(seed, case, noise, raw, true)


def family(root: str, keys: Sequence[str], of: Robot, effort: float) -> dict[str, Told]:
    """Fit a model and its correction to one robot, and evaluate both."""
    case = of.case
    case.require_honest()

    def new(key: str) -> RobotEstimator:
        return unfitted(ROWS[key], case.seed, SIGN_WIDTH, case.filters, effort)

    return {
        key: Told(nothing(len(of.noise), why)) if model is None else _told(key, model, of, seconds)
        for key, model, seconds, why in fitted_family(root, keys, new, case.learn, load_model(ARM))
    }


def _told(key: str, model: RobotEstimator, of: Robot, seconds: float) -> Told:
    case = of.case
    parts = None
    if key in KNOWING:
        parts = components.component_errors(model, case.judge, of.true)
    return Told(judged(model, case, seconds), parts, decided(model))


def _without_truth(data: Dataset) -> Dataset:
    kept = {name: values for name, values in data.columns.items() if not name.startswith(TRUE)}
    return replace(data, columns=kept)


def _rms(errors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))
