"""Dwells as the rows of models of friction at rest: one each, and what is known of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.data import AT_REST, POINTS, Dataset, series_means

LEAST_SPAN_K = 1.0
"""Temperatures that change by less in training say nothing about how friction goes with them."""

LEAST_OWN = 1e-4
"""Share of a column that no others account for, below which it is left out."""


def resting(dwells: Dataset) -> Dataset:
    """The same dwells with one row each: the means of whatever was measured."""
    columns = {"t": dwells["t"][dwells.offsets[:-1]]}
    for name in ("q", "effort", "temperature"):
        if name in dwells.columns:
            columns[name] = series_means(dwells, dwells[name])
    return replace(dwells, columns=columns, offsets=np.arange(len(dwells.conditions) + 1))


def celsius(rows: Dataset) -> FloatArray:
    """(D, n) joint temperatures, NaN where nobody measured them."""
    return rows.columns.get("temperature", np.full_like(rows["q"], np.nan))


def mean_celsius(rows: Dataset) -> FloatArray:
    """(n,) mean temperatures; NaN where unknown, or where they say nothing."""
    found = np.full(rows.n_joints, np.nan)
    for j, measured in enumerate(celsius(rows).T):
        known = measured[np.isfinite(measured)]
        if len(known) and np.ptp(known) >= LEAST_SPAN_K:
            found[j] = np.mean(known)
    return found


def period(t: FloatArray) -> float:
    """Usual time between samples at times t (N,) [s]; NaN when it never advances."""
    steps = np.diff(t)
    return float(np.median(steps[steps > 0])) if np.any(steps > 0) else np.nan


def unknown_paths(rows: Dataset) -> FloatArray:
    """(S, K, 2, n) paths of which nothing is known."""
    return np.full((len(rows.conditions), POINTS, 2, rows.n_joints), np.nan)


def dwells_in(dataset: Dataset) -> tuple[Dataset, BoolArray, IntArray]:
    """The dwells that have rows, which rows (N,) are theirs, and the dwell of each of those."""
    there = np.diff(dataset.offsets) > 0
    at_rest = np.array([c.kind in AT_REST for c in dataset.conditions], dtype=bool)
    chosen = at_rest & there
    series = dataset.series_index()
    at = chosen[series]
    return dataset.take(np.flatnonzero(chosen)), at, (np.cumsum(chosen) - 1)[series[at]]


def independent(columns: FloatArray) -> BoolArray:
    """(k,) which of the columns (D, k) are no combination of those kept before them."""
    basis = np.empty((len(columns), 0))
    kept = []
    for column in columns.T:
        left = column
        for _ in range(2):  # once is not enough for columns that are nearly a combination
            left = left - basis @ (basis.T @ left)
        size, own = float(np.linalg.norm(column)), float(np.linalg.norm(left))
        kept.append(own > LEAST_OWN * size)
        if kept[-1]:
            basis = np.column_stack([basis, left / own])
    return np.array(kept, dtype=bool)
