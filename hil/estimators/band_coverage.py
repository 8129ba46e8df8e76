"""What bands hold of errors they were not made from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.estimators.block_quantile import block_numbers, block_weights


@dataclass(frozen=True, eq=False)
class BandCoverage:
    """Shares of samples within the bands.

    Attributes:
        asked: What the bands were made for.
        share: (n,) mean over trajectories: what `asked` is to be compared with.
        by_range: (n, R) share in each speed range, NaN where there are no samples.
        worst: (n,) least of any trajectory.
        mean_half_width: (n,) in the unit of the errors.
        trajectories: How many there were.
    """

    asked: float
    share: FloatArray
    by_range: FloatArray
    worst: FloatArray
    mean_half_width: FloatArray
    trajectories: int

    @classmethod
    def of(
        cls,
        inside: BoolArray,
        usable: BoolArray,
        where: IntArray,
        half_widths: FloatArray,
        blocks: IntArray,
        asked: float,
    ) -> BandCoverage:
        """Count.

        Args:
            inside: (N, n) which errors lie within their band.
            usable: (N, n) which count at all.
            where: (N, n) speed range of each.
            half_widths: (n, R) of the bands.
            blocks: (N,) trajectory of each row.
            asked: Share that the bands were made for.
        """
        n, ranges = half_widths.shape
        share, worst, width, by_range = np.empty(n), np.empty(n), np.empty(n), np.empty((n, ranges))
        for joint in range(n):
            rows = usable[:, joint]
            held, speed = inside[rows, joint], where[rows, joint]
            shares = _shares(held, blocks[rows])
            share[joint], worst[joint] = shares.mean(), shares.min()
            width[joint] = half_widths[joint, speed].mean()
            by_range[joint] = [
                _mean_share(held[speed == r], blocks[rows][speed == r]) for r in range(ranges)
            ]
        return cls(asked, share, by_range, worst, width, len(np.unique(blocks)))

    def line(self) -> str:
        """One line to read."""
        return (
            f"{100.0 * self.share.mean():.1f} % of the samples of {self.trajectories} trajectories "
            f"lie within bands made for {100.0 * self.asked:g} % (worst joint "
            f"{100.0 * self.share.min():.1f} %, worst trajectory {100.0 * self.worst.min():.1f} %)"
        )

    def facts(self) -> dict[str, object]:
        """For a model file or a report."""
        return {
            "asked": self.asked,
            "share": self.share.tolist(),
            "worst_trajectory": self.worst.tolist(),
            "mean_half_width": self.mean_half_width.tolist(),
            "trajectories": self.trajectories,
        }


def _shares(held: BoolArray, blocks: IntArray) -> FloatArray:
    numbers, count = block_numbers(blocks)
    return np.asarray(np.bincount(numbers, held, count) / np.bincount(numbers, minlength=count))


def _mean_share(held: BoolArray, blocks: IntArray) -> float:
    if len(held) == 0:
        return float("nan")
    return float(block_weights(*block_numbers(blocks)) @ held)
