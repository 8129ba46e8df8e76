"""Figures of models: measured and predicted effort, friction, residuals, learning curves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import PurePath
from typing import TypeAlias

import numpy as np

from hil.core import FloatArray, IntArray
from hil.data import Conditions
from hil.estimators import OFFSET, STATIC, VISCOUS, FrictionCurve
from hil.networks import Curves
from hil.report import colours
from hil.report.curves import binned, decimated, span, thinned
from hil.report.documents import as_object
from hil.report.figure_list import DEGREES, figure
from hil.report.fit_facts import FitFacts
from hil.report.predictions import (
    DwellPredictions,
    FrictionAtRest,
    FrictionInMotion,
    MotionPredictions,
    Predictions,
)
from hil.report.words import joint_title, number, quantity
from hil.studies import Axis, Band, Curve, Figure, Look, Mark, Panel

CLOUD = 700
"""Maximum number of points of a point cloud, limited because a page draws six clouds at once."""


@dataclass(frozen=True, slots=True, eq=False)
class ModelView:
    """Data for the figures of a model: evaluation and predictions of the hold-out set."""

    fit: FitFacts
    shown: Predictions


_Series: TypeAlias = tuple[tuple[Curve, ...], str]
"""Curves of one joint, and the text in the corner of the joint's panel."""


@figure("models")
def error_per_joint(fits: Sequence[FitFacts]) -> Figure:
    """Return the figure of the RMSE per joint of all models, with the noise floor of the signal."""
    unit, n = fits[0].unit, len(fits[0].joint_names)
    joints = tuple(f"J{j + 1}" for j in range(n))
    errors = {fit.label: fit.values("rmse_raw") for fit in fits if len(fit.joint_names) == n}
    curves = [
        Curve(label, joints, values, "bars", look=colours.look(i))
        for i, (label, values) in enumerate(errors.items())
    ]
    fast = fits[0].values("noise_floor")
    if np.isfinite(fast).any():
        name = f"measured signal: {fits[0].fast_part}"
        curves.append(Curve(name, joints, fast, "ticks", look=Look(colours.LIMIT, symbol=_TICK)))
    alt = "; ".join(
        f"{label}: {', '.join(f'J{j + 1} {number(v)}' for j, v in enumerate(values))} {unit}"
        for label, values in errors.items()
    )
    axes = ("joint", f"RMSE [{unit}]")
    panel = Panel("RMSE raw on held-out data", *axes, tuple(curves), alt=alt, wide=True)
    return Figure("errors", "Error per joint", "", (panel,), 1)


_TICK = "line-ew-open"


@figure("model")
def dwells_compared(view: ModelView) -> Figure | None:
    """Return the figure of dwells ordered by predicted effort, coloured by approach direction."""
    if (dwells := view.shown.dwells) is None:
        return None

    def curves(j: int) -> _Series:
        return dwell_curves(
            dwells.measured[:, j], dwells.predicted[:, j], dwells.approach, dwells.pose
        ), ""

    unit = view.fit.unit
    return _per_joint(
        view.fit,
        _residual_of(dwells),
        "Held-out dwells: measured and predicted",
        "One mark per dwell (mean of its samples). If a pose was approached from below and from "
        "above, the distance between the two marks is twice the static friction; a model without "
        "friction memory lies between them.",
        ("dwell, in the order of the prediction", f"{quantity(unit)} [{unit}]"),
        curves,
    )


SIDES = (
    (1, "from below", colours.UP, "triangle-up"),
    (-1, "from above", colours.DOWN, "triangle-down"),
)
"""Properties of the approach directions of a dwell: sign in the data, name, colour and mark."""


