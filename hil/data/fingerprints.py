"""Fingerprints of samples and poses: do two recordings hold the same samples, or the same motion?

Names do not say it: the same recording may be copied, cut or imported twice, and its clock shifted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hil.core import FloatArray, IntArray
from hil.data.dataset import Dataset

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

DECIMALS = 6
"""Decimals to which positions [rad] and efforts are compared: units converted twice still agree."""


def fingerprints(dataset: Dataset) -> IntArray:
    """Return the distinct rows of a dataset as sorted numbers, one each.

    Position and effort count. Time does not, since a copy may begin at another time; rows that an
    arm at rest repeats count once.
    """
    values = np.round(np.hstack([dataset["q"], dataset["effort"]]), DECIMALS) + 0.0
    bits = np.ascontiguousarray(values, dtype=np.float64).view(np.int64)
    random = np.random.default_rng(0)
    factors = np.asarray(random.integers(1, 2**62, bits.shape[1], dtype=np.int64)) | 1
    with np.errstate(over="ignore"):
        mixed = ((bits ^ (bits >> 29)) * factors).sum(axis=1)
        mixed = (mixed ^ (mixed >> 31)) * factors[0]
    distinct: IntArray = np.unique(mixed)
    return distinct


SKETCH_ROWS = 4096
"""Fingerprints stored of a training set: all of a small one, a fair draw of a large one."""


@dataclass(frozen=True, slots=True, eq=False)
class Sketch:
    """Fingerprints of a dataset in bounded memory: the smallest ones (bottom-k sampling).

    Attributes:
        smallest: At most `SKETCH_ROWS` fingerprints, sorted.
        complete: They are all there are.
    """

    smallest: IntArray
    complete: bool

    @staticmethod
    def of(dataset: Dataset) -> Sketch:
        """Return the sketch of a dataset."""
        rows = fingerprints(dataset)
        return Sketch(rows[:SKETCH_ROWS], len(rows) <= SKETCH_ROWS)

    def share_known(self, dataset: Dataset) -> float:
        """Return the estimated share of a dataset's distinct rows that the sketched one holds."""
        rows = fingerprints(dataset)
        if not self.complete:
            rows = rows[rows <= self.smallest.max()]
        return float(np.mean(np.isin(rows, self.smallest))) if len(rows) else 0.0


SAME_PLACE_RAD = 0.02
"""Two poses that differ by less in every joint are the same for a model."""

PLACES = 200
"""Poses per series that are looked up, evenly spread over its path."""

KNOWN_ROWS = 100_000
"""Training rows that are searched."""


def revisited(train: Dataset, test: Dataset) -> dict[str, float]:
    """Return how much of each test series leads through poses of the training data.

    Equal programs on two arms, or repeated under two loads, share no sample and yet every pose.

    Returns:
        Series id → share (0…1) of the poses, evenly spread over the path of the series, for which
        the training data hold one within `SAME_PLACE_RAD` in every joint.
    """
    from scipy.spatial import cKDTree

    known = train["q"][:: max(1, len(train) // KNOWN_ROWS)]
    tree = cKDTree(known[np.all(np.isfinite(known), axis=1)])
    return {
        condition.id: _share_near(tree, _places(test["q"][rows]))
        for condition, rows in test.slices()
        if rows.stop > rows.start
    }


def _share_near(tree: cKDTree, places: FloatArray) -> float:
    if not len(places):
        return 0.0
    distance, _ = tree.query(places, p=np.inf, distance_upper_bound=SAME_PLACE_RAD)
    return float(np.mean(np.isfinite(distance)))


def _places(q: FloatArray) -> FloatArray:
    """Return rows of one series at equal distances along its path, so that rest counts once."""
    q = q[np.all(np.isfinite(q), axis=1)]
    if not len(q):
        return q
    # Steps below a tenth of a milliradian are noise of the encoder, not motion.
    steps = np.max(np.abs(np.diff(q, axis=0)), axis=1)
    way = np.concatenate(([0.0], np.cumsum(np.where(steps > 1e-4, steps, 0.0))))
    rows = np.searchsorted(way, np.linspace(0.0, way[-1], PLACES))
    return q[np.unique(rows)]
