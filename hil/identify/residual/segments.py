"""Recordings as crops that a network is trained on: rows in a row, with the window before them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.identify.residual.motions import Motions
from hil.identify.residual.settings import ResidualSettings
from hil.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """Where crops lie in arrays whose series have `window - 1` rows of their first row before.

    Attributes:
        padded: (P,) row of the recording that each padded row holds.
        starts: (C,) padded row at which each crop's window begins.
        rows: (C, crop) row of the recording each output of a crop is for.
        counted: (C, crop) true where that output is learned from or judged.
    """

    padded: IntArray
    starts: IntArray
    rows: IntArray
    counted: BoolArray

    @staticmethod
    def of(motions: Motions, counted: BoolArray, settings: ResidualSettings) -> Segments:
        """Crops that tile every series and hold rows (N,) that count.

        The last crop of a series ends with it and overlaps the one before, whose rows it does not
        count again; a series shorter than a crop is held at its last row.
        """
        before, crop = settings.window - 1, settings.crop
        padded, starts, rows, kept = [], [], [], []
        offset = 0
        for part in motions.slices():
            length = part.stop - part.start
            held = np.arange(-before, max(length, crop)).clip(0, length - 1)
            padded.append(part.start + held)
            for first, new in _tiles(length, crop):
                inside = np.arange(first, first + crop)
                mask = (inside >= new) & (inside < length)
                mask[mask] = counted[part.start + inside[mask]]
                if np.any(mask):
                    starts.append(offset + first)
                    rows.append(part.start + inside.clip(0, length - 1))
                    kept.append(mask)
            offset += len(held)
        shape = (-1, crop)
        return Segments(
            np.concatenate(padded) if padded else np.empty(0, dtype=np.int64),
            np.array(starts, dtype=np.int64),
            np.array(rows, dtype=np.int64).reshape(shape),
            np.array(kept, dtype=bool).reshape(shape),
        )

    def __len__(self) -> int:
        return len(self.starts)


def _tiles(length: int, crop: int) -> list[tuple[int, int]]:
    """First row of each crop, and the first of its rows that no crop before it has."""
    full = [(first, first) for first in range(0, max(1, length - crop + 1), crop)]
    covered = full[-1][0] + crop
    return full if covered >= length else [*full, (length - crop, covered)]


def sizes(parts: FloatArray, rows: BoolArray) -> FloatArray:
    """(branches, n) root mean square of each part over the rows that are learned from."""
    root: FloatArray = np.sqrt(np.mean(parts[:, rows] ** 2, axis=1))
    # A part that is nothing is learned as nothing.
    return np.where(root > 0.0, root, 1.0)