def dwell_curves(
    measured: FloatArray, predicted: FloatArray, approach: IntArray, pose: IntArray
) -> tuple[Curve, ...]:
    """Return curves of the dwells (D,) of one joint, ordered by the predicted effort.

    The argument `approach` is described in `DwellPredictions`.
    """
    order = np.argsort(predicted, kind="stable")
    rank = np.empty(len(order))
    rank[order] = np.arange(1, len(order) + 1)
    curves = []
    for sign, side, colour, symbol in (*SIDES, (0, "", colours.MEASURED, "circle")):
        rows = np.flatnonzero(approach == sign)
        if len(rows):
            look = Look(colour, symbol=symbol, size=2 + _mark_size(len(order)))
            hover = [f"pose {p}" for p in pose[rows]]
            name = f"measured, {side}" if side else "measured"
            curves.append(Curve(name, rank[rows], measured[rows], "points", (), look, hover))
    x, y = decimated(np.sort(rank), predicted[order])
    return (*curves, Curve("predicted", x, y, look=Look(colours.PREDICTED, width=2.2)))


@figure("model")
def friction_at_rest(view: ModelView) -> Figure | None:
    """Return the figure of the static friction in dwells from both directions over the angle.

    The static friction is the measured effort minus the gravity of the model.
    """
    friction = view.shown.friction
    seen = friction.at_rest if friction else None
    if friction is None or seen is None or view.shown.dwells is None:
        return None
    panels = tuple(
        Panel(
            joint_title(j, name),
            "joint angle [°]",
            f"friction [{friction.unit}]",
            friction_at_rest_curves(seen, j),
            alt=f"{AT_REST}, {name}: {_mean_sides(seen, j, friction.unit)}",
        )
        for j, name in enumerate(view.fit.joint_names)
    )
    lead = (
        "Measured effort of each dwell minus the gravity, offset and payload of the model: the "
        "rest is friction and the error of the model. Dwells outside the validity of the model are "
        "omitted. The distance between the two approach directions is twice the static friction."
    )
    return Figure("friction-at-rest", AT_REST, lead, panels, 0)


AT_REST, IN_MOTION = "Held-out dwells: static friction", "Friction over velocity"


def friction_at_rest_curves(seen: FrictionAtRest, j: int) -> tuple[Curve, ...]:
    """Return curves of static friction of one joint over its angle, one per approach direction."""
    angle, curves = seen.q[:, j] * DEGREES, []
    for sign, name, colour, symbol in SIDES:
        rows = np.flatnonzero((seen.approach == sign) & np.isfinite(seen.measured[:, j]))
        if len(rows):
            look = Look(colour, symbol=symbol, size=_mark_size(len(angle)))
            hover = [f"pose {p}" for p in seen.pose[rows]]
            x, y = angle[rows], seen.measured[rows, j]
            curves.append(Curve(f"{name}, minus gravity", x, y, "points", (), look, hover))
    if seen.predicted is not None:
        drawn = (seen.approach != 0) & np.isfinite(seen.predicted[:, j])
        look = Look(colours.PREDICTED, symbol="diamond-open", size=5)
        x, y = angle[drawn], seen.predicted[drawn, j]
        curves.append(Curve("friction of the model", x, y, "points", look=look))
    return tuple(curves)


def _mean_sides(seen: FrictionAtRest, j: int, unit: str) -> str:
    """Return a text with the mean static friction of one joint per approach direction.

    The mean includes only the dwells for which the model is valid.
    """
    sides = []
    for sign, name, _, _ in SIDES:
        rows = (seen.approach == sign) & np.isfinite(seen.measured[:, j])
        if rows.any():
            text = f"{name} {number(float(seen.measured[rows, j].mean()))} {unit}"
            if seen.predicted is not None:
                text += f" (model {number(float(seen.predicted[rows, j].mean()))})"
            sides.append(text)
    return f"mean {', '.join(sides) or 'unknown'}"


@figure("model")
def dwell_residual_over_pose(view: ModelView) -> Figure | None:
    """Return the figure of the residuals of dwells over the joint angle."""
    if (dwells := view.shown.dwells) is None:
        return None
    return _residual(
        view.fit,
        dwells,
        "Held-out dwells: residual against pose",
        "Residual over the angle of the same joint. A pattern shows gravity that the model lacks.",
        (dwells.q * DEGREES, "joint angle [°]"),
    )


