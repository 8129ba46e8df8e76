"""Figures of the inverse-dynamics study, corresponding to section IV of the PINN paper."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from hil.core import FloatArray
from hil.studies.figure import Curve, Figure, Panel
from hil.studies.inverse_fits import Found, Shown, evenly
from hil.studies.inverse_tables import carried, under
from hil.studies.result import joint_titles

OVER_TIME = ("irls", "proposed", "rc-motion", "ours", "ours-residual")
"""Table rows drawn beside the measured torque if available; with more rows, the curves would hide
each other.
"""

FRICTION = ("proposed", "delan-coulomb", "ours")

BARS = (
    "irls", "delan-dissipative", "delan-coulomb", "proposed", "rc-paper", "rc-motion", "rc-grouped",
    "ours-residual",
)  # fmt: skip
"""Table rows shown in the bar chart; their number is limited by the number of colours.

Method 4 is omitted from the bar chart because its errors would dominate the scale. The tables,
unlike the bar chart, contain all rows.
"""

CORRECTED = ("rc-paper", "rc-motion", "rc-grouped")

MOST_EPOCHS = 150
"""Maximum number of points of a learning curve; curves with more points are thinned out."""


def torques(found: Found, key: str) -> Figure:
    """Return Fig. 4: measured and predicted torque over the first test trajectory."""
    seen, chosen = found.seen[0], _some(OVER_TIME, found.scores)
    panels = []
    for j, title in enumerate(joint_titles(found.n)):
        curves = [_line("measured", seen.t, seen.measured[:, j])]
        curves += [
            _line(found.words(name), seen.t, found.scores[name][0].shown.torque[:, j])
            for name in chosen
        ]
        panels.append(Panel(title, "time [s]", "torque [N·m]", tuple(curves)))
    caption = "Filtered torque of the first test trajectory, first seed (Fig. 4 of the paper)."
    return Figure(key, "Measured and predicted joint torques", caption, tuple(panels), 2)


def _some(wanted: Sequence[str], there: Collection[str]) -> list[str]:
    return [name for name in wanted if name in there] or list(there)[: len(BARS)]


def _line(name: str, x: FloatArray, y: FloatArray, *, points: bool = False) -> Curve:
    return Curve(name, _floats(x), _floats(y), "points" if points else "line")


def _floats(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def friction(found: Found, key: str) -> Figure | None:
    """Return Fig. 5: measured and learned friction over velocity.

    The measured friction is the torque minus the rigid-body torque of the first drawn model. None
    is returned if no model separates friction from the rigid-body torque.
    """
    chosen = [n for n in _some(FRICTION, found.scores) if len(_shown(found, n).friction)]
    if not chosen:
        return None
    seen, first = found.seen[0], _shown(found, chosen[0])
    panels = []
    for j, title in enumerate(joint_titles(found.n)):
        speed, left = seen.speeds[:, j], seen.cloud[:, j] - first.rigid[:, j]
        curves = [_line("measured minus rigid body", speed, left, points=True)]
        for name in chosen:
            values = _shown(found, name).friction[:, j]
            curves.append(_line(found.words(name), speed, values, points=True))
        panels.append(Panel(title, "velocity [rad/s]", "friction [N·m]", tuple(curves)))
    caption = (
        f"Test samples, first seed (Fig. 5 of the paper). The rigid-body torque is from the model "
        f"“{found.words(chosen[0])}”; a constant can belong to friction or to gravity."
    )
    return Figure(key, "Friction against velocity", caption, tuple(panels), 2)


def _shown(found: Found, name: str) -> Shown:
    return found.scores[name][0].shown


def residuals(found: Found, key: str) -> Figure | None:
    """Return Fig. 6: low- and high-frequency residual, and the output of the corrections."""
    chosen = [name for name in _some(CORRECTED, found.scores) if len(_shown(found, name).residual)]
    if not chosen:
        return None
    seen, left = found.seen[0], _shown(found, chosen[0]).left
    panels = []
    for j, title in enumerate(joint_titles(found.n)):
        for band, words in enumerate(("low", "high")):
            curves = [_line("residual of Proposed", seen.t, left[band, :, j])]
            curves += [
                _line(found.words(name), seen.t, _shown(found, name).residual[band, :, j])
                for name in chosen
            ]
            heading = f"{title}, {words} frequency"
            panels.append(Panel(heading, "time [s]", "torque [N·m]", tuple(curves)))
    caption = "First test trajectory, first seed (Fig. 6 of the paper)."
    return Figure(key, "Residual and its compensation", caption, tuple(panels), 2)


def bars(found: Found, key: str) -> Figure:
    """Return Fig. 7: RMSE and largest relative error (MEP) per joint."""
    panels = []
    joints = joint_titles(found.n)
    for measure, title in (("filtered", "RMSE [N·m]"), ("percent", "MEP [%]")):
        curves = []
        for name in _some(BARS, found.scores):
            scores = found.scores[name]
            every = np.stack([getattr(score, measure) for score in scores])
            spread = np.std(every, axis=0, ddof=1) if len(every) > 1 else np.zeros(found.n)
            heights = _floats(every.mean(axis=0))
            curves.append(Curve(found.words(name), joints, heights, "bars", _floats(spread)))
        panels.append(Panel(title.split(" ")[0], "joint", title, tuple(curves)))
    caption = "Bars: standard deviation over the seeds (Fig. 7 of the paper)."
    return Figure(key, "Errors per joint", caption, tuple(panels), 1)


def loads(found: Found) -> Figure | None:
    """Return Fig. 8: mean error by payload, for models with and without payload information."""
    known = carried(found)
    if not known:
        return None
    names = tuple(found.loads[load] for load in known)
    panels = []
    for told in ("unaware", "aware"):
        curves = [
            Curve(found.words(key), names, tuple(under(found, key, load, told) for load in known),
                  "bars")
            for key in _some(BARS, found.scores)
        ]  # fmt: skip
        panels.append(Panel(f"Load {told}", "load", "RMSE [N·m]", tuple(curves)))
    caption = (
        "Mean over the joints on held-out motions; no model was trained with a load (Fig. 8 of the "
        "paper)."
    )
    return Figure("fig-loads", "Errors under loads", caption, tuple(panels), 1)


def learning(found: Found, key: str) -> Figure | None:
    """Return losses and validation errors of every network over its epochs, for the first seed."""
    panels = []
    for name, scores in found.scores.items():
        told = scores[0].curves
        curves = [
            _line(what, np.asarray(every + 1.0), values[every])
            for what, values in told.items()
            for every in (evenly(np.arange(len(values)), MOST_EPOCHS),)
            if len(values)
        ]
        if curves:
            panels.append(Panel(found.words(name), "epoch", "loss [1]", tuple(curves)))
    if not panels:
        return None
    return Figure(key, "Learning curves", "First seed.", tuple(panels), 2)
