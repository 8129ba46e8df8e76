"""Criteria about loads: judged on all models at once, and shown beside each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from hil.report.documents import Document, as_float, as_objects
from hil.report.fit_facts import FitFacts
from hil.report.page import Cell, Column, Table
from hil.report.words import METRIC_WORDS, number

METRICS = ("load_error_ratio", "contradicted_loads")


def with_load_criteria(fits: Sequence[FitFacts], verdict: Document) -> tuple[FitFacts, ...]:
    """Models with what the verdict of their run says of them under loads."""
    rows = [row for row in as_objects(verdict.get("rows")) if row.get("metric") in METRICS]
    return tuple(
        replace(fit, under_loads=[row for row in rows if row.get("estimator") == fit.name])
        for fit in fits
    )


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


def _figure(value: Any) -> str:
    """Loads are counted; ratios have digits."""
    return str(value) if isinstance(value, int) else number(as_float(value))


def _all(what: str) -> str:
    """`all loads`; `run (3 kg)` names those that are wrong."""
    wrong = what.partition("(")[2].rstrip(")")
    return f"all loads; wrong: {wrong}" if wrong else "all loads"
