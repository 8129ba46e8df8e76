"""Report sections about models: comparison of all models, and details of each model.

The tables show held-out errors beside errors on the training data; only held-out errors measure the
quality of a model. For dwells measured from both approach directions, the tables separate the error
in gravity from the error in static friction.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import FloatArray
from hil.report.documents import Document, as_float, as_object, as_objects
from hil.report.figure_list import figures_of
from hil.report.fit_facts import FitFacts, best_first
from hil.report.model_figures import ModelView
from hil.report.page import Block, Cell, Column, Facts, Section, Table, cells, items
from hil.report.predictions import DwellPredictions, Predictions
from hil.report.run_summary import NO_SIGNAL
from hil.report.words import (
    METRIC_WORDS,
    UNKNOWN,
    criterion_text,
    in_words,
    joint_title,
    listed,
    number,
    short_source,
)

READING = (
    "RMSE raw compares the prediction with the measured signal, RMSE filtered with the same signal "
    "after a zero-phase low-pass at 0.20 of the Nyquist frequency (for dwells: with their mean). "
    "The part removed by the filter is shown as the part above the cut-off (for dwells: the "
    "scatter about their mean). It consists of noise and of friction that changes fast. NRMSE is "
    "RMSE raw divided by the standard deviation of the training signal: a constant prediction of "
    "the mean reaches 1, and no model reaches less on a joint without signal. R is the Pearson "
    "correlation of prediction and measurement. MEP is the largest single error divided by the "
    "largest measured value, and depends on one sample."
)


def model_sections(fits: Sequence[FitFacts], shown: Mapping[str, Predictions]) -> list[Section]:
    """Return the comparison section and one section per model; only the best model's is unfolded.

    Args:
        fits: Models with held-out errors, in the order of display.
        shown: Predictions for figures by model label; a model without predictions gets tables only.
    """
    if not fits:
        return []
    blocks: list[Block] = [comparison(fits)]
    if under_loads := criteria_under_loads(fits):
        blocks.append(under_loads)
    overview = Section("models", "Models", READING, (*blocks, *figures_of("models", fits)))
    best = best_first(fits)[0]
    models = (
        _model(i, fit, shown.get(fit.label), folded=fit is not best) for i, fit in enumerate(fits)
    )
    return [overview, *models]


def _model(i: int, fit: FitFacts, shown: Predictions | None, *, folded: bool) -> Section:
    blocks: list[Block] = [per_joint(fit)]
    if apart := parts(fit):
        blocks.append(apart)
    if groups := per_group(fit):
        blocks.append(groups)
    view = ModelView(fit, shown or Predictions(None, None))
    if view.shown.dwells is not None and (sides := approach_table(fit, view.shown.dwells)):
        blocks.append(sides)
    blocks += figures_of("model", view)
    blocks.append(_about(fit))
    what = fit.held_out.get("what")
    lead = f"Evaluated on data that the fit has not used: {what}." if what else ""
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
    """Return the model folder relative to its run, or its name if the model belongs to no run."""
    return f"fit/{folder.name}" if folder.parent.name == "fit" else folder.name


def _setting(value: Any) -> str | None:
    """Return a setting as text, or None (omitted) if the default of the estimator applies."""
    if isinstance(value, dict):
        value = {name: inner for name, inner in value.items() if inner is not None}
    return None if value is None else in_words(value)


HELD_OUT, TRAINED = "held out", "trained on"

BOTH_MOTIONS = (
    "Motion is determined and evaluated for each joint separately. A sample in which some joints "
    "move and others stand still counts in both groups."
)

FROM_0 = "Trajectories are counted from 0, as in the recording: the last of twelve is #11."


def comparison(fits: Sequence[FitFacts]) -> Table:
    """Return a table of all models with the joint means of held-out and training errors."""
    columns = (
        Column("model", number=False),
        Column("RMSE raw", HELD_OUT),
        Column("RMSE filtered", HELD_OUT),
        Column("NRMSE", HELD_OUT),
        Column("RMSE raw", TRAINED),
        Column("RMSE filtered", TRAINED),
        Column(fits[0].fast_part if _alike(fits) else "high-frequency part", "measured signal"),
        Column("fit time [s]"),
        Column("verdict", number=False),
    )
    compared = any(fit.under_loads for fit in fits)
    table = Table(
        f"Models, means over the joints [{fits[0].unit}]{_best_of(fits)}",
        columns,
        tuple(_comparison_row(fit, compared) for fit in fits),
        "Only held-out errors measure the accuracy of a model. Errors on the training data show "
        "how closely the model follows these data; a large difference indicates overfitting.",
    )
    return table.without_empty_columns()


def _alike(fits: Sequence[FitFacts]) -> bool:
    return len({fit.fast_part for fit in fits}) == 1


def _best_of(fits: Sequence[FitFacts]) -> str:
    """Return a caption suffix that names the model with the smallest held-out error.

    The caption suffix is needed because the rows of the table are in a different order. For a
    single model, the caption suffix is empty.
    """
    best = best_first(fits)[0].label
    return f"; smallest held-out error: {best}" if len(fits) > 1 else ""


def _comparison_row(fit: FitFacts, compared: bool) -> tuple[Cell, ...]:
    means = (
        fit.mean("rmse_raw"),
        fit.mean("rmse_filtered"),
        fit.mean("nrmse"),
        fit.mean("rmse_raw", "trained"),
        fit.mean("rmse_filtered", "trained"),
        fit.mean("noise_floor"),
        as_float(fit.evaluation.get("seconds")),
    )
    return (*cells(fit.label, *(number(value) for value in means)), _verdict_cell(fit, compared))


def _verdict_cell(fit: FitFacts, compared: bool) -> Cell:
    """Return the table cell with the verdict on a model.

    A model without criteria is labelled as a comparison if other models have criteria.
    """
    rows = [*fit.criteria, *fit.under_loads]
    if not rows:
        return Cell("for comparison" if compared else "not judged", "quiet")
    missed = sum(not row.get("passed") for row in rows)
    if missed:
        return Cell(f"rejected, {missed} of {len(rows)} criteria missed", "fail")
    return Cell(f"passed, {len(rows)} of {len(rows)} criteria met", "pass")


def per_joint(fit: FitFacts) -> Table:
    """Return a table of held-out and training errors per joint, with the acceptance criteria."""
    limits = _limits(fit.criteria)
    held, relative, trained = f"held out [{fit.unit}]", "held out", f"trained on [{fit.unit}]"
    columns = (
        Column("joint", number=False),
        *(Column(title, held) for title in ("RMSE raw", "RMSE filtered", fit.fast_part)),
        *(Column(title, relative) for title in ("NRMSE", "R", "MEP [%]")),
        *(Column(title, trained) for title in ("RMSE raw", "RMSE filtered")),
        *(Column(title, "criteria, held out") for title in limits),
    )
    names = ("rmse_raw", "rmse_filtered", "noise_floor", "nrmse", "r", "mep")
    shown = [*names, *names[:2]]
    values = [fit.values(metric) for metric in names]
    values += [fit.values(metric, "trained") for metric in names[:2]]
    means = [fit.mean(metric) for metric in names]
    means += [fit.mean(metric, "trained") for metric in names[:2]]
    rows = [
        (
            Cell(joint_title(j, name)),
            *(
                Cell(_said(metric, of_joint[j]))
                for metric, of_joint in zip(shown, values, strict=True)
            ),
            *(_limit_cell(limit.get(name)) for limit in limits.values()),
        )
        for j, name in enumerate(fit.joint_names)
    ]
    last = (_limit_cell(limit.get("mean")) for limit in limits.values())
    rows.append(
        (Cell("mean"), *(Cell(_said(*pair)) for pair in zip(shown, means, strict=True)), *last)
    )
    note = _unloaded(fit)
    table = Table(f"{fit.label}: errors per joint", columns, tuple(rows), note)
    return table.without_empty_columns()


def _limits(criteria: Sequence[Document]) -> dict[str, dict[str, Document]]:
    """Return the verdict rows by criterion and by joint name (or `mean` for the joint mean)."""
    out: dict[str, dict[str, Document]] = {}
    for row in criteria:
        out.setdefault(criterion_text(row), {})[str(row.get("what"))] = row
    return out


def _said(metric: str, value: float) -> str:
    """Return the value of a metric as text.

    Correlations have four decimals, so that values such as 0.99 and 0.999 are distinguishable.
    """
    if metric == "r" and np.isfinite(value):
        return f"{round(value, 4) + 0.0:.4f}"
    return number(value)


def _limit_cell(row: Document | None) -> Cell:
    if row is None:
        return Cell("", "quiet")
    return Cell(number(as_float(row.get("value"))), "pass" if row.get("passed") else "fail")


def _unloaded(fit: FitFacts) -> str:
    """Return a note that an NRMSE near 1 is expected for joints without a signal.

    The note about the NRMSE is empty if every joint has a signal.
    """
    trained = zip(fit.joint_names, fit.values("nrmse", "trained"), strict=True)
    silent = [name for name, value in trained if value >= NO_SIGNAL]
    if not silent:
        return ""
    return (
        f"An NRMSE near 1 is not a fault of the model for {listed(silent, 6)}: in these data, the "
        "signal is little more than noise and friction. Use the RMSE instead."
    )


def parts(fit: FitFacts) -> Table | None:
    """Return a table of errors with new payload, new motion, or both; None if not stored."""
    if not fit.beside:
        return None
    columns = (
        Column("held out", number=False),
        Column("samples"),
        Column(f"RMSE raw [{fit.unit}]"),
        Column(f"RMSE filtered [{fit.unit}]"),
    )
    rows = [_part_row("new load, new motion: evaluated", fit.total())]
    rows += [_part_row(str(part.get("what")), as_object(part.get("total"))) for part in fit.beside]
    caption = f"{fit.label}: new loads and new motions separately, means over the joints"
    return Table(caption, columns, tuple(rows))


def _part_row(name: str, errors: Document) -> tuple[Cell, ...]:
    samples = as_float(errors.get("samples"))
    means = (as_float(errors.get(key)) for key in ("mean_raw", "mean_filtered"))
    shown = str(int(samples)) if np.isfinite(samples) else UNKNOWN
    return cells(name, shown, *(number(mean) for mean in means))


def per_group(fit: FitFacts) -> Table | None:
    """Return a table of mean held-out errors per group, such as source, trajectory or payload.

    Groupings with only one group are omitted; None is returned if no grouping remains.
    """
    groups = [g for g in as_objects(fit.held_out.get("tables")) if g.get("samples")]
    several = [g for g in groups if sum(other.get("by") == g.get("by") for other in groups) > 1]
    if not several:
        return None
    columns = (
        Column("grouped by", number=False),
        Column("group", number=False),
        Column("samples"),
        Column(f"RMSE raw [{fit.unit}]"),
        Column(f"RMSE filtered [{fit.unit}]"),
    )
    rows = tuple(_group_row(group) for group in several)
    caption = f"{fit.label}: held-out errors by group, means over the joints"
    notes = {"motion": BOTH_MOTIONS, "trajectory": FROM_0}
    kinds = {str(group.get("by")) for group in several}
    note = " ".join(said for by, said in notes.items() if by in kinds)
    return Table(caption, columns, rows, note)


def _group_row(group: Document) -> tuple[Cell, ...]:
    by, name = str(group.get("by")), short_source(str(group.get("name")))
    if by == "load":  # `2: 3 kg`
        name = name.partition(": ")[2] or name
    return (Cell(by), *_part_row(name, group))


def approach_table(fit: FitFacts, dwells: DwellPredictions) -> Table | None:
    """Return a table of gravity and friction errors per joint; None without paired dwells.

    Two dwells at the same pose, approached from below and from above, have the same gravity and
    friction of opposite sign. The mean of the prediction errors in two paired dwells is therefore
    the error in gravity. Half the difference of the prediction errors in two paired dwells is the
    error in friction. A model that does not use the approach direction cannot predict static
    friction.
    """
    pairs = list(_pairs(dwells))
    if not pairs:
        return None
    up, down = (np.array(side) for side in zip(*pairs, strict=True))
    residual = dwells.measured - dwells.predicted
    gravity = (residual[up] + residual[down]) / 2
    friction = (residual[up] - residual[down]) / 2
    columns = (
        Column("joint", number=False),
        Column(f"error of the approach mean, RMS [{fit.unit}]"),
        Column(f"half difference, mean [{fit.unit}]"),
        Column(f"half difference, RMS [{fit.unit}]"),
        Column("share of half difference in squared error [%]"),
    )
    values = (_rms(gravity), friction.mean(axis=0), _rms(friction), _share(gravity, friction))
    rows = [
        cells(joint_title(j, name), *(number(float(value[j])) for value in values))
        for j, name in enumerate(fit.joint_names)
    ]
    rows.append(cells("mean", *(number(float(np.mean(value))) for value in values)))
    return Table(
        f"{fit.label}: errors in gravity and static friction, {len(pairs)} held-out poses "
        "approached from both directions",
        columns,
        tuple(rows),
        "Static friction has the sign of the approach direction, so it cancels in the mean of both "
        "dwells: the error of the mean is the error in gravity. Half the difference is "
        "this friction; it contributes in full to the RMSE of single dwells, however accurate the "
        "gravity model is.",
    )


def _pairs(dwells: DwellPredictions) -> Iterator[tuple[int, int]]:
    """Yield pairs of dwells with the same pose and payload: one from below and one from above."""
    keys = list(zip(dwells.pose.tolist(), dwells.load.tolist(), strict=True))
    side = {(key, sign): i for i, (key, sign) in enumerate(zip(keys, dwells.approach, strict=True))}
    for key in dict.fromkeys(keys):
        if (key, 1) in side and (key, -1) in side:
            yield side[key, 1], side[key, -1]


def _rms(values: FloatArray) -> FloatArray:
    out: FloatArray = np.sqrt(np.mean(values**2, axis=0))
    return out


def _share(gravity: FloatArray, friction: FloatArray) -> FloatArray:
    """Return the (n,) share of the friction error in the squared error of single dwells [%].

    The share is NaN for a joint whose errors are all zero.
    """
    of_friction, total = _rms(friction) ** 2, _rms(friction) ** 2 + _rms(gravity) ** 2
    known = total > 0
    return np.where(known, 100 * of_friction / np.where(known, total, 1.0), np.nan)


def criteria_under_loads(fits: Sequence[FitFacts]) -> Table | None:
    """Return a table of the criteria with payloads; None if there are no such criteria."""
    rows = [_row(fit, row) for fit in fits for row in fit.under_loads]
    if not rows:
        return None
    columns = (
        Column("criterion", number=False),
        Column("model", number=False),
        Column("evaluated on", number=False),
        Column("result"),
        Column("at most"),
        Column("verdict", number=False),
    )
    others = [fit.label for fit in fits if not fit.under_loads]
    note = f"For comparison only, without a criterion: {', '.join(others)}." if others else ""
    return Table("Criteria under loads", columns, tuple(rows), note)


def _row(fit: FitFacts, row: Document) -> tuple[Cell, ...]:
    metric, passed = str(row.get("metric")), bool(row.get("passed"))
    where = str(row.get("what"))
    return (
        Cell(METRIC_WORDS.get(metric, metric)),
        Cell(fit.label),
        Cell(f"{where} (worst)" if metric == "load_error_ratio" else _all(where)),
        Cell(_figure(row.get("value"))),
        Cell(_figure(row.get("max"))),
        Cell("passed", "pass") if passed else Cell("missed", "fail"),
    )


def _all(what: str) -> str:
    """Return `all loads`, followed by the names of wrongly declared payloads, if any."""
    wrong = what.partition("(")[2].rstrip(")")
    return f"all loads; wrong: {wrong}" if wrong else "all loads"


def _figure(value: Any) -> str:
    """Return a value as text: counts of payloads as integers, ratios with three digits."""
    return str(value) if isinstance(value, int) else number(as_float(value))
