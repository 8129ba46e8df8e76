"""The page of `hil try-out`: tracking errors and the effort of a hand, with and without a model."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hil.report.blocks import Badge, Facts, KeyFigure, Notes, Page, Section, items
from hil.report.render import write_page
from hil.report.study_sections import study_sections
from hil.report.words import duration
from hil.trial import leading
from hil.trial.found import found, improvement, relief, runs_of
from hil.trial.trial import Trial

REPORT_FILE = "report.html"


def write_trial_page(trial: Trial, path: Path) -> Path:
    """Write the page to `path`, replacing an older one whole.

    Raises:
        RecordingError: The file cannot be written.
    """
    return write_page(trial_page(trial), path)


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
            Section("found", "What was found", "", (Notes(told.summary), about)),
            *study_sections([told])[1:],
        ),
        footer="A simulated arm; on a real one watch its limits yourself, with a hand on the stop.",
    )


def _badge(trial: Trial) -> Badge:
    if any(run.stopped for run in runs_of(trial)):
        return Badge("BRAKED", "fail")
    if not all(np.isfinite(run.rest_s) for run in trial.led):
        return Badge("NOT AT REST", "fail")
    return Badge("all runs ended", "pass")


def _key_figures(trial: Trial) -> list[KeyFigure]:
    figures = []
    if np.isfinite(improvement(trial)):
        label = "tracking error without a model"
        figures.append(KeyFigure(label, f"{improvement(trial):.0f} ×", "of that with it"))
    for over, label in (
        (leading.NOTHING, "effort of the hand"),
        (leading.GRAVITY, "the same, by friction alone"),
    ):
        share = relief(trial, leading.FRICTION, over)
        if np.isfinite(share).all():
            value = f"{100 * np.mean(share):.0f} %"
            figures.append(KeyFigure(label, value, f"of that with {over}, mean over the joints"))
    return figures
