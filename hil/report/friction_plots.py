"""Friction of a model as plots: at rest by pose and direction, in motion over velocity."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray
from hil.report import colours
from hil.report.blocks import Panel, Plots
from hil.report.decimate import binned, thinned
from hil.report.fit_facts import FitFacts
from hil.report.friction_seen import AtRest, Friction, InMotion, Law
from hil.report.friction_words import SIDES, lead, sides
from hil.report.plotly_figures import CLOUD, Figure
from hil.report.traces import Trace, axes, line, markers
from hil.report.words import joint_title, number

DEGREES = 180 / np.pi
BINS = 30
"""Of either direction."""
ERRORS = 2.0
"""Half a band, in standard errors."""

AT_REST, IN_MOTION = "Held-out dwells: friction at rest", "Friction over velocity"
MEASURED = ("measured, less the rest of the model", colours.MEASURED, "•")


def rest_plots(fit: FitFacts, friction: Friction) -> list[Plots]:
    """Friction that held poses from either side, over the joint's angle; gravity is taken away."""
    seen = friction.at_rest
    if seen is None:
        return []
    panels = tuple(
        Panel(
            joint_title(j, name),
            resting(seen, j, friction.unit),
            f"{AT_REST}, {name}: {sides(seen, j, friction.unit)}",
        )
        for j, name in enumerate(fit.joint_names)
    )
    legend: tuple[tuple[str, str, str], ...] = (
        ("from below, less gravity", colours.UP, "▲"),
        ("from above, less gravity", colours.DOWN, "▼"),
    )
    if seen.predicted is not None:
        legend += (("friction of the model", colours.PREDICTED, "◇"),)
    about = (
        "The measured effort of each dwell less what the model holds for gravity, offset and "
        "load: friction, and what the model errs by; dwells the model does not hold for are left "
        "out. How far the two directions are apart is twice the friction that holds the joint."
    )
    return [Plots(AT_REST, about, panels, legend)]


def velocity_plots(fit: FitFacts, friction: Friction) -> list[Plots]:
    """Friction over velocity: the model's, and what it leaves of the measured effort for it."""
    seen = friction.in_motion
    if seen is None:
        return []
    panels = tuple(
        Panel(
            joint_title(j, name),
            moving(seen, j, friction.unit),
            f"{IN_MOTION}, {name}: {_ends(seen, j, friction.unit)}",
        )
        for j, name in enumerate(fit.joint_names)
    )
    drawn = {trace["name"] for panel in panels for trace in panel.figure["data"]}
    legend = tuple(
        each
        for each in (
            MEASURED,
            ("friction of the model", colours.PREDICTED, "solid"),
            ("friction of the model, mean", colours.PREDICTED, "solid"),
            (f"± {ERRORS:g} standard errors, at most", colours.PREDICTED, "dot"),
            ("mean ± 1 SD", colours.PREDICTED, "dot"),
            ("without its viscous part", colours.NEUTRAL, "dash"),
        )
        if each[0] in drawn
    )
    return [Plots(IN_MOTION, lead(seen), panels, legend)]


def resting(seen: AtRest, j: int, unit: str) -> Figure:
    """Friction of one joint at rest over its angle, both directions told apart."""
    angle, traces = seen.q[:, j] * DEGREES, []
    for sign, name, colour, symbol in SIDES:
        rows = np.flatnonzero((seen.approach == sign) & np.isfinite(seen.measured[:, j]))
        if len(rows):
            x, y, name = angle[rows], seen.measured[rows, j], f"{name}, less gravity"
            size, text = 6 if len(angle) < 100 else 4, [f"pose {p}" for p in seen.pose[rows]]
            traces.append(markers(x, y, name, colour, symbol=symbol, size=size, text=text))
    if seen.predicted is not None:
        drawn = (seen.approach != 0) & np.isfinite(seen.predicted[:, j])
        x, y = angle[drawn], seen.predicted[drawn, j]
        name, colour = "friction of the model", colours.PREDICTED
        traces.append(markers(x, y, name, colour, symbol="diamond-open", size=5))
    return {"data": traces, "layout": axes("joint angle [°]", f"friction [{unit}]")}


def moving(seen: InMotion, j: int, unit: str) -> Figure:
    """Friction of one joint over its velocity: a cloud of samples, and the model's line."""
    good = np.isfinite(seen.measured[:, j]) & np.isfinite(seen.qd[:, j])
    qd, measured = seen.qd[good, j] * DEGREES, seen.measured[good, j]
    some = thinned(len(qd), CLOUD)
    cloud = markers(
        qd[some], measured[some], MEASURED[0], MEASURED[1], size=3 if len(some) > 300 else 4,
        opacity=0.5,
    )  # fmt: skip
    lines = _mean(qd, seen.predicted[good, j]) if seen.law is None else _curve(seen.law, j)
    return {"data": [cloud, *lines], "layout": axes("velocity [°/s]", f"friction [{unit}]")}


def _curve(law: Law, j: int) -> list[Trace]:
    qd, torque, dry = law.qd[:, j] * DEGREES, law.torque[:, j], law.dry[:, j]
    half, orange = ERRORS * law.std_error[:, j], colours.PREDICTED
    traces = [line(qd, dry, "without its viscous part", colours.NEUTRAL, dash="dash", width=1.4)]
    if np.isfinite(half).all():
        name = f"± {ERRORS:g} standard errors, at most"
        traces += [
            line(qd, edge, name, orange, dash="dot", width=1.4)
            for edge in (torque + half, torque - half)
        ]
    return [*traces, line(qd, torque, "friction of the model", orange, width=2.2)]


def _mean(qd: FloatArray, predicted: FloatArray) -> list[Trace]:
    """Mean and spread of what the model says, either direction by itself."""
    sides = [binned(qd[rows], predicted[rows], BINS) for rows in (qd < 0, qd > 0)]
    centre, mean, spread = (np.concatenate(part) for part in zip(*sides, strict=True))
    orange = colours.PREDICTED
    edges = [
        line(centre, edge, "mean ± 1 SD", orange, dash="dot", width=1.4)
        for edge in (mean + spread, mean - spread)
    ]
    return [*edges, line(centre, mean, "friction of the model, mean", orange, width=2.2)]


def _ends(seen: InMotion, j: int, unit: str) -> str:
    """What the model's line says at both its ends, and how far the samples are from the model."""
    drawn = moving(seen, j, unit)["data"][-1]
    off = seen.measured[:, j] - seen.predicted[:, j]
    off = off[np.isfinite(off)]
    rms = float(np.sqrt(np.mean(off**2))) if len(off) else float("nan")
    ends = [
        f"{number(float(drawn['y'][i]))} {unit} at {number(float(drawn['x'][i]))} °/s"
        for i in ((0, -1) if np.isfinite(drawn["x"]).any() else ())
    ]
    return f"model {' and '.join(ends) or 'unknown'}; residual RMS {number(rms)} {unit}"
