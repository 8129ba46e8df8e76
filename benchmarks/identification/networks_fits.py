"""Fits of the networks' benchmark: rows of the study of inverse dynamics, each in a task."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from hil.data.dataset import Dataset
from hil.dynamics import RobotModel
from hil.errors import HilError
from hil.identify.base import RobotEstimator
from hil.study.base import silent
from hil.study.inverse_fits import COSTS
from hil.study.inverse_methods import ROWS, families
from hil.study.separation_tasks import Task, run_tasks

SIGN_WIDTH = 0.01

JOBS = 2

Fitted = tuple[str, RobotEstimator | None, float, str]
"""Key of a row, its model or None, CPU seconds with those of the model it corrects, and why."""

New = Callable[[str], RobotEstimator]


def fitted_family(
    root: str, keys: Sequence[str], new: New, learn: Dataset, robot: RobotModel
) -> Iterator[Fitted]:
    """The model `root`, and whatever corrects it; a failure is told, not raised.

    Args:
        root: Key of `ROWS` with a model of its own.
        keys: Wanted, of those that need it.
        new: Makes an unfitted estimator by its key.
        learn: To fit to.
        robot: Model of the arm.
    """
    base, seconds, why = _tried(lambda: new(root).fit(learn, robot))
    for key in keys:
        if key == root or base is None:
            yield key, base, seconds, why
            continue
        correction: Any = new(key)
        model, more, failed = _tried(partial(correction.fit_on, base, learn, robot))
        yield key, model, seconds + more, failed


def tasks_of(chosen: Sequence[str], family: Callable[..., Any], *given: Any) -> list[Task]:
    """A task per family of rows.

    Args:
        chosen: Keys of `ROWS`.
        family: Told the root of a family, its keys, and what is given.
        *given: Able to travel to another process.
    """
    return [
        Task(
            partial(family, root, keys, *given),
            sum(COSTS.get(ROWS[key].estimator, 1.0) for key in {root, *keys}),
        )
        for root, keys in families(chosen).items()
    ]


def computed(tasks: Sequence[Task], jobs: int) -> list[Any]:
    """Results of the tasks, in their order, from processes of their own."""
    return run_tasks(tasks, jobs, "fits", silent)


def decided(model: RobotEstimator) -> str:
    """Which joints keep their residual network; empty for anything else."""
    selection = getattr(model, "selection_", None)
    if selection is None:
        return ""
    return " ".join(
        f"{name}:{'kept' if one['kept'] else 'dropped'} {one['without']:.3g}→{one['with']:.3g}"
        for name, one in zip(model.joint_names_, selection.facts(model.joint_names_), strict=True)
    )


def _tried(fit: Callable[[], Any]) -> tuple[Any, float, str]:
    """What is fitted or None, CPU seconds, and why there is nothing."""
    begin = time.process_time()
    try:
        return fit(), time.process_time() - begin, ""
    except HilError as error:
        return None, float("nan"), str(error.message).splitlines()[0]
