"""Plots of a model on held-out data: dwells, and whole trajectories."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import PurePath

import numpy as np

from hil.core import FloatArray
from hil.data import Conditions
from hil.report import colours
from hil.report import plotly_figures as figures
from hil.report.blocks import Panel, Plots
from hil.report.fit_facts import FitFacts
from hil.report.plotly_figures import Figure
from hil.report.predictions import Dwells, Motions
from hil.report.words import joint_title, number, quantity

DEGREES = 180 / np.pi

Legend = tuple[tuple[str, str, str], ...]

OVER_TIME: Legend = (
    ("measured", colours.MEASURED, "solid"),
    ("predicted", colours.PREDICTED, "dash"),
)
APPROACHES: Legend = (
    ("measured, from below", colours.UP, "▲"),
    ("measured, from above", colours.DOWN, "▼"),
    ("predicted", colours.PREDICTED, "solid"),
)
RESIDUAL: Legend = (("measured − predicted", colours.RESIDUAL, "solid"),)
CLOUD: Legend = (
    ("measured − predicted", colours.NEUTRAL, "•"),
    ("mean", colours.PREDICTED, "solid"),
    ("mean ± 1 SD", colours.PREDICTED, "dot"),
)
REGRESSION: Legend = (
    ("sample", colours.MEASURED, "•"),
    ("measured = predicted", colours.PREDICTED, "dash"),
)


def bars(fits: Sequence[FitFacts]) -> Plots:
    """RMSE per joint of all models, and the high-frequency part of the measured signal."""
    unit, n = fits[0].unit, len(fits[0].joint_names)
    errors = {fit.label: fit.values("rmse_raw") for fit in fits if len(fit.joint_names) == n}
    figure = figures.rmse_bars(
        [f"J{j + 1}" for j in range(n)],
        errors,
        (f"measured signal: {fits[0].fast_part}", fits[0].values("noise_floor")),
        unit,
    )
    said = (
        f"{label}: {', '.join(f'J{j + 1} {number(v)}' for j, v in enumerate(values))} {unit}"
        for label, values in errors.items()
    )
    panel = Panel("RMSE raw on held-out data", figure, "; ".join(said), wide=True)
    return Plots("Error per joint", "", (panel,))


def dwell_plots(fit: FitFacts, dwells: Dwells) -> list[Plots]:
    """Measured and predicted per pose and approach, residuals, regression."""
    unit, fast = fit.unit, fit.values("noise_floor")
    residual = dwells.measured - dwells.predicted
    since = dwells.t - dwells.t.min()

    def compared(j: int) -> Figure:
        measured, predicted = dwells.measured[:, j], dwells.predicted[:, j]
        return figures.dwells(
            measured, predicted, dwells.approach, dwells.pose, unit, quantity(unit)
        )

    def residual_over(x: FloatArray, axis: str) -> Callable[[int], Figure]:
        return lambda j: figures.residual_over(
            x if x.ndim == 1 else x[:, j], residual[:, j], axis, unit, float(fast[j])
        )

    panels = _Panels(fit, residual)
    return [
        panels.plots(
            "Held-out dwells: measured and predicted",
            "One mark per dwell (mean of its samples). Where a pose was approached from below and "
            "from above, the distance between the two is friction at standstill; a model without "
            "friction memory runs between them.",
            compared,
            APPROACHES,
        ),
        panels.plots(
            "Held-out dwells: residual against pose",
            "Against the joint's own angle; a pattern here is gravity the model does not have.",
            residual_over(dwells.q * DEGREES, "joint angle [°]"),
            (*CLOUD, _band(fit)),
        ),
        panels.plots(
            "Held-out dwells: residual over the run",
            "A trend here is drift.",
            residual_over(since, "time [s]"),
            (*CLOUD, _band(fit)),
        ),
        panels.plots(
            "Held-out dwells: regression",
            "",
            lambda j: figures.regression(dwells.measured[:, j], dwells.predicted[:, j], unit),
            REGRESSION,
        ),
    ]


def motion_plots(fit: FitFacts, motions: Motions) -> list[Plots]:
    """Measured and predicted over the worst trajectory, residuals, regression over all."""
    unit, fast = fit.unit, fit.values("noise_floor")
    of_worst = motions.measured - motions.predicted
    residual = motions.all_measured - motions.all_predicted

    def over_time(j: int) -> Figure:
        measured, predicted = motions.measured[:, j], motions.predicted[:, j]
        return figures.measured_predicted(motions.t, measured, predicted, unit, quantity(unit))

    def residual_over(x: FloatArray, axis: str) -> Callable[[int], Figure]:
        return lambda j: figures.residual_over(
            x[:, j] * DEGREES, residual[:, j], axis, unit, float(fast[j])
        )

    which = _name_of(motions.worst)
    several = f"{which}: of {motions.count} held out, the worst relative to each joint's signal."
    panels = _Panels(fit, residual)
    return [
        panels.plots(
            "Held-out trajectory: measured and predicted",
            several if motions.count > 1 else f"{which}.",
            over_time,
            OVER_TIME,
        ),
        panels.plots(
            "The same trajectory: residual over time",
            "",
            lambda j: figures.residual_over_time(motions.t, of_worst[:, j], unit, float(fast[j])),
            (*RESIDUAL, _band(fit)),
        ),
        panels.plots(
            "All held-out trajectories: residual against velocity",
            "A step at zero is friction the model does not have.",
            residual_over(motions.qd, "velocity [°/s]"),
            (*CLOUD, _band(fit)),
        ),
        panels.plots(
            "All held-out trajectories: residual against pose",
            "",
            residual_over(motions.q, "joint angle [°]"),
            (*CLOUD, _band(fit)),
        ),
        panels.plots(
            "All held-out trajectories: regression",
            "",
            lambda j: figures.regression(
                motions.all_measured[:, j], motions.all_predicted[:, j], unit
            ),
            REGRESSION,
        ),
    ]


def _band(fit: FitFacts) -> tuple[str, str, str]:
    return f"± RMS of the measured signal's {fit.fast_part}", colours.LIMIT, "band"


def _name_of(condition: Conditions) -> str:
    source = PurePath(condition.source).name
    if condition.trajectory < 0:
        return f"{condition.kind.capitalize()} {condition.id}"
    return f"Trajectory {condition.trajectory} (counted from 0) of {source}"


class _Panels:
    """Plots with one panel per joint, each described by the joint's residual."""

    def __init__(self, fit: FitFacts, residual: FloatArray) -> None:
        self._fit = fit
        self._rms = [_rms(column) for column in residual.T]

    def plots(
        self, title: str, lead: str, figure: Callable[[int], Figure], legend: Legend
    ) -> Plots:
        panels = tuple(
            Panel(joint_title(j, name), figure(j), f"{title}, {name}: {self._residual(j)}")
            for j, name in enumerate(self._fit.joint_names)
        )
        drawn = {trace["name"] for panel in panels for trace in panel.figure["data"]}
        told = legend if "mean" in drawn else tuple(e for e in legend if e not in CLOUD[1:])
        return Plots(title, lead, panels, told)

    def _residual(self, j: int) -> str:
        return f"residual RMS {number(self._rms[j])} {self._fit.unit}"


def _rms(values: FloatArray) -> float:
    """Root mean square of the finite values, NaN without any."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")