@figure("model")
def dwell_residual_over_time(view: ModelView) -> Figure | None:
    """Return the figure of the residuals of dwells over the time of the run."""
    if (dwells := view.shown.dwells) is None:
        return None
    since = np.repeat((dwells.t - dwells.t.min())[:, None], dwells.q.shape[1], axis=1)
    title = "Held-out dwells: residual over the run"
    return _residual(view.fit, dwells, title, "A trend shows drift.", (since, "time [s]"))


@figure("model")
def dwell_regression(view: ModelView) -> Figure | None:
    """Return the figure of measured over predicted effort of dwells."""
    if (dwells := view.shown.dwells) is None:
        return None
    return _regression(view.fit, dwells, "Held-out dwells: regression")


@figure("model")
def trajectory_compared(view: ModelView) -> Figure | None:
    """Return the figure of measured and predicted effort in the trajectory with largest error."""
    if (motions := view.shown.motions) is None:
        return None

    def curves(j: int) -> _Series:
        measured = decimated(motions.t, motions.measured[:, j])
        predicted = decimated(motions.t, motions.predicted[:, j])
        return (
            Curve("measured", *measured, look=Look(colours.MEASURED, width=1.2)),
            Curve("predicted", *predicted, look=Look(colours.PREDICTED, "dash", width=1.8)),
        ), ""

    which, unit = _name_of(motions.worst), view.fit.unit
    several = (
        f"{which}: of {motions.count} held-out motions, the one with the largest error relative to "
        "the signal of each joint."
    )
    return _per_joint(
        view.fit,
        motions.measured - motions.predicted,
        "Held-out trajectory: measured and predicted",
        several if motions.count > 1 else f"{which}.",
        ("time [s]", f"{quantity(unit)} [{unit}]"),
        curves,
    )


def _name_of(condition: Conditions) -> str:
    source = PurePath(condition.source).name
    if condition.trajectory < 0:
        return f"{condition.kind.capitalize()} {condition.id}"
    return f"Trajectory {condition.trajectory} (counted from 0) of {source}"


@figure("model")
def friction_over_velocity(view: ModelView) -> Figure | None:
    """Return the figure of measured friction and friction of the model over velocity.

    The measured friction is the measured effort minus all parts of the model except friction.
    """
    friction = view.shown.friction
    seen = friction.in_motion if friction else None
    if friction is None or seen is None or view.shown.motions is None:
        return None

    def panel(j: int, name: str) -> Panel:
        curves = friction_in_motion_curves(seen, j)
        alt = f"{IN_MOTION}, {name}: {_ends(seen, curves[-1], j, friction.unit)}"
        titles = (joint_title(j, name), "velocity [°/s]", f"friction [{friction.unit}]")
        return Panel(*titles, curves, alt=alt)

    panels = tuple(panel(j, name) for j, name in enumerate(view.fit.joint_names))
    return Figure("friction", IN_MOTION, _how_to_read(seen), panels, 0)


BINS = 30
"""Number of velocity bins for each direction of motion."""
ERRORS = 2.0
"""Half-width of the confidence band, as a number of standard errors."""


def friction_in_motion_curves(seen: FrictionInMotion, j: int) -> tuple[Curve, ...]:
    """Return the curves of the friction of one joint over its velocity.

    The first curve is the cloud of samples, and the last curve is the line of the model.
    """
    good = np.isfinite(seen.measured[:, j]) & np.isfinite(seen.qd[:, j])
    qd, measured = seen.qd[good, j] * DEGREES, seen.measured[good, j]
    some = thinned(len(qd), CLOUD)
    look = Look(colours.MEASURED, size=_mark_size(len(some)), opacity=0.5)
    name = "measured, minus the rest of the model"
    cloud = Curve(name, qd[some], measured[some], "points", look=look)
    if seen.law_qd is None or seen.curve is None:
        return (cloud, *_mean(qd, seen.predicted[good, j]))
    return (cloud, *_law(seen.law_qd[:, j], seen.curve, j))


