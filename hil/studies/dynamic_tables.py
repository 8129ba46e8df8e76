"""Tables of a study of dynamic identification: RMSE in N·m per joint, as Table II of the paper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.studies.dynamic_methods import METHODS
from hil.studies.dynamic_printed import AVERAGES, TABLE_II
from hil.studies.dynamic_protocols import Found
from hil.studies.result import Table, Value
from hil.studies.separation_text import joint_titles, value, values, with_mean

PRINTED = "as printed, another robot: "


def errors(found: Found, key: str, what: str) -> Table:
    """RMSE against the filtered effort, with its spread over the splits and the largest error."""
    n = len(found.noise)
    rows: list[tuple[Value, ...]] = [
        (
            METHODS[name].words,
            *with_mean(found.mean(name, "filtered")),
            value(found.spread(name, "filtered")),
            value(found.average(name, "percent")),
        )
        for name in found.scores
    ]
    if n == len(next(iter(TABLE_II.values()))):
        rows += [
            (PRINTED + METHODS[name].words, *printed, AVERAGES[name], None, None)
            for name, printed in TABLE_II.items()
            if name in found.scores
        ]
    columns = ("method", *joint_titles(n), "mean", "SD over splits", "MEP %")
    return Table(key, f"RMSE of joint torques, {what} [N·m]", columns, tuple(rows), _NOTE)


_NOTE = (
    "Against the filtered effort. MEP: largest error over largest torque, mean over the joints. "
    "Rows of the paper are of a ROKAE XB7S, with the stray 0 taken out of its figures: they say "
    "how large such errors are, not who is better."
)


def measured(found: Found, key: str, measure: str, title: str, note: str) -> Table:
    """One measure of every method, per joint and mean; with the noise where it is a part of it."""
    rows: list[tuple[Value, ...]] = [
        (METHODS[name].words, *with_mean(found.mean(name, measure))) for name in found.scores
    ]
    if measure == "raw":
        rows.append(("what the filter takes out", *with_mean(found.noise)))
    return Table(key, title, ("method", *joint_titles(len(found.noise)), "mean"), tuple(rows), note)


def fits(found: Found, key: str) -> Table:
    """What each fit was like: parameters, condition, errors told, seconds."""
    rows: list[tuple[Value, ...]] = []
    for name, scores in found.scores.items():
        first = scores[0]
        seconds = float(np.mean([score.seconds for score in scores]))
        told = (first.condition, 100.0 * first.uncertain, found.average(name, "training"), seconds)
        rows.append((METHODS[name].words, first.parameters or None, *values(told)))
    columns = (
        "method", "parameters", "condition", "not told from 0 [%]", "training RMSE [N·m]", "CPU s",
    )  # fmt: skip
    note = (
        "Condition of the column-scaled regressor. Not told from 0: share of the parameters "
        "within two of their standard errors."
    )
    return Table(key, "The fits", columns, tuple(rows), note)


def both(found: Sequence[Found]) -> Table:
    """Mean RMSE of every method under every protocol, side by side."""
    names = [name for name in METHODS if any(name in one.scores for one in found)]
    rows = [
        (
            METHODS[name].words,
            *(one.average(name, "filtered") if name in one.scores else None for one in found),
        )
        for name in names
    ]
    columns = ("method", *(one.protocol for one in found))
    return Table("table-protocols", "Mean RMSE by protocol [N·m]", columns, tuple(rows))
