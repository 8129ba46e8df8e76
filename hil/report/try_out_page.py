"""Page of `hil simulate`: tracking errors and hand-guiding effort with and without a model."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hil.control import (
    DATASHEET,
    GRAVITY,
    NOTHING,
    Trial,
    found,
    improvement,
    judged,
    most_help,
    relief,
    unaided,
)
from hil.report.page import (
    Badge,
    Cell,
    Column,
    Facts,
    KeyFigure,
    Notes,
    Page,
    Section,
    Table,
    items,
)
from hil.report.study_sections import study_sections
from hil.report.words import duration

TRY_OUT_FILE = "report.html"


def trial_page(trial: Trial) -> Page:
    """Return the page of a simulated trial of a model."""
    told = found(trial)
    parameters = items({**told.parameters, "took": duration(told.seconds)})
    about = Facts("Parameters of the simulation", parameters)
    return Page(
        title=told.title,
        subtitle=f"{Path(trial.model).name} simulated on {trial.robot}",
        badge=_badge(trial),
        summary=told.summary[0],
        key_figures=tuple(_key_figures(trial)),
        warnings=told.warnings,
        sections=(
            Section("found", "Results", "", (_criteria(trial), Notes(told.summary), about)),
            *study_sections([told])[1:],
        ),
        footer="The arm is simulated. On a real arm, monitor its limits and keep the stop button "
        "within reach.",
    )


def _badge(trial: Trial) -> Badge:
    met = [criterion.met for criterion in judged(trial)]
    if all(met):
        return Badge(f"all {len(met)} criteria met", "pass")
    return Badge(f"{len(met) - sum(met)} of {len(met)} criteria missed", "fail")


def _criteria(trial: Trial) -> Table:
    columns = ("criterion", "met", "result", "what to do")
    rows = tuple(
        (
            Cell(criterion.asked),
            Cell("yes", "pass") if criterion.met else Cell("no", "fail"),
            Cell(criterion.found),
            Cell("" if criterion.met else criterion.mend),
        )
        for criterion in judged(trial)
    )
    shown = len(columns) - trial.ok
    return Table(
        "Criteria of the simulation",
        tuple(Column(title, number=False) for title in columns[:shown]),
        tuple(row[:shown] for row in rows),
    )


def _key_figures(trial: Trial) -> list[KeyFigure]:
    figures = []
    if np.isfinite(improvement(trial)):
        told = f"the error with the model; without: {unaided(trial)}, with a soft PD controller"
        figures.append(
            KeyFigure("tracking error without model", f"{improvement(trial):.0f} ×", told)
        )
    way = most_help(trial)
    for over, label in (
        (NOTHING, "effort of the hand"),
        (DATASHEET, "effort relative to the datasheet model"),
        (GRAVITY, "effort relative to gravity compensation"),
    ):
        share = relief(trial, way, over)
        if over != way and np.isfinite(share).all():
            value = f"{100 * np.mean(share):.0f} %"
            figures.append(KeyFigure(label, value, f"of that with {over}, mean over the joints"))
    return figures
