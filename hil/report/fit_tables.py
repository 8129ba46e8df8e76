"""Numbers of models as tables: side by side, per joint, per group."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.report.documents import Document, as_float, as_object, as_objects
from hil.report.fit_facts import FitFacts, best_first
from hil.report.judgement import NO_SIGNAL
from hil.report.page import Cell, Column, Table, cells
from hil.report.words import UNKNOWN, criterion_text, joint_title, listed, number, short_source

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


def _alike(fits: Sequence[FitFacts]) -> bool:
    return len({fit.fast_part for fit in fits}) == 1


def _said(metric: str, value: float) -> str:
    """Correlations with fixed decimals: 0.99 and 0.999 are far apart, 1e-18 is nothing."""
    if metric == "r" and np.isfinite(value):
        return f"{round(value, 4) + 0.0:.4f}"
    return number(value)


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


def _limits(criteria: Sequence[Document]) -> dict[str, dict[str, Document]]:
    """Criterion → joint name (or `mean`) → its row."""
    out: dict[str, dict[str, Document]] = {}
    for row in criteria:
        out.setdefault(criterion_text(row), {})[str(row.get("what"))] = row
    return out


def _limit_cell(row: Document | None) -> Cell:
    if row is None:
        return Cell("", "quiet")
    return Cell(number(as_float(row.get("value"))), "pass" if row.get("passed") else "fail")


def _group_row(group: Document) -> tuple[Cell, ...]:
    by, name = str(group.get("by")), short_source(str(group.get("name")))
    if by == "load":  # `2: 3 kg`
        name = name.partition(": ")[2] or name
    return (Cell(by), *_part_row(name, group))


def _part_row(name: str, errors: Document) -> tuple[Cell, ...]:
    samples = as_float(errors.get("samples"))
    means = (as_float(errors.get(key)) for key in ("mean_raw", "mean_filtered"))
    shown = str(int(samples)) if np.isfinite(samples) else UNKNOWN
    return cells(name, shown, *(number(mean) for mean in means))
