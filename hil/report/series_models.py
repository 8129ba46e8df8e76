"""The models of all runs of a series in one table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from hil.report.fit_facts import FitFacts
from hil.report.fit_tables import HELD_OUT
from hil.report.page import Column, Table, cells
from hil.report.words import UNKNOWN, number


def models_tables(runs: Iterable[tuple[str, Sequence[FitFacts]]]) -> list[Table]:
    """Held-out errors of every model; no table where there is no model.

    Args:
        runs: Name of a run and its models, each.
    """
    columns = (
        Column("experiment", number=False),
        Column("model", number=False),
        Column("RMSE raw", HELD_OUT),
        Column("RMSE filtered", HELD_OUT),
        Column("unit", HELD_OUT, number=False),
    )
    rows = tuple(
        cells(name, fit.label, *_errors(fit), fit.unit or UNKNOWN)
        for name, fits in runs
        for fit in fits
    )
    return [Table("Errors of the models, means over the joints", columns, rows)] if rows else []


def _errors(fit: FitFacts) -> tuple[str, ...]:
    return tuple(number(fit.mean(metric)) for metric in ("rmse_raw", "rmse_filtered"))
