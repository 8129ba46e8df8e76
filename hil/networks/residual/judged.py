"""What left-out rows say: which joints keep their network, and how wide the bands are.

Corrections are judged as predictions give them, within their limits.

Nothing was fitted to these rows, but they chose the epoch at which a network stopped: what they
say of it is a little too good.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.data import Dataset
from hil.estimators import SpeedBands
from hil.networks.residual.correction import Correction
from hil.networks.residual.fit import Learnt, trajectory_numbers
from hil.networks.residual.out_of_fold import Physics
from hil.networks.residual.selection import Selection, select


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """The verdict of left-out rows.

    Attributes:
        selection: Which joints keep their network.
        correction: What predictions are corrected by: where it is kept, and how large at most.
        bands: From errors on measured effort, as recorded.
        coverage: What bands made without them hold of left-out trajectories; empty where there
            is one only.
        sigma: (n,) root-mean-square error on measured effort.
    """

    selection: Selection
    correction: Correction
    bands: SpeedBands
    coverage: dict[str, Any]
    sigma: FloatArray

    @staticmethod
    def of(
        data: Dataset, physics: Physics, learnt: Learnt, margin: float, coverage: float
    ) -> Judged:
        """Judge on the rows that networks were stopped by.

        Args:
            data: Prepared.
            physics: Predictions of models that had not seen the rows, where there are folds.
            learnt: Networks and their corrections.
            margin: See `select`.
            coverage: Of the bands.
        """
        rows = learnt.judged
        left = (data["effort_f"] - physics.predicted)[rows]
        said, blocks = learnt.correction[rows], trajectory_numbers(data)[rows]
        everywhere = _correction(learnt, np.max(np.abs(left), axis=0))
        selection = select(left, left - everywhere.bounded(said), blocks, margin)
        correction = replace(everywhere, kept=selection.kept)
        predicted = physics.predicted[rows] + correction.bounded(said)
        errors, speeds = data["effort"][rows] - predicted, data["qd_f"][rows]
        return Judged(
            selection,
            correction,
            SpeedBands.calibrate(errors, speeds, blocks, coverage),
            _coverage(errors, speeds, blocks, _parts(physics.fold[rows], blocks), coverage),
            np.sqrt(np.mean(errors**2, axis=0)),
        )


def _correction(learnt: Learnt, limit: FloatArray) -> Correction:
    """All networks in all joints."""
    kept = np.ones(len(limit), dtype=bool)
    return Correction(learnt.networks[0].settings, learnt.networks, kept, limit)


def _parts(fold: IntArray, blocks: IntArray) -> IntArray:
    """(N,) what is left out together to try bands: folds, or trajectories where there are none."""
    return fold if len(np.unique(fold)) > 1 else blocks


def _coverage(
    errors: FloatArray, speeds: FloatArray, blocks: IntArray, parts: IntArray, coverage: float
) -> dict[str, Any]:
    """Bands of the other parts, tried on each; shares are means over the parts."""
    found = []
    for part in np.unique(parts):
        out: BoolArray = parts == part
        if np.all(out):
            return {}
        bands = SpeedBands.calibrate(errors[~out], speeds[~out], blocks[~out], coverage)
        found.append(bands.coverage(errors[out], speeds[out], blocks[out]))
    return {
        "asked": coverage,
        "share": np.mean([one.share for one in found], axis=0).tolist(),
        "worst_trajectory": np.min([one.worst for one in found], axis=0).tolist(),
        "trajectories": int(sum(one.trajectories for one in found)),
    }
