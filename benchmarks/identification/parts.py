"""Parts of a recording: the earlier and the later rows, fewer of them, or some of its joints."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from hil.core.typing import BoolArray
from hil.data.dataset import Dataset, rows_of
from hil.data.filters import derivative, nyquist_fraction, sample_rate, zero_phase

TRAIN_SHARE = 0.6
GAP_S = 0.5
"""Between the part to fit on and the part to judge on: longer than a filter's memory."""

SHORTEST = 60
"""Samples below which what is left of a series is mostly a filter's edges."""


def cut(
    dataset: Dataset, share: float = TRAIN_SHARE, gap_s: float = GAP_S
) -> tuple[Dataset, Dataset]:
    """Split a recording: the first `share` of its time, and the rest after a gap."""
    t = dataset["t"]
    end = t[0] + share * (t[-1] - t[0])
    return _part(dataset, t <= end, "first"), _part(dataset, t >= end + gap_s, "rest")


def in_turn(
    dataset: Dataset, count: int = 4, gap_s: float = GAP_S
) -> Iterator[tuple[Dataset, Dataset]]:
    """All but one contiguous part of a recording, a gap away from it, and that part: each in turn.

    What lies before the part left out and what lies behind it become series of their own.
    """
    t = dataset["t"]
    ends = t[0] + np.linspace(0.0, 1.0, count + 1) * (t[-1] - t[0])
    for i, (begin, end) in enumerate(pairwise(ends)):
        before, behind = t <= begin - gap_s, t >= end + gap_s
        kept = [(before, f"before {i}"), (behind, f"behind {i}")]
        train = [_part(dataset, rows, name) for rows, name in kept if rows.sum() >= SHORTEST]
        yield Dataset.concatenate(train), _part(dataset, (t >= begin) & (t <= end), f"part {i}")


def thinned(dataset: Dataset, rate_hz: float) -> Dataset:
    """Fewer samples: every series low-passed below the new Nyquist frequency, every k-th kept.

    A velocity that was not measured is differentiated first, from the samples as they were.
    """
    parts = [dataset.take([i]) for i in range(len(dataset.conditions))]
    return Dataset.concatenate([_thinned(part, rate_hz) for part in parts])


def joints_of(dataset: Dataset, joints: Sequence[int]) -> Dataset:
    """Return the dataset of some joints."""
    chosen = list(joints)
    columns = {n: v if v.ndim == 1 else v[:, chosen] for n, v in dataset.columns.items()}
    gains = dataset.drive_gains
    return replace(
        dataset,
        joint_names=tuple(dataset.joint_names[j] for j in chosen),
        columns=columns,
        drive_gains=None if gains is None else gains[chosen],
    )


def _thinned(series: Dataset, rate_hz: float) -> Dataset:
    rate = sample_rate(series["t"])
    every = max(1, round(rate / rate_hz))
    columns = dict(series.columns)
    columns.setdefault("qd", derivative(series["q"], series["t"]))
    fraction = nyquist_fraction(0.4 * rate / every, "hz", rate)
    kept = {
        name: np.ascontiguousarray(
            (values if name == "t" else zero_phase(values, fraction))[::every]
        )
        for name, values in columns.items()
    }
    return replace(series, columns=kept, offsets=np.array([0, len(kept["t"])]))


def _part(dataset: Dataset, rows: BoolArray, name: str) -> Dataset:
    """Return some rows under other names, without series that keep hardly any rows."""
    part = rows_of(dataset, rows)
    part = part.take(np.flatnonzero(np.diff(part.offsets) >= SHORTEST))
    conditions = tuple(
        replace(c, id=f"{c.id} {name}", source=f"{c.source} {name}") for c in part.conditions
    )
    return replace(part, conditions=conditions)
