"""Report of a control trial: tables, figures and sentences for web page and terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from hil.control import controllers, try_out
from hil.control.try_out import (
    Led,
    Tracked,
    Trial,
    halves,
    improvement,
    judged,
    most_help,
    relief,
    unaided,
)
from hil.control.try_out_settings import RATE_HZ, SEEDS_APART, SPEED_HZ
from hil.core import FloatArray
from hil.studies import (
    Curve,
    Figure,
    Panel,
    Part,
    StudyResult,
    Table,
    joint_titles,
    listed,
    mean_of,
    value,
    values,
)

NAME = "try-out"

TRACKING_TEXT = (
    "Motion: a Fourier trajectory of ten seconds, with a seed that experiments do not use by "
    f"default. The same PD controller at {RATE_HZ:g} Hz is used in all runs; only the feed-forward "
    "torque differs. The gains of the controller are low (last section), as for an arm near "
    "people. With higher gains, the improvement by a model is smaller.",
)

HAND_TEXT = (
    "The hand is a spring and a damper at every joint. It guides one joint after the other back "
    "and forth, then all joints together, and releases the arm at the largest speed. The effort of "
    "the hand is the torque at a joint while this joint is guided. With the drives off, the hand "
    "also carries the weight of the arm.",
    "The largest part of the reduction is the weight of the arm; gravity of the datasheet arm "
    "reduces the effort as well. The effect of friction compensation is the difference between "
    "gravity, and gravity and friction.",
)


def found(trial: Trial) -> StudyResult:
    """Return the complete report of a control trial."""
    hand = (shares(trial), efforts(trial))
    parts = (
        Part("Feed-forward", "", TRACKING_TEXT, _tracking_tables(trial), errors(trial)),
        Part("Hand guiding", "", HAND_TEXT, _hand_tables(trial), hand),
        Part("The controller", "", (), (_controller(trial),)),
    )
    return StudyResult(
        NAME,
        f"Control with the model {trial.estimator}",
        tuple(_sentences(trial)),
        parts,
        {
            "robot": trial.robot,
            "arm": trial.serial,
            "fitted on": trial.fitted_on or "unknown",
            "payload": "none" if trial.payload.is_empty else str(trial.payload),
            "trajectory": f"seed {trial.seed} (random generator: {SEEDS_APART + trial.seed})",
            "controller": f"{RATE_HZ:g} Hz",
            "friction compensated": f"{100 * trial.friction_share:g} % of the dry friction",
            "velocity for its direction": f"below {SPEED_HZ:g} Hz",
        },
        trial.seconds,
        trial.notes,
    )


def _tracking_tables(trial: Trial) -> tuple[Table, ...]:
    rms = {run.law: np.degrees(run.rms) for run in trial.tracked}
    worst = {run.law: np.degrees(run.worst) for run in trial.tracked}
    note = ". ".join(f"{law}: {told}" for law, told in controllers.TOLD.items()) + "."
    return (
        _by_joint(trial, "table-tracking-rms", "RMS tracking error [°]", rms, note),
        _by_joint(trial, "table-tracking-worst", "Largest tracking error [°]", worst),
    )


def _by_joint(
    trial: Trial, key: str, title: str, columns: Mapping[str, FloatArray], note: str = ""
) -> Table:
    """Return a table with one row per joint, so that the numbers of a column have similar size."""
    names = [f"J{j + 1} {name}" for j, name in enumerate(trial.joint_names)]
    cells = (values(column) for column in columns.values())
    rows = tuple(zip(names, *cells, strict=True))
    return Table(key, title, ("joint", *columns), rows, note)


PEAK = (
    "Measured value; the force of the hand has no limit. With the drives off, the maximum is the "
    "weight. Otherwise it is the breakaway torque of a joint, which hardly depends on friction "
    "compensation, because a static joint has none."
)

LET_GO = (
    "Small values are good, and the arm must come to rest. After the release, the arm coasts by "
    "its inertia; with less remaining friction it coasts further. With the drives off, the brakes "
    "hold the arm after the release."
)


def _hand_tables(trial: Trial) -> tuple[Table, ...]:
    rms = {run.way: run.rms for run in trial.led}
    peak = {run.way: run.peak for run in trial.led}
    titles = joint_titles(len(trial.joint_names))
    free = tuple((run.way, *values(np.degrees(run.ran_on)), value(run.rest_s)) for run in trial.led)
    return (
        _by_joint(trial, "table-hand-rms", "Effort of the hand, RMS [N·m]", rms),
        _by_joint(trial, "table-hand-share", "RMS effort, relative [%]", _shares(trial)),
        _by_joint(trial, "table-hand-peak", "Effort of the hand, maximum [N·m]", peak, PEAK),
        Table(
            "table-let-go",
            "Motion of the joints after the release [°]",
            ("torque law", *titles, "at rest after [s]"),
            free,
            LET_GO,
        ),
    )


def _shares(trial: Trial) -> dict[str, FloatArray]:
    """Return the ratios of the RMS hand efforts with two laws [%], if both were run."""
    pairs: Sequence[tuple[str, str]] = (
        (try_out.DATASHEET, try_out.NOTHING),
        (try_out.GRAVITY, try_out.NOTHING),
        (try_out.FRICTION, try_out.NOTHING),
        (try_out.FRICTION, try_out.DATASHEET),
        (try_out.FRICTION, try_out.GRAVITY),
    )
    shares = {f"{of} / {over}": 100 * relief(trial, of, over) for of, over in pairs}
    return {name: share for name, share in shares.items() if np.isfinite(share).any()}


def _controller(trial: Trial) -> Table:
    gains = {
        "stiffness [N·m/rad]": trial.pd.stiffness,
        "damping [N·m·s/rad]": trial.pd.damping,
    }
    return _by_joint(trial, "table-pd", "PD controller", gains, "The same for all laws.")


def _sentences(trial: Trial) -> Iterator[str]:
    yield from (f"MISSED: {item.asked}; {item.found}." for item in judged(trial) if not item.met)
    told = [f"{np.degrees(mean_of(run.rms)):.3f}° with {run.law}" for run in trial.tracked
            if not run.stopped]  # fmt: skip
    yield f"Tracking error, RMS, mean over the joints: {listed(told)}."
    if np.isfinite(improvement(trial)):
        yield (
            f"With the model, the tracking error is {improvement(trial):.1f} times smaller than "
            f"with {unaided(trial)}, the best law without identification (soft PD controller)."
        )
    way = most_help(trial)
    for over in (try_out.NOTHING, try_out.DATASHEET, try_out.GRAVITY):
        share = relief(trial, way, over)
        if over != way and np.isfinite(share).all():
            yield f"Effort of the hand with {way}, relative to {over}: {halves(share)}."
    yield from _of_the_unaided(trial)
    if trial.led and all(np.isfinite(led.rest_s) for led in trial.led):
        last = max(led.rest_s for led in trial.led)
        yield f"After every release, the arm was at rest within {last:.1f} s."


def _of_the_unaided(trial: Trial) -> Iterator[str]:
    """Yield sentences about problems in the runs that are only a reference for the model."""
    runs: tuple[Tracked | Led, ...] = (*trial.tracked, *trial.led)
    for run in runs:
        name = run.law if isinstance(run, Tracked) else run.way
        if run.stopped and name in (*controllers.UNIDENTIFIED, try_out.NOTHING, try_out.DATASHEET):
            yield f"Without the model ({name}), the arm was braked: {run.stopped}."
    for led in trial.led:
        if not led.stopped and not np.isfinite(led.rest_s) and led.way == try_out.DATASHEET:
            yield f"With {led.way}, the arm did not come to rest after the release."


DRAWN_HZ = 50.0
"""Number of plotted points per second of the motion [1/s]."""


def errors(trial: Trial) -> tuple[Figure, Figure]:
    """Return two figures of the tracking error: all feed-forward laws, and the model alone.

    The tracking error with the model is too small to be visible next to the errors of the other
    laws.
    """
    # The model is first, so that it has the same color in both figures.
    beside = [run for run in reversed(trial.tracked) if run.law != controllers.GRAVITY]
    own = [run for run in trial.tracked if run.law == controllers.MODEL]
    caption = "Commanded position minus position. The law with gravity only is in the table."
    return (
        _errors(trial, "fig-tracking", "Tracking error", caption, beside),
        _errors(trial, "fig-tracking-model", "Tracking error with the model",
                "The error with the model at a larger scale.", own),
    )  # fmt: skip


def _errors(trial: Trial, key: str, title: str, caption: str, runs: Sequence[Tracked]) -> Figure:
    panels = [
        Panel(
            f"J{j + 1} {name}", "time [s]", "error [°]",
            tuple(_line(run.law, run.t, np.degrees(run.error[:, j])) for run in runs),
        )
        for j, name in enumerate(trial.joint_names)
    ]  # fmt: skip
    return Figure(key, title, caption, tuple(panels), 2)


def _line(name: str, x: FloatArray, y: FloatArray) -> Curve:
    every = max(1, round(RATE_HZ / DRAWN_HZ))
    return Curve(name, _tuple(x[::every]), _tuple(y[::every]))


def _tuple(numbers: FloatArray) -> tuple[float, ...]:
    return tuple(round(float(number), 5) for number in numbers)


def efforts(trial: Trial) -> Figure:
    """Return the figure of the hand effort over the guided angle."""
    runs = [run for run in reversed(trial.led) if run.way != try_out.DATASHEET]
    panels = [
        Panel(
            f"J{j + 1} {name}", "guided angle [°]", "effort of the hand [N·m]",
            tuple(_turn(run, j, float(trial.leading.start[j])) for run in runs),
        )
        for j, name in enumerate(trial.joint_names)
    ]  # fmt: skip
    caption = (
        "Torque of the hand while the joint is guided, over the angle from the start. The height "
        "of a loop shows friction; its slope and level show gravity and the spring of the hand."
    )
    return Figure("fig-hand", "Effort of the hand", caption, tuple(panels), 2)


def _turn(run: Led, joint: int, start: float) -> Curve:
    rows = run.turn == joint
    return _line(run.way, np.degrees(run.q[rows, joint] - start), run.effort[rows, joint])


def shares(trial: Trial) -> Figure:
    """Return the figure of the RMS hand effort relative to that with the drives off."""
    titles = joint_titles(len(trial.joint_names))
    curves = tuple(
        Curve(way, titles, _tuple(100 * relief(trial, way, try_out.NOTHING)), "bars")
        for way in (run.way for run in reversed(trial.led))
        if way != try_out.NOTHING
    )
    panel = Panel("RMS effort of the hand", "joint", "relative to drives off [%]", curves)
    return Figure("fig-hand-rms", "Remaining effort of the hand", "", (panel,), 1)
