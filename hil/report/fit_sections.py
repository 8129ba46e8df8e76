"""Sections about models: how they compare, and each one by itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hil.report import fit_tables
from hil.report.approach import approach_table
from hil.report.documents import as_float, as_object
from hil.report.fit_facts import FitFacts, best_first
from hil.report.load_criteria import criteria_under_loads
from hil.report.page import Block, Facts, Section, items
from hil.report.predictions import Shown
from hil.report.run_figures import ModelView, figures_of
from hil.report.words import in_words, number

READING = (
    "RMSE raw compares the prediction with the signal as it was measured, RMSE filtered with the "
    "same signal after a zero-phase low-pass at 0.20 of the Nyquist frequency (for dwells: their "
    "mean). What that takes away is shown as the part above the cut-off, for dwells as the scatter "
    "about their mean: noise, and friction that changes fast. NRMSE is RMSE raw over the standard "
    "deviation of the training signal: 1 is as good as always predicting the mean, and all there "
    "is to reach on a joint without signal. R is the correlation of the two (Pearson). MEP is the "
    "largest single error over the largest measured value: one sample decides it."
)


def model_sections(fits: Sequence[FitFacts], shown: Mapping[str, Shown]) -> list[Section]:
    """The comparison, then every model; the best one is open, the others unfold on a click.

    Args:
        fits: With held-out errors, in the order of the page.
        shown: Label → what can be drawn of it; models without get tables only.
    """
    if not fits:
        return []
    blocks: list[Block] = [fit_tables.comparison(fits)]
    if under_loads := criteria_under_loads(fits):
        blocks.append(under_loads)
    overview = Section("models", "Models", READING, (*blocks, *figures_of("models", fits)))
    best = best_first(fits)[0]
    models = (
        _model(i, fit, shown.get(fit.label), folded=fit is not best) for i, fit in enumerate(fits)
    )
    return [overview, *models]


def _model(i: int, fit: FitFacts, shown: Shown | None, *, folded: bool) -> Section:
    blocks: list[Block] = [fit_tables.per_joint(fit)]
    if parts := fit_tables.parts(fit):
        blocks.append(parts)
    if groups := fit_tables.per_group(fit):
        blocks.append(groups)
    view = ModelView(fit, shown or Shown(None, None))
    if view.shown.dwells is not None and (sides := approach_table(fit, view.shown.dwells)):
        blocks.append(sides)
    blocks += figures_of("model", view)
    blocks.append(_about(fit))
    what = fit.held_out.get("what")
    lead = f"Judged on what the fit has not seen: {what}." if what else ""
    return Section(f"model-{i + 1}", f"Model {fit.label}", lead, tuple(blocks), folded=folded)


def _about(fit: FitFacts) -> Facts:
    fitted, settings = as_object(fit.model.get("fitted")), as_object(fit.model.get("parameters"))
    condition = as_float(fitted.get("condition"))
    said = {
        "folder": _place(fit.folder),
        "protocol": fit.protocol,
        "samples or dwells fitted": fitted.get("samples"),
        "condition number": number(condition) if condition == condition else None,
        "drive gains from": fitted.get("gains_source"),
        **{f"setting {name}": _setting(value) for name, value in settings.items()},
    }
    return Facts("About this model", items(said))


def _place(folder: Path) -> str:
    """From its run: `fit/…`. A fit to files is in no run."""
    return f"fit/{folder.name}" if folder.parent.name == "fit" else folder.name


def _setting(value: Any) -> str | None:
    """In words; None, which is left out, for what was left to the estimator."""
    if isinstance(value, dict):
        value = {name: inner for name, inner in value.items() if inner is not None}
    return None if value is None else in_words(value)