def _law(velocity: FloatArray, curve: FrictionCurve, j: int) -> list[Curve]:
    qd, torque, dry = velocity * DEGREES, curve.torque[:, j], curve.dry[:, j]
    half = ERRORS * curve.std_error[:, j]
    dashed = Look(colours.NEUTRAL, "dash", width=1.4)
    curves = [Curve("without its viscous part", qd, dry, look=dashed)]
    if np.isfinite(half).all():
        name = f"± {ERRORS:g} standard errors (upper bound)"
        edge = Look(colours.PREDICTED, "dot")
        curves += [Curve(name, qd, torque + side * half, look=edge) for side in (1, -1)]
    solid = Look(colours.PREDICTED, width=2.2)
    return [*curves, Curve("friction of the model", qd, torque, look=solid)]


def _mean(qd: FloatArray, predicted: FloatArray) -> list[Curve]:
    """Return the mean and standard deviation of the predicted friction, per direction of motion."""
    sides = [binned(qd[rows], predicted[rows], BINS) for rows in (qd < 0, qd > 0)]
    centre, mean, spread = (np.concatenate(part) for part in zip(*sides, strict=True))
    return _mean_and_spread(centre, mean, spread, "friction of the model, mean")


def _ends(seen: FrictionInMotion, drawn: Curve, j: int, unit: str) -> str:
    """Return a text with the friction at the two ends of the model line and the residual RMS."""
    x, y = np.asarray(drawn.x, dtype=np.float64), np.asarray(drawn.y)
    ends = [
        f"{number(float(y[i]))} {unit} at {number(float(x[i]))} °/s"
        for i in ((0, -1) if np.isfinite(x).any() else ())
    ]
    rms = number(_rms(seen.measured[:, j] - seen.predicted[:, j]))
    return f"model {' and '.join(ends) or 'unknown'}; residual RMS {rms} {unit}"


def _how_to_read(seen: FrictionInMotion) -> str:
    """Return the text that explains points and lines in the figure of friction over velocity."""
    lead = (
        "Points are the measured effort of the held-out trajectories minus the gravity, inertia "
        "and payload of the model: the rest is friction and the error of the model. "
    )
    if seen.learned:
        lead += (
            "The output of the model's network counts as friction, in points and line, although "
            "it possibly corrects other parts of the physics. "
        )
    if seen.curve is None:
        return lead + (
            "The solid line is the mean friction of the model at each velocity on these "
            "trajectories; the dotted lines are ± one standard deviation."
        )
    terms = seen.curve.terms
    first = "static friction, which falls towards Coulomb friction with speed"
    parts = [f"half its step at zero is {first if STATIC in terms else 'Coulomb friction'}"]
    if OFFSET in terms:
        parts.append("the middle of the step is the offset")
    if VISCOUS in terms:
        parts.append("its distance from the dashed line is viscous friction")
    lead += (
        "The solid line is the friction of the model within the velocities of these trajectories: "
        f"{'; '.join(parts)}. "
    )
    if np.isfinite(seen.curve.std_error).all(axis=0).any():
        return lead + (
            "The band adds the standard errors of all parts, as if all errors had the same sign, "
            "and is therefore an upper bound."
        )
    return lead + "No band is drawn, because the model has no standard errors for this line."


@figure("model")
def trajectory_residual_over_time(view: ModelView) -> Figure | None:
    """Return the figure of the residuals over time in the trajectory with the largest error."""
    if (motions := view.shown.motions) is None:
        return None
    residual = motions.measured - motions.predicted

    def curves(j: int) -> _Series:
        x, y = decimated(motions.t, residual[:, j])
        return (Curve("measured − predicted", x, y, look=Look(colours.RESIDUAL)),), ""

    title = "The same trajectory: residual over time"
    axes = ("time [s]", f"residual [{view.fit.unit}]")
    return _per_joint(view.fit, residual, title, "", axes, curves, banded=True)


