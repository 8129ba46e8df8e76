"""What a trial found, as tables, figures and sentences, for page and terminal alike."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from hil.study.result import Curve, Figure, Panel, Part, StudyResult, Table
from hil.study.separation_text import joint_titles, listed, mean_of, value, values
from hil.trial import laws, leading
from hil.trial.arm import RATE_HZ
from hil.trial.leading import Led
from hil.trial.tracking import Tracked
from hil.trial.trial import SPEED_HZ, Trial
from hil.typing import FloatArray

NAME = "try-out"

DRAWN_HZ = 50.0
"""Points of a curve, per second of the motion."""

TRACKING_TEXT = (
    "A Fourier trajectory of ten seconds that no training has seen, followed by the same PD "
    f"controller at {RATE_HZ:g} Hz every time; only the torque given ahead of any error differs.",
)

HAND_TEXT = (
    "A hand, which is a spring and a damper at every joint, leads one joint after the other forth "
    "and back, then all together, and lets go while they move at their fastest. Its effort is the "
    "torque at a joint while that is led. With the drives off it carries the arm as well.",
    "Most of what that saves is the weight of the arm. What compensating friction is worth shows "
    "between gravity alone, and gravity and friction.",
)


def found(trial: Trial) -> StudyResult:
    """Everything worth showing."""
    parts = (
        Part("Feed-forward", "", TRACKING_TEXT, _tracking_tables(trial), (_errors(trial),)),
        Part("Led by hand", "", HAND_TEXT, _hand_tables(trial), (_efforts(trial), _bars(trial))),
    )
    return StudyResult(
        NAME,
        f"What {trial.estimator} is worth to a controller",
        tuple(_sentences(trial)),
        parts,
        {
            "robot": trial.robot,
            "arm": trial.serial,
            "fitted on": trial.fitted_on or "not told",
            "payload": "none" if trial.payload.is_empty else str(trial.payload),
            "trajectory": f"seed {trial.seed}",
            "controller": f"{RATE_HZ:g} Hz",
            "friction compensated": f"{100 * trial.friction_share:g} % of the dry friction",
            "velocity for its direction": f"below {SPEED_HZ:g} Hz",
        },
        trial.seconds,
        trial.notes,
    )


def improvement(trial: Trial) -> float:
    """Mean RMS error without a model over that with the whole model; NaN where one failed."""
    by_law = {run.law: mean_of(run.rms) for run in trial.tracked}
    return by_law[laws.NOTHING] / by_law[laws.MODEL]


def relief(trial: Trial, of: str, over: str) -> FloatArray:
    """(n,) RMS effort of the hand with one help over that with another; NaN without a run."""
    by_way = {run.way: run.rms for run in trial.led}
    if of not in by_way or over not in by_way:
        return np.full(len(trial.joint_names), np.nan)
    return by_way[of] / by_way[over]


def runs_of(trial: Trial) -> Sequence[Tracked | Led]:
    """All runs."""
    return (*trial.tracked, *trial.led)


def _sentences(trial: Trial) -> Iterator[str]:
    told = [f"{np.degrees(mean_of(run.rms)):.3f}° with {run.law}" for run in trial.tracked
            if not run.stopped]  # fmt: skip
    yield f"Tracking error, RMS, mean over the joints: {listed(told)}."
    if np.isfinite(improvement(trial)):
        yield f"With the model it is {improvement(trial):.0f} times smaller than without."
    for of, over in (
        (leading.FRICTION, leading.NOTHING),
        (leading.FRICTION, leading.GRAVITY),
    ):
        share = relief(trial, of, over)
        if np.isfinite(share).all():
            yield (
                f"Effort of the hand with {of}, of that with {over}: "
                f"{100 * np.min(share):.0f} to {100 * np.max(share):.0f} %, "
                f"at most half in {np.sum(share <= 0.5)} of {len(share)} joints."
            )
    for run in runs_of(trial):
        if run.stopped:
            yield f"BRAKED, {run.law if isinstance(run, Tracked) else run.way}: {run.stopped}."
    restless = [led.way for led in trial.led if not np.isfinite(led.rest_s)]
    if restless:
        yield f"NOT AT REST after the hand had let go: {listed(restless)}."
    elif trial.led:
        last = max(led.rest_s for led in trial.led)
        yield f"After the hand had let go the arm was at rest within {last:.1f} s every time."


def _tracking_tables(trial: Trial) -> tuple[Table, ...]:
    rms = {run.law: np.degrees(run.rms) for run in trial.tracked}
    worst = {run.law: np.degrees(run.worst) for run in trial.tracked}
    note = ". ".join(f"{law}: {told}" for law, told in laws.TOLD.items()) + "."
    pd = {"stiffness [N·m/rad]": trial.pd.stiffness, "damping [N·m·s/rad]": trial.pd.damping}
    return (
        _by_joint(trial, "table-tracking-rms", "RMS tracking error [°]", rms, note),
        _by_joint(trial, "table-tracking-worst", "Largest tracking error [°]", worst),
        _by_joint(trial, "table-pd", "The PD controller", pd),
    )


def _hand_tables(trial: Trial) -> tuple[Table, ...]:
    rms = {run.way: run.rms for run in trial.led}
    peak = {run.way: run.peak for run in trial.led}
    broken = "The largest is what it takes to break a joint loose: at rest no friction is carried."
    titles = joint_titles(len(trial.joint_names))
    free = tuple((run.way, *values(np.degrees(run.ran_on)), value(run.rest_s)) for run in trial.led)
    return (
        _by_joint(trial, "table-hand-rms", "Effort of the hand, RMS [N·m]", rms),
        _by_joint(trial, "table-hand-share", "The same as a share [%]", _shares(trial)),
        _by_joint(trial, "table-hand-peak", "Effort of the hand, largest [N·m]", peak, broken),
        Table(
            "table-let-go",
            "How far joints ran on when the hand let go [°]",
            ("drives give", *titles, "at rest after [s]"),
            free,
            "With the drives off the brakes hold the arm then.",
        ),
    )


def _shares(trial: Trial) -> dict[str, FloatArray]:
    """RMS effort of the hand with one help over that with another [%], where both were run."""
    pairs = (
        (leading.GRAVITY, leading.NOTHING),
        (leading.FRICTION, leading.NOTHING),
        (leading.FRICTION, leading.GRAVITY),
    )
    shares = {f"{of} / {over}": 100 * relief(trial, of, over) for of, over in pairs}
    return {name: share for name, share in shares.items() if np.isfinite(share).any()}


def _by_joint(
    trial: Trial, key: str, title: str, columns: Mapping[str, FloatArray], note: str = ""
) -> Table:
    """A row for each joint, so that the numbers of a column are of one size."""
    names = [f"J{j + 1} {name}" for j, name in enumerate(trial.joint_names)]
    cells = (values(column) for column in columns.values())
    rows = tuple(zip(names, *cells, strict=True))
    return Table(key, title, ("joint", *columns), rows, note)


def _errors(trial: Trial) -> Figure:
    panels = [
        Panel(
            f"J{j + 1} {name}", "time [s]", "error [°]",
            tuple(_line(run.law, run.t, np.degrees(run.error[:, j])) for run in trial.tracked),
        )
        for j, name in enumerate(trial.joint_names)
    ]  # fmt: skip
    return Figure(
        "fig-tracking", "Tracking error", "Position wanted minus position.", tuple(panels), 2
    )


def _efforts(trial: Trial) -> Figure:
    panels = [
        Panel(
            f"J{j + 1} {name}", "angle led [°]", "effort of the hand [N·m]",
            tuple(_turn(run, j, float(trial.leading.start[j])) for run in trial.led),
        )
        for j, name in enumerate(trial.joint_names)
    ]  # fmt: skip
    caption = (
        "Torque of the hand while the joint is led, over the angle from where it began. The height "
        "of a loop is friction, its slope and level are gravity, and the spring of the hand."
    )
    return Figure("fig-hand", "Effort of the hand", caption, tuple(panels), 2)


def _bars(trial: Trial) -> Figure:
    titles = joint_titles(len(trial.joint_names))
    curves = tuple(
        Curve(way, titles, _tuple(100 * relief(trial, way, leading.NOTHING)), "bars")
        for way in (run.way for run in trial.led)
    )
    panel = Panel("RMS effort of the hand", "joint", "of that with the drives off [%]", curves)
    return Figure("fig-hand-rms", "What is left of the effort", "", (panel,), 1)


def _turn(run: Led, joint: int, start: float) -> Curve:
    rows = run.turn == joint
    return _line(run.way, np.degrees(run.q[rows, joint] - start), run.effort[rows, joint])


def _line(name: str, x: FloatArray, y: FloatArray) -> Curve:
    every = max(1, round(RATE_HZ / DRAWN_HZ))
    return Curve(name, _tuple(x[::every]), _tuple(y[::every]))


def _tuple(numbers: FloatArray) -> tuple[float, ...]:
    return tuple(round(float(number), 5) for number in numbers)
