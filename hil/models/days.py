"""Two models on several days: does the challenger err less whatever the day?

All data of one day share its room and its warmth: however many they are, they are sure of that day
alone. Here a day counts once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

from hil.core import FloatArray
from hil.estimators import RobotEstimator
from hil.evaluation import evaluate
from hil.models.compare import SURE, unseen_parts


@dataclass(frozen=True, slots=True, eq=False)
class Days:
    """Two models on the same days.

    Attributes:
        differences: (D,) of the squared error, per day, as a share of the champion's; negative
            where the challenger errs less.
        interval: Of their mean, with 95 %.
    """

    differences: FloatArray
    interval: tuple[float, float]

    @property
    def less(self) -> bool:
        """The challenger errs less, and that is more than the choice of days."""
        return self.interval[1] < 0.0

    @property
    def words(self) -> str:
        """One sentence."""
        low, high = (100.0 * bound for bound in self.interval)
        spread = f"{100.0 * np.mean(self.differences):+.1f} % ({low:+.1f} … {high:+.1f})"
        return f"over {len(self.differences)} days {spread}"

    def to_dict(self) -> dict[str, Any]:
        """JSON form; a part of the evidence of a promotion."""
        return {
            "differences": self.differences.tolist(),
            "interval_95": list(self.interval),
            "less": self.less,
        }


def over_days(
    champion: RobotEstimator, challenger: RobotEstimator, days: Sequence[Sequence[Path]]
) -> Days:
    """Compare two models day by day.

    Args:
        champion: In use.
        challenger: Of the same joints and unit.
        days: Two at least; of each the recordings, which neither was fitted to.

    Raises:
        DataError: A source cannot be read, or one of them was fitted to it.
        FitError: It holds nothing they work on.
    """
    found = np.array([_difference(champion, challenger, sources) for sources in days])
    count = len(found)
    half = student.ppf(0.5 + SURE / 2, count - 1) * np.std(found, ddof=1) / np.sqrt(count)
    centre = float(np.mean(found))
    return Days(found, (centre - float(half), centre + float(half)))


def _difference(
    champion: RobotEstimator, challenger: RobotEstimator, sources: Sequence[Path]
) -> float:
    """Mean over joints and sources."""
    shares = []
    for part in unseen_parts((champion, challenger), sources):
        old, new = (evaluate(one, part).total.rmse_filtered for one in (champion, challenger))
        shares.append(np.mean(new**2 / np.maximum(old**2, np.finfo(np.float64).tiny)) - 1.0)
    return float(np.mean(shares))
