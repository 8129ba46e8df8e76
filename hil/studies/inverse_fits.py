"""The fits of one case: a model, and the networks that correct it, in one task."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

from hil.core import HilError, plugins
from hil.data import Dataset
from hil.dynamics import RobotModel
from hil.estimators import GROUP, RobotEstimator, estimator
from hil.studies.inverse_cases import Case
from hil.studies.inverse_methods import ROWS, Row, unfitted
from hil.studies.inverse_score import Judged, judged, nothing
from hil.studies.separation_tasks import Task

COSTS = {"lagrangian": 10.0, "rigid-hysteresis": 8.0, "residual": 8.0, "rigid-irls": 2.0}
"""How long fits take compared with the others: the longest begin first."""

New = Callable[[str], RobotEstimator]

Fitted = tuple[str, RobotEstimator | None, float, str]
"""Key of a row, its model or None, CPU seconds with those of the model it corrects, and why."""


def missing(row: Row) -> str:
    """Name of an estimator that the row needs and no distribution has here; empty if all are."""
    needed = [row.estimator, *([ROWS[row.on].estimator] if row.on else [])]
    known = plugins.names(GROUP)
    return next((name for name in needed if name not in known), "")


def extras_of(keys: Sequence[str]) -> dict[str, str]:
    """Extras that rows need, with these rows and those that do without (`Study.extras`)."""
    needing: dict[str, list[str]] = {}
    for key in (key for key in keys if not missing(ROWS[key])):
        rows = [ROWS[one] for one in (key, ROWS[key].on) if one]
        for extra in {e for row in rows for e in estimator(row.estimator, **row.params).extras()}:
            needing.setdefault(extra, []).append(key)
    return {extra: _for_rows(of, keys) for extra, of in needing.items()}


def _for_rows(needing: Sequence[str], keys: Sequence[str]) -> str:
    others = [key for key in keys if key not in needing]
    without = f"; methods: [{', '.join(others)}] do without" if others else ""
    return f"for its rows {', '.join(needing)}{without}"


def family_task(
    root: str, keys: Sequence[str], case: Case, robot: RobotModel, sign_width: float, effort: float
) -> Task:
    """Fit the model `root` and whatever corrects it; the result is a `Judged` by key of `keys`."""
    cost = sum(COSTS.get(ROWS[key].estimator, 1.0) for key in {root, *keys})
    name = f"{ROWS[root].estimator} ({', '.join(keys)}), {case.protocol}, seed {case.seed}"
    run = partial(fit_family, root, tuple(keys), case, robot, sign_width, effort)
    return Task(run, cost, name, _failed)


def _failed(found: Mapping[str, Judged]) -> str:
    """What of a family failed, as `Ended` tells it."""
    failed = [key for key, one in found.items() if one.failed]
    if len(failed) == len(found):
        return "failed"
    return f"without {', '.join(failed)}, which failed" if failed else ""


def fit_family(
    root: str, keys: Sequence[str], case: Case, robot: RobotModel, sign_width: float, effort: float
) -> dict[str, Judged]:
    """As `family_task` says; a failure is told, not raised, except that of a dishonest case.

    Raises:
        DataError: Judged rows are among those to learn from.
    """
    case.require_honest()

    def new(key: str) -> RobotEstimator:
        return unfitted(ROWS[key], case.seed, sign_width, case.filters, effort)

    return {
        key: nothing(robot.n, failed) if model is None else _judged(model, case, robot, seconds)
        for key, model, seconds, failed in fitted_family(root, keys, new, case.learn, robot)
    }


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
    base, seconds, failed = _timed(lambda: new(root).fit(learn, robot))
    for key in keys:
        if key == root or base is None:
            yield key, base, seconds, failed
            continue
        model, more, why = _timed(partial(_corrected, new, key, base, learn, robot))
        yield key, model, seconds + more, why


def _corrected(
    new: New, key: str, base: RobotEstimator, learn: Dataset, robot: RobotModel
) -> RobotEstimator:
    correction: Any = new(key)
    fitted: RobotEstimator = correction.fit_on(base, learn, robot)
    return fitted


def _judged(model: RobotEstimator, case: Case, robot: RobotModel, seconds: float) -> Judged:
    found, failed = _tried(lambda: judged(model, case, seconds))
    return nothing(robot.n, failed) if found is None else found


def _timed(fit: Callable[[], RobotEstimator]) -> tuple[RobotEstimator | None, float, str]:
    """What is fitted or None, CPU seconds, and why there is nothing."""
    begin = time.process_time()
    model, failed = _tried(fit)
    return model, time.process_time() - begin, failed


def _tried(make: Callable[[], Any]) -> tuple[Any, str]:
    """What is made, or None and why."""
    try:
        return make(), ""
    except HilError as error:
        return None, error.message
    # Estimators are plug-ins: one that breaks down must not cost what the others took.
    except Exception as error:
        return None, f"it broke down: {type(error).__name__}: {error}"
