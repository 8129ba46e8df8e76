"""Tables and summary sentences of the dynamic-identification study, with RMSE in N·m per joint.

The tables also contain the rows of Table II of the PINN paper, whose robot is a ROKAE XB7S. The
source text of Table II has an extra 0 after the first digit of every number ("50.19" for 5.19). The
extra 0 of the numbers from Table II is removed here. Without the extra 0, the mean of every row
equals the average printed in Table II.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hil.studies.dynamic_methods import METHODS, Found
from hil.studies.result import Table, Value, joint_titles, value, values, with_mean

PRINTED = "as printed, another robot: "

AVERAGES = {"wls": 5.19, "lmi": 3.93, "irls": 3.68}
"""Mean RMSE [N·m] by method key, as printed in the PINN paper."""

TABLE_II: dict[str, tuple[float, ...]] = {
    "wls": (8.47, 14.07, 5.35, 1.51, 1.11, 0.61),
    "lmi": (6.23, 8.83, 3.15, 2.15, 2.23, 0.98),
    "irls": (7.30, 8.67, 3.54, 1.23, 0.84, 0.52),
}
"""RMSE per joint [N·m] of Methods 1, 2 and 3 by method key (`hil.studies.dynamic_methods`), as
printed in the PINN paper.
"""

_NOTE = (
    "Errors relative to the filtered effort. MEP: largest error divided by largest torque, mean "
    "over the joints. The rows of the paper are for a different robot (ROKAE XB7S), with the "
    "misprinted 0 removed from its figures: they show the order of magnitude and do not rank the "
    "methods."
)


def errors(found: Found, key: str, what: str) -> Table:
    """Return the table of the RMSE of each method relative to the filtered effort.

    Further columns of the table contain the spread over the splits and the largest error (MEP).
    """
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


def measured(found: Found, key: str, measure: str, title: str, note: str) -> Table:
    """Return the table of one measure of every method, per joint and as mean.

    The table of the measure `raw` has an additional row with the part of the effort that the filter
    removes.
    """
    rows: list[tuple[Value, ...]] = [
        (METHODS[name].words, *with_mean(found.mean(name, measure))) for name in found.scores
    ]
    if measure == "raw":
        rows.append(("signal removed by the filter", *with_mean(found.noise)))
    return Table(key, title, ("method", *joint_titles(len(found.noise)), "mean"), tuple(rows), note)


def fits(found: Found, key: str) -> Table:
    """Return the table that describes the fits of the methods.

    The columns of the table are: number of parameters, condition number, share of uncertain
    parameters, training RMSE, CPU time.
    """
    rows: list[tuple[Value, ...]] = []
    for name, scores in found.scores.items():
        first = scores[0]
        seconds = float(np.mean([score.seconds for score in scores]))
        told = (first.condition, 100.0 * first.uncertain, found.average(name, "training"), seconds)
        rows.append((METHODS[name].words, first.parameters or None, *values(told)))
    columns = (
        "method", "parameters", "condition", "uncertain [%]", "training RMSE [N·m]", "CPU s",
    )  # fmt: skip
    note = (
        "Condition: condition number of the column-scaled regressor. Uncertain: share of the "
        "parameters that differ from 0 by less than two standard errors."
    )
    return Table(key, "The fits", columns, tuple(rows), note)


def both(found: Sequence[Found]) -> Table:
    """Return the table of the mean RMSE of every method, with one column per protocol."""
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


TITLES = {"paper": "As in the paper", "honest": "Whole trajectories held out"}

LABELS = {
    "paper": "paper: samples split at random within trajectories",
    "honest": "honest",
}

TEXTS = {
    "paper": (
        "60/20/20 % of the samples, drawn individually. The neighbours in time of a test sample "
        "are in the training set and, at 100 Hz, nearly equal to the sample: these errors say "
        "little about other motions.",
    ),
    "honest": (
        "7, 2 and 3 of twelve trajectories for training, validation and testing. Methods that need "
        "no validation do not use the two validation trajectories, so that all methods have the "
        "same training data.",
    ),
}

OURS = "hysteresis"
_CLASSICAL = ("ols", "wls", "lmi", "lmi-weighted", "irls", "ridge", "tls", "diffnea")


def summary(found: Sequence[Found]) -> Iterator[str]:
    """Yield the main conclusions of the study, one sentence each."""
    for one in found:
        known = [key for key in _CLASSICAL if key in one.scores]
        if known:
            best = min(known, key=lambda key: one.average(key, "filtered"))
            yield (
                f"{TITLES[one.protocol]}, the best memoryless method is {METHODS[best].words}: "
                f"{one.average(best, 'filtered'):.3g} N·m, mean over joints and splits."
            )
            if OURS in one.scores:
                ours = one.average(OURS, "filtered")
                yield (
                    f"With friction with memory, the error is {ours:.3g} N·m, "
                    f"{100 * (1 - ours / one.average(best, 'filtered')):.0f} % less."
                )
