"""What a trial found, as tables, figures and sentences, for page and terminal alike."""

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
    "A Fourier trajectory of ten seconds with a seed of its own, which experiments do not have "
    f"unless they ask for it, followed by the same PD controller at {RATE_HZ:g} Hz every time; "
    "only the torque given ahead of any error differs. Its gains are soft (last section), as "
    "suits an arm among people: a firmer controller leaves less for a model to gain.",
)

HAND_TEXT = (
    "A hand, which is a spring and a damper at every joint, leads one joint after the other forth "
    "and back, then all together, and lets go while they move at their fastest. Its effort is the "
    "torque at a joint while that is led. With the drives off it carries the arm as well.",
    "Most of what that saves is the weight of the arm, and gravity of the datasheet saves much of "
    "it too. What compensating friction is worth shows between gravity alone, and gravity and "
    "friction.",
)


def found(trial: Trial) -> StudyResult:
    """Everything worth showing."""
    hand = (shares(trial), efforts(trial))
    parts = (
        Part("Feed-forward", "", TRACKING_TEXT, _tracking_tables(trial), errors(trial)),
        Part("Led by hand", "", HAND_TEXT, _hand_tables(trial), hand),
        Part("The controller", "", (), (_controller(trial),)),
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
            "trajectory": f"seed {trial.seed} (drawn with {SEEDS_APART + trial.seed})",
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
    """A row for each joint, so that the numbers of a column are of one size."""
    names = [f"J{j + 1} {name}" for j, name in enumerate(trial.joint_names)]
    cells = (values(column) for column in columns.values())
    rows = tuple(zip(names, *cells, strict=True))
    return Table(key, title, ("joint", *columns), rows, note)


PEAK = (
    "Measured, not a limit: the hand has none. With the drives off it is the weight, else what a "
    "joint takes to break loose; no friction is carried then, so it hardly depends on that."
)

LET_GO = (
    "The less the better, and at rest: an arm that was led coasts on its own inertia, further the "
    "less friction is left. With the drives off the brakes hold the arm then."
)


def _hand_tables(trial: Trial) -> tuple[Table, ...]:
    rms = {run.way: run.rms for run in trial.led}
    peak = {run.way: run.peak for run in trial.led}
    titles = joint_titles(len(trial.joint_names))
    free = tuple((run.way, *values(np.degrees(run.ran_on)), value(run.rest_s)) for run in trial.led)
    return (
        _by_joint(trial, "table-hand-rms", "Effort of the hand, RMS [N·m]", rms),
        _by_joint(trial, "table-hand-share", "The same as a share [%]", _shares(trial)),
        _by_joint(trial, "table-hand-peak", "Effort of the hand, largest [N·m]", peak, PEAK),
        Table(
            "table-let-go",
            "How far joints ran on when the hand let go [°]",
            ("drives give", *titles, "at rest after [s]"),
            free,
            LET_GO,
        ),
    )


def _shares(trial: Trial) -> dict[str, FloatArray]:
    """RMS effort of the hand with one help over that with another [%], where both were run."""
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
    return _by_joint(trial, "table-pd", "The PD controller", gains, "The same for every law.")


def _sentences(trial: Trial) -> Iterator[str]:
    yield from (f"MISSED: {item.asked}; {item.found}." for item in judged(trial) if not item.met)
    told = [f"{np.degrees(mean_of(run.rms)):.3f}° with {run.law}" for run in trial.tracked
            if not run.stopped]  # fmt: skip
    yield f"Tracking error, RMS, mean over the joints: {listed(told)}."
    if np.isfinite(improvement(trial)):
        yield (
            f"With the model it is {improvement(trial):.1f} times smaller than with "
            f"{unaided(trial)}, the best that needs no identification, behind a soft PD controller."
        )
    way = most_help(trial)
    for over in (try_out.NOTHING, try_out.DATASHEET, try_out.GRAVITY):
        share = relief(trial, way, over)
        if over != way and np.isfinite(share).all():
            yield f"Effort of the hand with {way}, of that with {over}: {halves(share)}."
    yield from _of_the_unaided(trial)
    if trial.led and all(np.isfinite(led.rest_s) for led in trial.led):
        last = max(led.rest_s for led in trial.led)
        yield f"After the hand had let go the arm was at rest within {last:.1f} s every time."


def _of_the_unaided(trial: Trial) -> Iterator[str]:
    """What went wrong in runs that the model is only compared with."""
    runs: tuple[Tracked | Led, ...] = (*trial.tracked, *trial.led)
    for run in runs:
        name = run.law if isinstance(run, Tracked) else run.way
        if run.stopped and name in (*controllers.UNIDENTIFIED, try_out.NOTHING, try_out.DATASHEET):
            yield f"Without the model, {name}, the arm was braked: {run.stopped}."
    for led in trial.led:
        if not led.stopped and not np.isfinite(led.rest_s) and led.way == try_out.DATASHEET:
            yield f"With {led.way} the arm did not come to rest after the hand had let go."


DRAWN_HZ = 50.0
"""Points of a curve, per second of the motion."""


def errors(trial: Trial) -> tuple[Figure, Figure]:
    """Tracking errors with and without the model, and its own, which the others dwarf."""
    # The model first, so that it looks the same in both.
    beside = [run for run in reversed(trial.tracked) if run.law != controllers.GRAVITY]
    own = [run for run in trial.tracked if run.law == controllers.MODEL]
    caption = "Position wanted minus position. Gravity of the model alone is in the table."
    return (
        _errors(trial, "fig-tracking", "Tracking error", caption, beside),
        _errors(trial, "fig-tracking-model", "Tracking error with the model alone",
                "The same at a scale of its own.", own),
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
    """Effort of the hand over the angle led."""
    runs = [run for run in reversed(trial.led) if run.way != try_out.DATASHEET]
    panels = [
        Panel(
            f"J{j + 1} {name}", "angle led [°]", "effort of the hand [N·m]",
            tuple(_turn(run, j, float(trial.leading.start[j])) for run in runs),
        )
        for j, name in enumerate(trial.joint_names)
    ]  # fmt: skip
    caption = (
        "Torque of the hand while the joint is led, over the angle from where it began. The height "
        "of a loop is friction, its slope and level are gravity, and the spring of the hand."
    )
    return Figure("fig-hand", "Effort of the hand", caption, tuple(panels), 2)


def _turn(run: Led, joint: int, start: float) -> Curve:
    rows = run.turn == joint
    return _line(run.way, np.degrees(run.q[rows, joint] - start), run.effort[rows, joint])


def shares(trial: Trial) -> Figure:
    """RMS effort of the hand as a share of that with the drives off."""
    titles = joint_titles(len(trial.joint_names))
    curves = tuple(
        Curve(way, titles, _tuple(100 * relief(trial, way, try_out.NOTHING)), "bars")
        for way in (run.way for run in reversed(trial.led))
        if way != try_out.NOTHING
    )
    panel = Panel("RMS effort of the hand", "joint", "of that with the drives off [%]", curves)
    return Figure("fig-hand-rms", "What is left of the effort", "", (panel,), 1)
