"""Tables and sentences of a study of dynamic identification: RMSE in N·m per joint.

Rows of the PINN paper's Table II, whose robot is a ROKAE XB7S, stand beside ours. The text that
came with this project has a stray 0 behind the first digit of every figure ("50.19" for 5.19); with
it taken out, the mean of every row is the printed average.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hil.studies.dynamic_methods import METHODS, Found
from hil.studies.result import Table, Value, joint_titles, value, values, with_mean

PRINTED = "as printed, another robot: "

AVERAGES = {"wls": 5.19, "lmi": 3.93, "irls": 3.68}
"""As printed."""

TABLE_II: dict[str, tuple[float, ...]] = {
    "wls": (8.47, 14.07, 5.35, 1.51, 1.11, 0.61),
    "lmi": (6.23, 8.83, 3.15, 2.15, 2.23, 0.98),
    "irls": (7.30, 8.67, 3.54, 1.23, 0.84, 0.52),
}
"""RMSE [N·m] by key of `hil.studies.dynamic_methods`: Methods 1, 2 and 3."""

_NOTE = (
    "Against the filtered effort. MEP: largest error over largest torque, mean over the joints. "
    "Rows of the paper are of a ROKAE XB7S, with the stray 0 taken out of its figures: they say "
    "how large such errors are, not who is better."
)


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


TITLES = {"paper": "As in the paper", "honest": "Whole trajectories held out"}

LABELS = {
    "paper": "paper: samples split at random within trajectories",
    "honest": "honest",
}

TEXTS = {
    "paper": (
        "60/20/20 % of the samples, drawn one by one. A test sample's neighbours in time were "
        "trained on, and at 100 Hz they are nearly the same sample: these errors say little about "
        "another motion.",
    ),
    "honest": (
        "7, 2 and 3 of twelve trajectories to fit on, to choose by and to judge on. Methods that "
        "choose nothing leave the two in the middle unused, so that all are fitted to the same.",
    ),
}

OURS = "hysteresis"
_CLASSICAL = ("ols", "wls", "lmi", "lmi-weighted", "irls", "ridge", "tls", "diffnea")


def summary(found: Sequence[Found]) -> Iterator[str]:
    """What to take away, one sentence each."""
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
                    f"Friction with memory leaves {ours:.3g} N·m, "
                    f"{100 * (1 - ours / one.average(best, 'filtered')):.0f} % less."
                )
