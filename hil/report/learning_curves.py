"""Learning curves of a model that was trained by gradient: a plot, and what came of it in words."""

from __future__ import annotations

from itertools import accumulate

import numpy as np

from hil.networks import Curves
from hil.report import colours
from hil.report.blocks import Panel, Plots
from hil.report.documents import as_object
from hil.report.fit_facts import FitFacts
from hil.report.plotly_figures import Figure
from hil.report.traces import axes, line, markers
from hil.report.words import number

LEGEND = (
    ("training loss", colours.MEASURED, "solid"),
    ("validation error", colours.PREDICTED, "dash"),
    ("kept", colours.PREDICTED, "◆"),
    ("next stage", colours.NEUTRAL, "dot"),
)


def curves_of(fit: FitFacts) -> Curves | None:
    """The learning curves in a model file; None where there are none, or not whole."""
    told = as_object(fit.model.get("fitted")).get("curves")
    if not isinstance(told, dict):
        return None
    try:
        return Curves.from_dict(told)
    except (KeyError, TypeError, ValueError, OverflowError):
        return None


def learning_plots(fit: FitFacts) -> Plots | None:
    """Loss and validation error over the epochs; None where nothing was trained."""
    curves = curves_of(fit)
    if curves is None or not len(curves):
        return None
    stages = "; ".join(f"{name}: {count}" for name, count in curves.spans())
    best = (
        f"Kept are the weights of epoch {curves.best_epoch} of {len(curves)}"
        if curves.best_epoch
        else f"None of {len(curves)} epochs was better than the untrained network, which was kept"
    )
    lead = (
        f"{best}: validation error {number(curves.best)}, untrained {number(curves.untrained)}. "
        f"Epochs by stage: {stages}."
    )
    panel = Panel("Training", learning_figure(curves), lead, wide=True)
    return Plots("Learning curves", lead, (panel,), LEGEND)


def learning_figure(curves: Curves) -> Figure:
    """Loss and validation error over the epochs on a logarithmic scale, stages told apart."""
    epoch = np.arange(1.0, len(curves) + 1)
    loss, validation = np.array(curves.loss), np.array(curves.validation)
    kept = np.array([float(curves.best_epoch)])
    layout = axes("epoch", "loss, error [1]")
    # Plotly leaves out of a logarithmic axis what is not above 0, as an error of nothing is.
    layout["yaxis"] |= {"type": "log"}
    layout["shapes"] = [_next_stage(at) for at in _ends(curves)]
    return {
        "data": [
            line(epoch, loss, "training loss", colours.MEASURED),
            line(
                np.concatenate([[0.0], epoch]),
                np.concatenate([[curves.untrained], validation]),
                "validation error",
                colours.PREDICTED,
                dash="dash",
            ),
            markers(
                kept, np.array([curves.best]), "kept", colours.PREDICTED,
                symbol="diamond", size=9, opacity=1.0,
            ),
        ],
        "layout": layout,
    }  # fmt: skip


def _ends(curves: Curves) -> list[int]:
    """Last epoch of every stage but the last."""
    return list(accumulate(count for _, count in curves.spans()))[:-1]


def _next_stage(epoch: int) -> dict[str, object]:
    at = epoch + 0.5
    dots = {"color": colours.NEUTRAL, "width": 1.2, "dash": "dot"}
    return {"type": "line", "yref": "paper", "x0": at, "x1": at, "y0": 0, "y1": 1, "line": dots}