@figure("model")
def residual_over_velocity(view: ModelView) -> Figure | None:
    """Return the figure of the residuals of all trajectories over velocity."""
    if (motions := view.shown.motions) is None:
        return None
    return _residual(
        view.fit,
        motions,
        "All held-out trajectories: residual against velocity",
        "A step at zero shows friction that the model lacks.",
        (motions.qd * DEGREES, "velocity [°/s]"),
    )


@figure("model")
def residual_over_pose(view: ModelView) -> Figure | None:
    """Return the figure of the residuals of all trajectories over the joint angle."""
    if (motions := view.shown.motions) is None:
        return None
    title = "All held-out trajectories: residual against pose"
    return _residual(view.fit, motions, title, "", (motions.q * DEGREES, "joint angle [°]"))


@figure("model")
def trajectory_regression(view: ModelView) -> Figure | None:
    """Return the figure of measured over predicted effort of all trajectories."""
    if (motions := view.shown.motions) is None:
        return None
    return _regression(view.fit, motions, "All held-out trajectories: regression")


@figure("model")
def learning_curves(view: ModelView) -> Figure | None:
    """Return the figure of loss and validation error over epochs; None without a network."""
    document = as_object(view.fit.model.get("fitted")).get("curves")
    try:
        curves = Curves.from_dict(document) if isinstance(document, dict) else None
    except (KeyError, TypeError, ValueError, OverflowError):  # a damaged model file
        curves = None
    if curves is None or not len(curves):
        return None
    stages = "; ".join(f"{name}: {count}" for name, count in curves.spans())
    best = (
        f"The model has the weights of epoch {curves.best_epoch} of {len(curves)}"
        if curves.best_epoch
        else f"The model has the untrained weights, because none of {len(curves)} epochs was better"
    )
    lead = (
        f"{best}: validation error {number(curves.best)}, untrained {number(curves.untrained)}. "
        f"Epochs by stage: {stages}."
    )
    return Figure("learning", "Learning curves", lead, (learning_panel(curves, lead),), 1)


def learning_panel(curves: Curves, alt: str = "") -> Panel:
    """Return a panel of loss and validation error over the epochs.

    The vertical axis is logarithmic; vertical lines separate the stages of the network training.
    """
    epoch = np.arange(1.0, len(curves) + 1)
    validation = np.array([curves.untrained, *curves.validation])
    kept = Look(colours.PREDICTED, symbol="diamond", size=9, opacity=1.0)
    ends = list(accumulate(count for _, count in curves.spans()))[:-1]
    return Panel(
        "Training",
        "epoch",
        "loss, error [1]",
        (
            Curve("training loss", epoch, np.array(curves.loss), look=Look(colours.MEASURED)),
            Curve(
                "validation error",
                np.append(0.0, epoch),
                validation,
                look=Look(colours.PREDICTED, "dash"),
            ),
            Curve("selected", [float(curves.best_epoch)], [curves.best], "points", look=kept),
        ),
        alt=alt,
        wide=True,
        # On a logarithmic axis, plotly omits values that are not positive, such as an error of 0.
        y_axis=Axis("log"),
        marks=tuple(Mark(end + 0.5, name="next stage") for end in ends),
    )


def _residual(
    fit: FitFacts,
    data: DwellPredictions | MotionPredictions,
    title: str,
    lead: str,
    over: tuple[FloatArray, str],
) -> Figure:
    """Return the figure of the residuals of every joint (N, n) over a quantity (N, n).

    Each panel shows the point cloud, its mean and its standard deviation.
    """
    (x, x_title), residual = over, _residual_of(data)

    def curves(j: int) -> _Series:
        return residual_curves(x[:, j], residual[:, j]), ""

    return _per_joint(
        fit, residual, title, lead, (x_title, f"residual [{fit.unit}]"), curves, banded=True
    )


