"""Figures of a trial: errors of tracking and efforts of the hand, joint by joint."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.control.trial import laws, leading
from hil.control.trial.arm import RATE_HZ
from hil.control.trial.judged import relief
from hil.control.trial.leading import Led
from hil.control.trial.result import Trial
from hil.control.trial.tracking import Tracked
from hil.core import FloatArray
from hil.studies import Curve, Figure, Panel, joint_titles

DRAWN_HZ = 50.0
"""Points of a curve, per second of the motion."""


def errors(trial: Trial) -> tuple[Figure, Figure]:
    """Tracking errors with and without the model, and its own, which the others dwarf."""
    # The model first, so that it looks the same in both.
    beside = [run for run in reversed(trial.tracked) if run.law != laws.GRAVITY]
    own = [run for run in trial.tracked if run.law == laws.MODEL]
    caption = "Position wanted minus position. Gravity of the model alone is in the table."
    return (
        _errors(trial, "fig-tracking", "Tracking error", caption, beside),
        _errors(trial, "fig-tracking-model", "Tracking error with the model alone",
                "The same at a scale of its own.", own),
    )  # fmt: skip


def efforts(trial: Trial) -> Figure:
    """Effort of the hand over the angle led."""
    runs = [run for run in reversed(trial.led) if run.way != leading.DATASHEET]
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


def shares(trial: Trial) -> Figure:
    """RMS effort of the hand as a share of that with the drives off."""
    titles = joint_titles(len(trial.joint_names))
    curves = tuple(
        Curve(way, titles, _tuple(100 * relief(trial, way, leading.NOTHING)), "bars")
        for way in (run.way for run in reversed(trial.led))
        if way != leading.NOTHING
    )
    panel = Panel("RMS effort of the hand", "joint", "of that with the drives off [%]", curves)
    return Figure("fig-hand-rms", "What is left of the effort", "", (panel,), 1)


def _errors(trial: Trial, key: str, title: str, caption: str, runs: Sequence[Tracked]) -> Figure:
    panels = [
        Panel(
            f"J{j + 1} {name}", "time [s]", "error [°]",
            tuple(_line(run.law, run.t, np.degrees(run.error[:, j])) for run in runs),
        )
        for j, name in enumerate(trial.joint_names)
    ]  # fmt: skip
    return Figure(key, title, caption, tuple(panels), 2)


def _turn(run: Led, joint: int, start: float) -> Curve:
    rows = run.turn == joint
    return _line(run.way, np.degrees(run.q[rows, joint] - start), run.effort[rows, joint])


def _line(name: str, x: FloatArray, y: FloatArray) -> Curve:
    every = max(1, round(RATE_HZ / DRAWN_HZ))
    return Curve(name, _tuple(x[::every]), _tuple(y[::every]))


def _tuple(numbers: FloatArray) -> tuple[float, ...]:
    return tuple(round(float(number), 5) for number in numbers)
