"""What a pose measured from both sides tells: gravity in the mean, friction in the difference."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hil.core import FloatArray
from hil.report.fit_facts import FitFacts
from hil.report.page import Column, Table, cells
from hil.report.predictions import Dwells
from hil.report.words import joint_title, number


def approach_table(fit: FitFacts, dwells: Dwells) -> Table | None:
    """Error of the mean of both approaches, and half their difference, per joint.

    A pose approached from below and from above holds the same gravity, and friction of opposite
    sign. Without a memory of the approach no model predicts the second; the first is what it is
    worth as a model of gravity. None when no pose was measured from both sides.
    """
    pairs = list(_pairs(dwells))
    if not pairs:
        return None
    up, down = (np.array(side) for side in zip(*pairs, strict=True))
    residual = dwells.measured - dwells.predicted
    gravity = (residual[up] + residual[down]) / 2
    friction = (residual[up] - residual[down]) / 2
    columns = (
        Column("joint", number=False),
        Column(f"error of the approach mean, RMS [{fit.unit}]"),
        Column(f"half difference, mean [{fit.unit}]"),
        Column(f"half difference, RMS [{fit.unit}]"),
        Column("its share of the squared error [%]"),
    )
    values = (_rms(gravity), friction.mean(axis=0), _rms(friction), _share(gravity, friction))
    rows = [
        cells(joint_title(j, name), *(number(float(value[j])) for value in values))
        for j, name in enumerate(fit.joint_names)
    ]
    rows.append(cells("mean", *(number(float(np.mean(value))) for value in values)))
    return Table(
        f"{fit.label}: gravity and stick friction apart, {len(pairs)} held-out poses from both "
        "sides",
        columns,
        tuple(rows),
        "The mean of both approaches cancels friction that has the sign of the approach: its "
        "error is the error in gravity. Half their difference is that friction; it enters the "
        "RMSE of single dwells in full, whatever the gravity model is worth.",
    )


def _pairs(dwells: Dwells) -> Iterator[tuple[int, int]]:
    """Dwells at the same pose under the same load, from below and from above."""
    keys = list(zip(dwells.pose.tolist(), dwells.load.tolist(), strict=True))
    side = {(key, sign): i for i, (key, sign) in enumerate(zip(keys, dwells.approach, strict=True))}
    for key in dict.fromkeys(keys):
        if (key, 1) in side and (key, -1) in side:
            yield side[key, 1], side[key, -1]


def _rms(values: FloatArray) -> FloatArray:
    out: FloatArray = np.sqrt(np.mean(values**2, axis=0))
    return out


def _share(gravity: FloatArray, friction: FloatArray) -> FloatArray:
    """(n,) share of the difference in the squared error of single dwells [%]; NaN without any."""
    of_friction, total = _rms(friction) ** 2, _rms(friction) ** 2 + _rms(gravity) ** 2
    known = total > 0
    return np.where(known, 100 * of_friction / np.where(known, total, 1.0), np.nan)