def residual_curves(x: FloatArray, residual: FloatArray) -> tuple[Curve, ...]:
    """Return the cloud of residuals (N,) over x (N,), and mean and standard deviation per bin."""
    good = np.isfinite(x) & np.isfinite(residual)
    x, residual = x[good], residual[good]
    some = thinned(len(x), CLOUD)
    look = Look(colours.NEUTRAL, size=_mark_size(len(some)), opacity=0.65)
    cloud = Curve("measured − predicted", x[some], residual[some], "points", look=look)
    centre, mean, spread = binned(x, residual)
    if len(centre) < 2:
        return (cloud,)
    return (cloud, *_mean_and_spread(centre, mean, spread, "mean"))


def _mean_and_spread(x: FloatArray, mean: FloatArray, spread: FloatArray, name: str) -> list[Curve]:
    edge, solid = Look(colours.PREDICTED, "dot", width=1.3), Look(colours.PREDICTED, width=2.2)
    edges = [Curve("mean ± 1 SD", x, mean + side * spread, look=edge) for side in (1, -1)]
    return [*edges, Curve(name, x, mean, look=solid)]


def _regression(fit: FitFacts, data: DwellPredictions | MotionPredictions, title: str) -> Figure:
    measured, predicted = _both(data)

    def curves(j: int) -> _Series:
        return regression_curves(measured[:, j], predicted[:, j])

    axes = (f"predicted [{fit.unit}]", f"measured [{fit.unit}]")
    return _per_joint(fit, measured - predicted, title, "", axes, curves)


def regression_curves(measured: FloatArray, predicted: FloatArray) -> _Series:
    """Return the cloud of measured over predicted values (N,), the line y = x, and a text on R."""
    good = np.isfinite(measured) & np.isfinite(predicted)
    measured, predicted = measured[good], predicted[good]
    some = thinned(len(measured), CLOUD)
    ends = np.array(span(np.concatenate([measured, predicted])))
    sample = Look(colours.MEASURED, size=_mark_size(len(some)))
    curves = (
        Curve("sample", predicted[some], measured[some], "points", look=sample),
        Curve("measured = predicted", ends, ends, look=Look(colours.PREDICTED, "dash")),
    )
    if len(measured) < 2 or np.ptp(measured) == 0 or np.ptp(predicted) == 0:
        return curves, "R undefined"
    r = float(np.corrcoef(measured, predicted)[0, 1])
    return curves, f"R = {round(r, 4) + 0.0:.4f}"


def _per_joint(
    fit: FitFacts,
    residual: FloatArray,
    title: str,
    lead: str,
    axes: tuple[str, str],
    curves: Callable[[int], _Series],
    *,
    banded: bool = False,
) -> Figure:
    """Return a figure with one panel per joint, each labelled with the RMS of `residual` (N, n).

    If `banded` is true, a shaded band in each panel shows the noise floor of the measured signal.
    """
    fast = fit.values("noise_floor")
    name = f"± RMS of the measured signal's {fit.fast_part}"

    def panel(j: int, joint: str) -> Panel:
        drawn, corner = curves(j)
        alt = f"{title}, {joint}: residual RMS {number(_rms(residual[:, j]))} {fit.unit}"
        band = Band(name, float(fast[j])) if banded else None
        return Panel(joint_title(j, joint), *axes, drawn, corner, alt, band=band)

    panels = tuple(panel(j, joint) for j, joint in enumerate(fit.joint_names))
    return Figure("", title, lead, panels, 0)


def _both(data: DwellPredictions | MotionPredictions) -> tuple[FloatArray, FloatArray]:
    if isinstance(data, DwellPredictions):
        return data.measured, data.predicted
    return data.all_measured, data.all_predicted


def _residual_of(data: DwellPredictions | MotionPredictions) -> FloatArray:
    measured, predicted = _both(data)
    return measured - predicted


def _mark_size(points: int) -> float:
    """Return the mark size [px], which decreases with the number of points."""
    return 3.0 if points > 300 else 4.0 if points > 100 else 6.0


def _rms(values: FloatArray) -> float:
    """Return the root mean square of the finite values; NaN if no value is finite."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")
