"""Recordings as crops that a network is trained on: instants in a row, with what is before them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.networks.residual.motions import Motions
from hil.networks.residual.settings import ResidualSettings


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """Where crops lie in arrays whose series have `window - 1` rows of their first row before.

    Attributes:
        padded: (P,) row of the recording that each padded row holds.
        starts: (C,) padded row at which each crop's first window begins.
        rows: (C, crop) row of the recording each output of a crop is for.
        counted: (C, crop) true where that output is learned from or judged.
        every: Rows between outputs.
    """

    padded: IntArray
    starts: IntArray
    rows: IntArray
    counted: BoolArray
    every: int

    @staticmethod
    def of(motions: Motions, counted: BoolArray, settings: ResidualSettings) -> Segments:
        """Crops that tile every series and hold rows (N,) that count.

        Neighbouring crops begin their instants a row apart, so that no phase is left out. What is
        behind the end of a series is held at its last row and not counted.
        """
        every, crop = settings.apart(motions.rate_hz), settings.crop
        before, span = settings.window - 1, settings.crop * every
        padded, starts, rows = [], [], []
        offset = 0
        for part in motions.slices():
            length = part.stop - part.start
            firsts = np.arange(0, length, span)
            firsts += np.arange(len(firsts)) % every
            last = len(firsts) * span + every
            padded.append(part.start + np.arange(-before, last).clip(0, length - 1))
            starts.append(offset + firsts)
            at = firsts[:, None] + every * np.arange(crop)
            rows.append(np.where(at < length, part.start + at, BEHIND))
            offset += before + last
        at = np.concatenate(rows) if rows else np.empty((0, crop), dtype=np.int64)
        kept = np.append(counted, False)[at]
        chosen = np.any(kept, axis=1)
        return Segments(
            np.concatenate([np.empty(0, dtype=np.int64), *padded]),
            np.concatenate([np.empty(0, dtype=np.int64), *starts])[chosen],
            at.clip(0)[chosen],
            kept[chosen],
            every,
        )

    def __len__(self) -> int:
        return len(self.starts)

    def inputs_of(self, numbers: IntArray, settings: ResidualSettings) -> IntArray:
        """(B, (crop - 1)·every + window) padded rows that go into the crops (B,)."""
        length = (settings.crop - 1) * self.every + settings.window
        return np.asarray(self.starts[numbers, None] + np.arange(length))


BEHIND = -1
"""In place of a row: the series has ended."""


def sizes(parts: FloatArray, rows: BoolArray) -> FloatArray:
    """(branches, n) root mean square of each part over the rows that are learned from."""
    root: FloatArray = np.sqrt(np.mean(parts[:, rows] ** 2, axis=1))
    # A part that is nothing is learned as nothing.
    return np.where(root > 0.0, root, 1.0)
