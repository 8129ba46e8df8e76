"""Training networks on what physics leaves; every trajectory is judged by one unaware of it.

With folds there is a network for each: it learns from the others and stops by its own, and says
what it would correct there. What predicts later is the mean of them all. Without folds there is
one network, with trajectories of its own to stop by.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hil.core import BoolArray, DataError, FitError, FloatArray, IntArray
from hil.data import AT_REST, Dataset, group_of, learn_and_validate
from hil.networks.residual.motions import Motions, one_rate
from hil.networks.residual.out_of_fold import Physics
from hil.networks.residual.settings import ResidualSettings
from hil.networks.residual.trained import TrainedTcn
from hil.networks.training import Curves, TrainingSettings, Watch, joint_stages, unwatched


@dataclass(frozen=True, slots=True, eq=False)
class Learnt:
    """Trained networks, and what each said of rows it had not learned from.

    Attributes:
        networks: One per fold, or one.
        correction: (N, n) what they add to rows they were stopped by, in effort units.
        judged: (N,) these rows.
        used: (N,) rows that any of them learned from or was stopped by.
        curves: How each training went.
    """

    networks: tuple[TrainedTcn, ...]
    correction: FloatArray
    judged: BoolArray
    used: BoolArray
    curves: tuple[Curves, ...]


@dataclass(frozen=True, slots=True)
class Course:
    """How networks are trained.

    Attributes:
        network: What they see, and how large they are.
        training: Steps, batches, when to stop.
        validation_share: Of the trajectories, to stop by where there are no folds.
        seed: Of start weights, mini-batches and held-out trajectories.
        watch: Told every epoch.
        checkpoints: Folder to keep the training in.
    """

    network: ResidualSettings
    training: TrainingSettings
    validation_share: float
    seed: int
    watch: Watch | None
    checkpoints: Path | None


def learn(data: Dataset, physics: Physics, course: Course) -> Learnt:
    """Train networks on filtered data at the full recorded rate.

    Args:
        data: All rows, prepared; none left out.
        physics: What is corrected.
        course: How.

    Raises:
        FitError: Training diverged, or there is nothing to learn from or to stop by.
        DataError: Series are sampled at different rates, or the torque to be heard is missing.
        PluginError: The extra `learn` is missing.
    """
    motions = Motions.of(data, physics.predicted, course.network)
    residual = data["effort_f"] - physics.predicted
    usable = physics.valid & in_motion(data)
    correction = np.zeros_like(residual)
    judged, used = (np.zeros(len(data), dtype=bool) for _ in range(2))
    networks, curves = [], []
    for number, (fit, stop) in enumerate(_rounds(data, physics.fold, course)):
        _require_rows(fit & usable, stop & usable)
        network, curve = _train(motions, residual, fit & usable, stop & usable, course, number)
        held = stop & usable
        correction[held] = network.predict(motions)[held]
        judged |= held
        used |= held | (fit & usable)
        networks.append(network)
        curves.append(curve)
    return Learnt(tuple(networks), correction, judged, used, tuple(curves))


def in_motion(data: Dataset) -> BoolArray:
    """(N,) rows of series that move: networks know nothing of arms at rest."""
    moving = np.zeros(len(data), dtype=bool)
    for condition, rows in data.slices():
        moving[rows] = condition.kind not in AT_REST
    return moving


def trajectory_numbers(data: Dataset) -> IntArray:
    """(N,) number of the trajectory of every row, the same whatever the load."""
    known = [group_of(condition, "trajectory") for condition in data.conditions]
    keys = [("series", i) if group is None else group for i, group in enumerate(known)]
    numbers = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    return np.array([numbers[key] for key in keys], dtype=np.int64)[data.series_index()]


def _rounds(data: Dataset, fold: IntArray, course: Course) -> Iterator[tuple[BoolArray, BoolArray]]:
    """Rows to learn from and rows to stop by, once per network."""
    numbers = np.unique(fold[fold >= 0])
    if len(numbers) < 2:
        yield learn_and_validate(data, course.validation_share, course.seed)
        return
    for number in numbers:
        yield (fold >= 0) & (fold != number), fold == number


def _train(
    motions: Motions,
    residual: FloatArray,
    fit: BoolArray,
    stop: BoolArray,
    course: Course,
    number: int,
) -> tuple[TrainedTcn, Curves]:
    from hil.networks.residual.problem import ResidualProblem
    from hil.networks.training_loop import torch_device, torch_dtype, train

    settings = course.training.model_copy(update={"seed": course.seed + number})
    problem = ResidualProblem(
        motions,
        residual,
        fit,
        stop,
        course.network,
        loss=settings.loss,
        seed=settings.seed,
        device=torch_device(settings.device),
        dtype=torch_dtype(settings.precision),
    )
    kept = None if course.checkpoints is None else course.checkpoints / f"network-{number + 1}"
    curves = train(
        problem, joint_stages(settings, "residual"), settings, course.watch or unwatched, kept
    )
    return problem.trained(), curves


def _require_rows(fit: BoolArray, stop: BoolArray) -> None:
    for rows, what in ((fit, "to learn from"), (stop, "to stop by")):
        if not np.any(rows):
            raise FitError(
                f"the residual network has no rows {what} for which the physics is valid",
                hint="give at least two trajectories, or one that is longer",
            )


def require_one_rate(data: Dataset) -> None:
    """Refuse series sampled at different rates: a network's memory counts samples.

    Raises:
        FitError: Two series differ by more than 5 %, or nothing moves.
    """
    try:
        one_rate(data)
    except DataError as error:
        raise FitError(error.message, hint=error.hint) from error
