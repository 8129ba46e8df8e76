"""Sections about models: how they compare, and each one by itself.

Held-out errors stand beside those on the training data, never alone: only the former say how good
a model is. Of dwells measured from both sides, gravity and stick friction are told apart.
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
    "RMSE raw compares the prediction with the signal as it was measured, RMSE filtered with the "
    "same signal after a zero-phase low-pass at 0.20 of the Nyquist frequency (for dwells: their "
    "mean). What that takes away is shown as the part above the cut-off, for dwells as the scatter "
    "about their mean: noise, and friction that changes fast. NRMSE is RMSE raw over the standard "
    "deviation of the training signal: 1 is as good as always predicting the mean, and all there "
    "is to reach on a joint without signal. R is the correlation of the two (Pearson). MEP is the "
    "largest single error over the largest measured value: one sample decides it."
)


def model_sections(fits: Sequence[FitFacts], shown: Mapping[str, Predictions]) -> list[Section]:
    """The comparison, then every model; the best one is open, the others unfold on a click.

    Args:
        fits: With held-out errors, in the order of the page.
        shown: Label → what can be drawn of it; models without get tables only.
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


HELD_OUT, TRAINED = "held out", "trained on"

BOTH_MOTIONS = (
    "Motion is told joint by joint, each joint judged in either group by itself. A sample in which "
    "some joints move and others stand still counts in both groups."
)

FROM_0 = "Trajectories are counted from 0 as in the recording: of twelve the last is #11."


def comparison(fits: Sequence[FitFacts]) -> Table:
    """All models, means over the joints: held-out errors beside those on the training data."""
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
        "Only held-out errors say how good a model is. Errors on the data it was fitted to show "
        "how closely it can follow them; a large difference means it has learnt them by heart.",
    )
    return table.without_empty_columns()


def _alike(fits: Sequence[FitFacts]) -> bool:
    return len({fit.fast_part for fit in fits}) == 1


def _best_of(fits: Sequence[FitFacts]) -> str:
    """Which of several errs least on what it has not seen: the rows are in another order."""
    return f"; least on held-out data: {best_first(fits)[0].label}" if len(fits) > 1 else ""


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
    """Of a model without criteria beside others with some: that it is there for comparison."""
    rows = [*fit.criteria, *fit.under_loads]
    if not rows:
        return Cell("for comparison" if compared else "not judged", "quiet")
    missed = sum(not row.get("passed") for row in rows)
    if missed:
        return Cell(f"rejected, {missed} of {len(rows)} criteria missed", "fail")
    return Cell(f"passed, {len(rows)} of {len(rows)} criteria met", "pass")


def per_joint(fit: FitFacts) -> Table:
    """Errors per joint, held out and trained side by side, and the criteria they must meet."""
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
    """Criterion → joint name (or `mean`) → its row."""
    out: dict[str, dict[str, Document]] = {}
    for row in criteria:
        out.setdefault(criterion_text(row), {})[str(row.get("what"))] = row
    return out


def _said(metric: str, value: float) -> str:
    """Correlations with fixed decimals: 0.99 and 0.999 are far apart, 1e-18 is nothing."""
    if metric == "r" and np.isfinite(value):
        return f"{round(value, 4) + 0.0:.4f}"
    return number(value)


def _limit_cell(row: Document | None) -> Cell:
    if row is None:
        return Cell("", "quiet")
    return Cell(number(as_float(row.get("value"))), "pass" if row.get("passed") else "fail")


def _unloaded(fit: FitFacts) -> str:
    """Why an NRMSE of 1 need not worry, where a joint has no signal to explain."""
    trained = zip(fit.joint_names, fit.values("nrmse", "trained"), strict=True)
    silent = [name for name, value in trained if value >= NO_SIGNAL]
    if not silent:
        return ""
    return (
        f"An NRMSE near 1 is no fault of the model at {listed(silent, 6)}: hardly loaded in these "
        "data, there is little but noise and friction to predict. Look at the RMSE there."
    )


