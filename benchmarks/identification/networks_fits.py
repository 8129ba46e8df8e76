"""Fits of the networks' benchmark: rows of the study of inverse dynamics, each in a task."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from hil.estimators.base import RobotEstimator
from hil.studies.base import silent
from hil.studies.inverse_fits import COSTS
from hil.studies.inverse_methods import ROWS, families
from hil.studies.tasks import Task, run_tasks

SIGN_WIDTH = 0.01

JOBS = 2


def tasks_of(chosen: Sequence[str], family: Callable[..., Any], *given: Any) -> list[Task]:
    """Return one task per family of rows.

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
        f"J{j}:{'kept' if one['kept'] else 'dropped'} {one['without']:.3g}→{one['with']:.3g}"
        for j, one in enumerate(selection.facts(model.joint_names_), start=1)
    )
