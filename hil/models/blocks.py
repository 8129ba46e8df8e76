"""Errors of two models, block by block of time and place by place of the motion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hil.core import FloatArray
from hil.data import SAME_PLACE_RAD, Dataset

BLOCK_S = 5.0
"""Of time that counts as one observation; friction and load keep errors alike for about as long."""


def blocks(
    data: Dataset, pair: tuple[FloatArray, FloatArray]
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Where, (n,) mean positions, and (2, n) mean squared errors of both models, block by block.

    Series are never joined.
    """
    for _, rows in data.slices():
        if rows.stop <= rows.start:
            continue
        t = data["t"][rows]
        count = max(1, round(float(t[-1] - t[0]) / BLOCK_S))
        for piece in np.array_split(np.arange(rows.start, rows.stop), count):
            found = np.stack([one[piece] for one in pair])
            if np.all(np.any(np.isfinite(found), axis=1)):
                yield np.mean(data["q"][piece], axis=0), np.nanmean(found, axis=1)


def by_place(found: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """(B, 2, n) means of the blocks at each place."""
    where: list[FloatArray] = []
    there: list[list[FloatArray]] = []
    for place, errors in found:
        near = [k for k, q in enumerate(where) if np.max(np.abs(q - place)) < SAME_PLACE_RAD]
        if near:
            there[near[0]].append(errors)
        else:
            where.append(place)
            there.append([errors])
    return np.array([np.mean(errors, axis=0) for errors in there])
