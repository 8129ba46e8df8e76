"""Fingerprints of samples and poses, used to detect shared samples or repeated motions.

File names are not sufficient to detect shared samples: a recording may be copied, cut or imported
twice, or its clock may be shifted.
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
"""Number of decimals to which positions [rad] and efforts are compared.

Values that were converted between units twice still agree to this number of decimals.
"""


def fingerprints(dataset: Dataset) -> IntArray:
    """Return one hash per distinct row of a dataset, sorted.

    The hash of a row depends on position and effort. The hash ignores time, because a copy of a
    recording may begin at a different time. Several equal rows of a static arm count as one row.
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
"""Maximum number of fingerprints stored for a training set; larger sets are sampled randomly."""


@dataclass(frozen=True, slots=True, eq=False)
class Sketch:
    """Fingerprints of a dataset in bounded memory: the smallest hashes (bottom-k sampling).

    Attributes:
        smallest: At most `SKETCH_ROWS` fingerprints, in ascending order.
        complete: Whether the sketch contains all fingerprints of the dataset.
    """

    smallest: IntArray
    complete: bool

    @staticmethod
    def of(dataset: Dataset) -> Sketch:
        """Return the sketch of the fingerprints of a dataset."""
        rows = fingerprints(dataset)
        return Sketch(rows[:SKETCH_ROWS], len(rows) <= SKETCH_ROWS)

    def share_known(self, dataset: Dataset) -> float:
        """Return the estimated share of a dataset's distinct rows that are in this sketch."""
        rows = fingerprints(dataset)
        if not self.complete:
            rows = rows[rows <= self.smallest.max()]
        return float(np.mean(np.isin(rows, self.smallest))) if len(rows) else 0.0


SAME_PLACE_RAD = 0.02
"""Joint difference below which two poses count as the same pose [rad]."""

PLACES = 200
"""Number of poses per series that are compared, evenly spaced along its path."""

KNOWN_ROWS = 100_000
"""Maximum number of training rows that are searched for poses."""


def revisited(train: Dataset, test: Dataset) -> dict[str, float]:
    """Return the share of each test series whose poses also occur in the training data.

    The same program on two arms, or with two payloads, shares no samples but all poses.

    Returns:
        Share (0…1) of repeated poses by series id. The share of a series is based on poses evenly
        spaced along its path. A pose counts as repeated if the training data contain a pose within
        `SAME_PLACE_RAD` in every joint.
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
    """Return rows of one series at equal distances along its path.

    Phases at rest therefore count as one row.
    """
    q = q[np.all(np.isfinite(q), axis=1)]
    if not len(q):
        return q
    # Steps below a tenth of a milliradian are encoder noise.
    steps = np.max(np.abs(np.diff(q, axis=0)), axis=1)
    way = np.concatenate(([0.0], np.cumsum(np.where(steps > 1e-4, steps, 0.0))))
    rows = np.searchsorted(way, np.linspace(0.0, way[-1], PLACES))
    return q[np.unique(rows)]
