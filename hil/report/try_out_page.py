"""The page of `hil try-out`: tracking errors and the effort of a hand, with and without a model."""

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
    """The page as blocks."""
    told = found(trial)
    about = Facts("How it was made", items({**told.parameters, "took": duration(told.seconds)}))
    return Page(
        title=told.title,
        subtitle=f"{Path(trial.model).name} tried on {trial.robot}",
        badge=_badge(trial),
        summary=told.summary[0],
        key_figures=tuple(_key_figures(trial)),
        warnings=told.warnings,
        sections=(
            Section("found", "What was found", "", (_criteria(trial), Notes(told.summary), about)),
            *study_sections([told])[1:],
        ),
        footer="A simulated arm; on a real one watch its limits yourself, with a hand on the stop.",
    )


def _badge(trial: Trial) -> Badge:
    met = [criterion.met for criterion in judged(trial)]
    if all(met):
        return Badge(f"all {len(met)} criteria met", "pass")
    return Badge(f"{len(met) - sum(met)} of {len(met)} criteria missed", "fail")


def _criteria(trial: Trial) -> Table:
    columns = ("criterion", "met", "found", "what to do")
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
        "What the model is held to",
        tuple(Column(title, number=False) for title in columns[:shown]),
        tuple(row[:shown] for row in rows),
    )


def _key_figures(trial: Trial) -> list[KeyFigure]:
    figures = []
    if np.isfinite(improvement(trial)):
        told = f"of that with the model, behind a soft PD controller: {unaided(trial)}"
        figures.append(KeyFigure("tracking error without", f"{improvement(trial):.0f} ×", told))
    way = most_help(trial)
    for over, label in (
        (NOTHING, "effort of the hand"),
        (DATASHEET, "the same, beside the datasheet"),
        (GRAVITY, "the same, by friction alone"),
    ):
        share = relief(trial, way, over)
        if over != way and np.isfinite(share).all():
            value = f"{100 * np.mean(share):.0f} %"
            figures.append(KeyFigure(label, value, f"of that with {over}, mean over the joints"))
    return figures