def parts(fit: FitFacts) -> Table | None:
    """Where load and motion are both new, or only one of them; None when no such parts are kept."""
    if not fit.beside:
        return None
    columns = (
        Column("held out", number=False),
        Column("samples"),
        Column(f"RMSE raw [{fit.unit}]"),
        Column(f"RMSE filtered [{fit.unit}]"),
    )
    rows = [_part_row("new load, new motion: judged", fit.total())]
    rows += [_part_row(str(part.get("what")), as_object(part.get("total"))) for part in fit.beside]
    caption = f"{fit.label}: new loads and new motions apart, means over the joints"
    return Table(caption, columns, tuple(rows))


def _part_row(name: str, errors: Document) -> tuple[Cell, ...]:
    samples = as_float(errors.get("samples"))
    means = (as_float(errors.get(key)) for key in ("mean_raw", "mean_filtered"))
    shown = str(int(samples)) if np.isfinite(samples) else UNKNOWN
    return cells(name, shown, *(number(mean) for mean in means))


def per_group(fit: FitFacts) -> Table | None:
    """Held-out means per source, trajectory, load, …, where there is more than one of a kind."""
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
    """Error of the mean of both approaches, and half their difference, per joint.

    A pose approached from below and from above holds the same gravity, and friction of opposite
    sign. Without a memory of the approach no model predicts the second; the first is what it is
    worth as a model of gravity. None when no pose was measured from both sides.
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
        Column("its share of the squared error [%]"),
    )
    values = (_rms(gravity), friction.mean(axis=0), _rms(friction), _share(gravity, friction))
    rows = [
        cells(joint_title(j, name), *(number(float(value[j])) for value in values))
        for j, name in enumerate(fit.joint_names)
    ]
    rows.append(cells("mean", *(number(float(np.mean(value))) for value in values)))
    return Table(
        f"{fit.label}: gravity and stick friction apart, {len(pairs)} held-out poses from both "
        "sides",
        columns,
        tuple(rows),
        "The mean of both approaches cancels friction that has the sign of the approach: its "
        "error is the error in gravity. Half their difference is that friction; it enters the "
        "RMSE of single dwells in full, whatever the gravity model is worth.",
    )


def _pairs(dwells: DwellPredictions) -> Iterator[tuple[int, int]]:
    """Dwells at the same pose under the same load, from below and from above."""
    keys = list(zip(dwells.pose.tolist(), dwells.load.tolist(), strict=True))
    side = {(key, sign): i for i, (key, sign) in enumerate(zip(keys, dwells.approach, strict=True))}
    for key in dict.fromkeys(keys):
        if (key, 1) in side and (key, -1) in side:
            yield side[key, 1], side[key, -1]


def _rms(values: FloatArray) -> FloatArray:
    out: FloatArray = np.sqrt(np.mean(values**2, axis=0))
    return out


def _share(gravity: FloatArray, friction: FloatArray) -> FloatArray:
    """(n,) share of the difference in the squared error of single dwells [%]; NaN without any."""
    of_friction, total = _rms(friction) ** 2, _rms(friction) ** 2 + _rms(gravity) ** 2
    known = total > 0
    return np.where(known, 100 * of_friction / np.where(known, total, 1.0), np.nan)


def criteria_under_loads(fits: Sequence[FitFacts]) -> Table | None:
    """What was judged under loads; None where nothing was."""
    rows = [_row(fit, row) for fit in fits for row in fit.under_loads]
    if not rows:
        return None
    columns = (
        Column("criterion", number=False),
        Column("model", number=False),
        Column("judged on", number=False),
        Column("found"),
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
        Cell(f"{where}, the worst" if metric == "load_error_ratio" else _all(where)),
        Cell(_figure(row.get("value"))),
        Cell(_figure(row.get("max"))),
        Cell("passed", "pass") if passed else Cell("missed", "fail"),
    )


def _all(what: str) -> str:
    """`all loads`; `run (3 kg)` names those that are wrong."""
    wrong = what.partition("(")[2].rstrip(")")
    return f"all loads; wrong: {wrong}" if wrong else "all loads"


def _figure(value: Any) -> str:
    """Loads are counted; ratios have digits."""
    return str(value) if isinstance(value, int) else number(as_float(value))
