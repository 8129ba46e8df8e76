"""One panel of every kind."""

from __future__ import annotations

import numpy as np

from hil.report import colours, model_figures, run_figures
from hil.report.curves import dressed
from hil.studies.figure import Axis, Band, Curve, Figure, Look, Mark, Panel

RNG = np.random.default_rng(0)


T = np.arange(3000) / 125.0


A, B = RNG.standard_normal(3000), RNG.standard_normal(3000)


NAMES = ["one", "two"]


SIDES = np.tile([1, -1, 0], 1000)


BARS = tuple(Curve(n, ("J1", "J2"), tuple(v), "bars") for n, v in (("a", A[:2]), ("b", B[:2])))


def panel(*curves, **more):
    (one,) = dressed(Figure("f", "", "", (Panel("", "x [s]", "y [A]", curves, **more),))).panels
    return one


PANELS = {
    "dwells": panel(*model_figures.dwell_curves(A, B, SIDES, np.arange(3000))),
    "residual": panel(*model_figures.residual_curves(A, B), band=Band("noise", 0.1)),
    "regression": panel(*model_figures.regression_curves(A, B)[0], corner="R = 0.5"),
    "bars": panel(*BARS, Curve("n", ("J1", "J2"), A[:2], "ticks", look=Look(colours.LIMIT))),
    "joints": panel(
        *run_figures.joint_curves(T, np.column_stack([A, B]), NAMES),
        run_figures.limit_line(T[:2], 3.0),
    ),
    "grid": panel(grid=run_figures.counted_grid(A, B)),
    "powers": panel(Curve("p", T[:9], 10.0 ** -T[:9]), y_axis=Axis("log", (1e-9, 1.0))),
    "dates": panel(
        Curve("d", ("2026-11-22 10:00:00", "2026-11-23 10:00:00"), (1.0, 2.0), "marked"),
        x_axis=Axis("date"),
        marks=(Mark("2026-11-22 12:00:00", "v2", "another champion"),),
    ),
    "ranges": panel(Curve("u", T[:4], A[:4], "ranges", np.ones(4), Look(colours.FILL, size=1))),
    "identity": panel(Curve("c", A[:5], B[:5], "points"), Curve("y = x", style="identity")),
}
"""A panel with every part a description has."""
