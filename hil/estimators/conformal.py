"""How far off a prediction may be: split-conformal bands per joint and speed range.

The bands are quantiles of errors that a model made where it had not learned, so they need no
assumption about those errors but one: that the motions to come are like those of the calibration.
A joint errs most where it hardly moves, because friction is known least there; bands that do not
depend on speed would be too wide for most of a motion and too narrow for its reversals. Each joint
therefore has ranges of speed, standstill being the first.

Samples of a trajectory resemble each other, so ten thousand samples of nine trajectories are not
ten thousand observations. Trajectories may be exchanged for each other; samples may not. What that
leaves of the guarantee is said in `conformal_quantile` and in docs/explanation/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from hil.core import BoolArray, FitError, FloatArray, IntArray, SpecError
from hil.estimators.parameters import number, whole

STANDSTILL = 0.01
"""Up to this speed [rad/s] a joint counts as standing: the width of the sign of all methods."""

LEAST_SAMPLES = 100
"""A range with fewer samples takes those of its neighbours with it."""


@dataclass(frozen=True, eq=False)
class SpeedBands:
    """A half width per joint and speed range.

    Attributes:
        asked: Share of samples that the bands are to hold.
        edges: (n, R − 1) speeds where one range ends and the next begins [rad/s], the first range
            being standstill and the last unlimited.
        half_widths: (n, R) in the unit of the errors.
        guaranteed: (n, R) share of the samples of a new trajectory that is proven to lie within
            the band on average, given that trajectories can be exchanged for each other.
    """

    asked: float
    edges: FloatArray
    half_widths: FloatArray
    guaranteed: FloatArray

    @classmethod
    def calibrate(
        cls,
        errors: FloatArray,
        speeds: FloatArray,
        blocks: IntArray,
        coverage: float = 0.9,
        *,
        ranges: int = 5,
        standstill: float = STANDSTILL,
        strict: bool = False,
    ) -> SpeedBands:
        """From errors on data that the model has not learned from.

        Args:
            errors: (N, n) measured minus predicted; NaN where a joint's does not count.
            speeds: (N, n) velocities [rad/s].
            blocks: (N,) number of the trajectory of each row.
            coverage: Share of samples within the bands, above 0 and below 1.
            ranges: Speed ranges, standstill included. The others have equally many samples.
            standstill: Up to this speed a joint stands [rad/s].
            strict: Let the proven share be the coverage asked for: wider, and out of reach with
                fewer than coverage/(1 − coverage) trajectories, when the largest error is taken.

        Raises:
            SpecError: A parameter is out of its range.
            FitError: A joint has no error that counts, or the arrays do not go together.
        """
        _require_coverage(coverage)
        whole("ranges", ranges, at_least=1)
        number("standstill", standstill, at_least=0.0)
        usable = _usable(errors, speeds, blocks)
        joints = range(errors.shape[1])
        rows = [usable[:, j] for j in joints]
        edges = [speed_edges(np.abs(speeds[rows[j], j]), ranges, standstill) for j in joints]
        bands = [
            _bands(np.abs(errors[rows[j], j]), np.abs(speeds[rows[j], j]), blocks[rows[j]],
                   edges[j], coverage, strict)
            for j in joints
        ]  # fmt: skip
        pairs = np.array(bands).reshape(len(joints), ranges, 2)
        return cls(coverage, np.array(edges), pairs[..., 0].copy(), pairs[..., 1].copy())

    def half_width(self, qd: FloatArray) -> FloatArray:
        """(N, n) half width of the band at velocities (N, n) or (n,); NaN where that is NaN."""
        speed = np.abs(qd)
        joints = np.arange(len(self.edges))
        width = self.half_widths[joints, range_numbers(speed, self.edges)]
        return np.where(np.isfinite(speed), width, np.nan)

    def deviation(self, qd: FloatArray) -> FloatArray:
        """(N, n) the standard deviation a normal error would have within such a band."""
        return self.half_width(qd) / NormalDist().inv_cdf(0.5 + 0.5 * self.asked)

    def coverage(self, errors: FloatArray, speeds: FloatArray, blocks: IntArray) -> BandCoverage:
        """What the bands hold of errors (N, n) at speeds (N, n), blocks (N,) being trajectories.

        Raises:
            FitError: A joint has no error that counts, or the arrays do not go together.
        """
        usable = _usable(errors, speeds, blocks)
        if errors.shape[1] != len(self.edges):
            raise FitError(f"errors of {errors.shape[1]} joints, bands of {len(self.edges)}")
        inside = np.abs(errors) <= self.half_width(speeds)
        where = range_numbers(np.abs(speeds), self.edges)
        return BandCoverage.of(inside, usable, where, self.half_widths, blocks, self.asked)

    def to_arrays(self) -> dict[str, FloatArray]:
        """For a model file."""
        return {
            "bands_coverage": np.array([self.asked]),
            "bands_edges": self.edges,
            "bands_half_widths": self.half_widths,
            "bands_guaranteed": self.guaranteed,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, FloatArray]) -> SpeedBands:
        """What `to_arrays` wrote.

        Raises:
            KeyError: One is missing.
            ValueError: They do not go together, or hold what cannot be.
        """
        names = ("coverage", "edges", "half_widths", "guaranteed")
        coverage, edges, half_widths, guaranteed = (arrays[f"bands_{name}"] for name in names)
        bands = cls(float(coverage.item()), edges, half_widths, guaranteed)
        bands._require_sound()
        return bands

    def _require_sound(self) -> None:
        """Raise ValueError for what `calibrate` cannot have made."""
        if self.half_widths.ndim != 2 or self.guaranteed.shape != self.half_widths.shape:
            raise ValueError(f"bands: {self.half_widths.shape} and {self.guaranteed.shape}")
        n, ranges = self.half_widths.shape
        if self.edges.shape != (n, ranges - 1) or not 0.0 < self.asked < 1.0:
            raise ValueError(f"bands: {self.edges.shape} edges, coverage {self.asked}")
        for name in ("edges", "half_widths", "guaranteed"):
            values = getattr(self, name)
            if not np.all(np.isfinite(values)) or np.any(values < 0.0):
                raise ValueError(f"bands: {name} has values that are not finite or below 0")
        if np.any(np.diff(self.edges, axis=1) < 0.0):
            raise ValueError("bands: edges are not in order")


def _require_coverage(coverage: float) -> None:
    number("coverage", coverage, above=0.0)
    if coverage >= 1.0:
        raise SpecError(
            f"coverage is {coverage:g}, but must be below 1", hint="say 0.9 for nine in ten"
        )


def _usable(errors: FloatArray, speeds: FloatArray, blocks: IntArray) -> BoolArray:
    """(N, n) which errors count."""
    if errors.ndim != 2 or speeds.shape != errors.shape or blocks.shape != errors.shape[:1]:
        raise FitError(
            f"errors {errors.shape}, speeds {speeds.shape} and trajectories {blocks.shape} do not "
            "go together",
            hint="give (N, n), (N, n) and (N,)",
        )
    usable: BoolArray = np.isfinite(errors) & np.isfinite(speeds)
    for joint in np.flatnonzero(~usable.any(axis=0)):
        raise FitError(
            f"joint {joint + 1} of {errors.shape[1]} has no finite error to calibrate a band with",
            hint="hold out a trajectory where the model is valid",
        )
    return usable


def _bands(
    sizes: FloatArray, speeds: FloatArray, blocks: IntArray, edges: FloatArray,
    coverage: float, strict: bool,
) -> list[tuple[float, float]]:  # fmt: skip
    """Half width and what is guaranteed of it, for each range of one joint."""
    where = range_numbers(speeds[:, None], edges[None])[:, 0]
    bands = []
    for chosen in range(len(edges) + 1):
        first, last = window_of(chosen, where, blocks, len(edges) + 1, LEAST_SAMPLES)
        rows = (where >= first) & (where <= last)
        bands.append(conformal_quantile(sizes[rows], blocks[rows], coverage, strict=strict))
    return bands


def speed_edges(speeds: FloatArray, ranges: int, standstill: float) -> FloatArray:
    """(ranges − 1,) speeds where ranges meet: standstill, then equally many samples in each.

    Args:
        speeds: (N,) magnitudes of one joint's velocity [rad/s].
        ranges: How many, standstill included.
        standstill: Where the first ends [rad/s].
    """
    moving = speeds[speeds > standstill]
    if ranges < 2 or len(moving) == 0:
        return np.full(max(ranges - 1, 0), standstill)
    inner = np.quantile(moving, np.arange(1, ranges - 1) / (ranges - 1))
    return np.concatenate([[standstill], inner])


def range_numbers(speeds: FloatArray, edges: FloatArray) -> IntArray:
    """(N, n) or (n,) number of the range of each speed; an edge belongs to the range below it."""
    return np.asarray((speeds[..., None] > edges).sum(axis=-1), dtype=np.int64)


def window_of(
    chosen: int, where: IntArray, blocks: IntArray, ranges: int, least: int
) -> tuple[int, int]:
    """First and last of the ranges around `chosen` that hold enough samples together.

    Enough are `least` samples of at least half of the trajectories, or all there are.

    Args:
        chosen: The range in question.
        where: (N,) range of each sample.
        blocks: (N,) trajectory of each.
        ranges: How many there are.
        least: Samples.
    """
    most = len(np.unique(blocks))
    for reach in range(ranges):
        first, last = max(chosen - reach, 0), min(chosen + reach, ranges - 1)
        inside = (where >= first) & (where <= last)
        if inside.sum() >= least and 2 * len(np.unique(blocks[inside])) >= most:
            return first, last
    return 0, ranges - 1


def conformal_quantile(
    sizes: FloatArray, blocks: IntArray, coverage: float, *, strict: bool = False
) -> tuple[float, float]:
    """A bound for the next trajectory, and the share of its samples that it is proven to hold.

    With equal weights of K trajectories the quantile at level p holds at least p·K/(K + 1) of a
    new one on average, however its samples depend on each other (hierarchical conformal
    prediction: Lee, Barber & Willett 2023). `strict` raises the level until that is the coverage
    asked for. Without, the level is raised by the effective number of samples in place of K: the
    same where all samples of a trajectory are alike, next to nothing where they are independent.

    Args:
        sizes: (N,) magnitudes of errors, N > 0.
        blocks: (N,) trajectory of each.
        coverage: Share asked for.
        strict: As above.
    """
    numbers, count = block_numbers(blocks)
    weights = block_weights(numbers, count)
    effective = float(count)
    if not strict:
        first = weighted_quantile(sizes, weights, coverage)
        effective = effective_samples(sizes > first, numbers, count)
    level = min(level_for(coverage, effective), 1.0)
    return weighted_quantile(sizes, weights, level), level * count / (count + 1.0)


def level_for(coverage: float, size: float) -> float:
    """Level of the quantile of `size` observations that covers the next with `coverage`.

    Above 1 there are too few of them for that.
    """
    return coverage * (size + 1.0) / size


def effective_samples(outside: BoolArray, numbers: IntArray, count: int) -> float:
    """How many independent samples would estimate the share outside as well as these do.

    If the share outside varied by chance alone, its variance among trajectories would be that of
    a binomial; the ratio of the two is the design effect of cluster samples (Kish 1965). At least
    the number of blocks, at most that of samples; of a single block, which cannot say, the
    former.

    Args:
        outside: (N,) which samples are outside.
        numbers: (N,) block of each.
        count: Blocks.
    """
    if count < 2:
        return float(count)
    shares = np.bincount(numbers, outside, count) / np.bincount(numbers, minlength=count)
    mean, variance = float(np.mean(shares)), float(np.var(shares, ddof=1))
    if variance <= 0.0:
        return float(len(outside))
    return float(np.clip(count * mean * (1.0 - mean) / variance, count, len(outside)))


ROUNDING = 1e-9


def weighted_quantile(values: FloatArray, weights: FloatArray, level: float) -> float:
    """Least of the values that at least the share `level` of the weight does not exceed.

    A level of 1 or more gives the largest value.
    """
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    place = int(np.searchsorted(reached, level - ROUNDING))
    return float(values[order[min(place, len(order) - 1)]])


def block_numbers(blocks: IntArray) -> tuple[IntArray, int]:
    """(N,) number of each row's block from 0, and how many there are."""
    names, numbers = np.unique(blocks, return_inverse=True)
    return numbers, len(names)


def block_weights(numbers: IntArray, count: int) -> FloatArray:
    """(N,) weights that add up to 1, every block having the same share."""
    sizes = np.bincount(numbers, minlength=count)
    weights: FloatArray = 1.0 / (count * sizes[numbers])
    return weights


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
