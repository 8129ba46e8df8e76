"""Figures of the dynamic-identification study."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.studies.dynamic_methods import METHODS, Found
from hil.studies.figure import Curve, Figure, Panel
from hil.studies.result import joint_titles

MOST_LINES = 4
"""Maximum number of models drawn beside the measured torque; with more models, the curves would
hide each other.
"""


def torques(found: Found, key: str) -> Figure:
    """Return the figure of measured and predicted torque over the first test trajectory."""
    t = _floats(found.t - found.t[0])
    chosen = list(found.scores)[-MOST_LINES:]
    panels = []
    for j, title in enumerate(joint_titles(found.measured.shape[1])):
        curves = [Curve("measured", t, _floats(found.measured[:, j]))]
        for name in chosen:
            shown = found.scores[name][0].shown[:, j]
            curves.append(Curve(METHODS[name].words, t, _floats(shown)))
        panels.append(Panel(title, "time [s]", "torque [N·m]", tuple(curves)))
    caption = "Filtered torques on a trajectory that no model was fitted to, first split."
    return Figure(key, "Measured and predicted joint torques", caption, tuple(panels), 2)


def _floats(values: np.ndarray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def by_protocol(found: Sequence[Found]) -> Figure:
    """Return the bar chart of the mean RMSE of every method, with one set of bars per protocol."""
    curves = [
        Curve(
            one.protocol,
            tuple(METHODS[name].words for name in one.scores),
            tuple(one.average(name, "filtered") for name in one.scores),
            "bars",
            tuple(float(np.nan_to_num(one.spread(name, "filtered"))) for name in one.scores),
        )
        for one in found
    ]
    panel = Panel("Mean over the joints", "method", "RMSE [N·m]", tuple(curves))
    caption = "Bars: standard deviation over the splits."
    return Figure("fig-protocols", "Errors by protocol", caption, (panel,), 1)
