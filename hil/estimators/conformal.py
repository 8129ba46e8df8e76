"""Split-conformal prediction bands per joint and speed range.

The bands are quantiles of the prediction errors of a model on data that were not used in the fit.
The bands require one assumption only: future motions are like the motions of the calibration data.
A model predicts the effort of a joint worst at low speed, because friction is least known at low
speed. Bands independent of speed would be too wide for most of a motion and too narrow at
reversals. Each joint therefore has several speed ranges; the first range is standstill.

Samples of a trajectory are correlated, so ten thousand samples of nine trajectories are not ten
thousand independent observations. Trajectories can be exchanged with each other, which the method
requires, whereas single samples cannot. `conformal_quantile` and docs/explanation/uncertainty.md
describe which coverage the bands still guarantee.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from hil.core import BoolArray, FitError, FloatArray, IntArray, SpecError
from hil.estimators.parameters import number, whole

STANDSTILL = 0.01
"""Speed up to which a joint counts as static [rad/s]; equal to the default sign width."""

LEAST_SAMPLES = 100
"""Minimum number of samples of a speed range; smaller ranges also use neighbouring samples."""


@dataclass(frozen=True, eq=False)
class SpeedBands:
    """Half width of the prediction band for each joint and speed range.

    Attributes:
        asked: Requested share of samples inside the bands.
        edges: (n, R − 1) speeds between adjacent ranges [rad/s]; the first range is standstill, the
            last range is unlimited.
        half_widths: (n, R) half widths in the unit of the errors.
        guaranteed: (n, R) share of the samples of a new trajectory that lie inside the band on
            average, guaranteed if trajectories are exchangeable.
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
        """Return the bands computed from prediction errors on data that were not used in the fit.

        Args:
            errors: (N, n) measured minus predicted efforts; NaN for samples to be ignored.
            speeds: (N, n) velocities [rad/s].
            blocks: (N,) index of the trajectory to which each row belongs.
            coverage: Share of samples inside the bands, above 0 and below 1.
            ranges: Number of speed ranges including standstill. All speed ranges except standstill
                have the same number of samples.
            standstill: Speed up to which a joint counts as static [rad/s].
            strict: Whether the guaranteed share of samples inside the bands equals `coverage`.
                Strict bands are wider than the default bands. If there are fewer than coverage/(1 −
                coverage) trajectories, the strict guarantee is impossible, and the largest error
                defines the band.

        Raises:
            SpecError: A parameter is out of its range.
            FitError: A joint has no finite error, or the shapes of the arrays do not match.
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
        """Return (N, n) the half width of the band for velocities (N, n) or (n,); NaN for NaN."""
        speed = np.abs(qd)
        joints = np.arange(len(self.edges))
        width = self.half_widths[joints, range_numbers(speed, self.edges)]
        return np.where(np.isfinite(speed), width, np.nan)

    def deviation(self, qd: FloatArray) -> FloatArray:
        """Return (N, n) the standard deviation of normal errors that have this band."""
        return self.half_width(qd) / NormalDist().inv_cdf(0.5 + 0.5 * self.asked)

    def coverage(self, errors: FloatArray, speeds: FloatArray, blocks: IntArray) -> BandCoverage:
        """Return the coverage of errors (N, n) at speeds (N, n), with trajectory numbers (N,).

        Raises:
            FitError: A joint has no finite error, or the shapes of the arrays do not match.
        """
        usable = _usable(errors, speeds, blocks)
        if errors.shape[1] != len(self.edges):
            raise FitError(
                f"the errors are for {errors.shape[1]} joints, the bands for {len(self.edges)}"
            )
        inside = np.abs(errors) <= self.half_width(speeds)
        where = range_numbers(np.abs(speeds), self.edges)
        return BandCoverage.of(inside, usable, where, self.half_widths, blocks, self.asked)

    def to_arrays(self) -> dict[str, FloatArray]:
        """Return the bands as arrays for a model file."""
        return {
            "bands_coverage": np.array([self.asked]),
            "bands_edges": self.edges,
            "bands_half_widths": self.half_widths,
            "bands_guaranteed": self.guaranteed,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, FloatArray]) -> SpeedBands:
        """Return the bands from the output of `to_arrays`.

        Raises:
            KeyError: An array is missing.
            ValueError: Shapes do not match, or values are invalid.
        """
        names = ("coverage", "edges", "half_widths", "guaranteed")
        coverage, edges, half_widths, guaranteed = (arrays[f"bands_{name}"] for name in names)
        bands = cls(float(coverage.item()), edges, half_widths, guaranteed)
        bands._require_valid()
        return bands

    def _require_valid(self) -> None:
        """Raise ValueError if the bands have shapes or values that `calibrate` cannot return."""
        if self.half_widths.ndim != 2 or self.guaranteed.shape != self.half_widths.shape:
            raise ValueError(
                f"bands: half_widths has the shape {self.half_widths.shape}, "
                f"guaranteed {self.guaranteed.shape}"
            )
        n, ranges = self.half_widths.shape
        if self.edges.shape != (n, ranges - 1) or not 0.0 < self.asked < 1.0:
            raise ValueError(
                f"bands: edges has the shape {self.edges.shape}, coverage is {self.asked}"
            )
        for name in ("edges", "half_widths", "guaranteed"):
            values = getattr(self, name)
            if not np.all(np.isfinite(values)) or np.any(values < 0.0):
                raise ValueError(f"bands: {name} has values that are not finite or below 0")
        if np.any(np.diff(self.edges, axis=1) < 0.0):
            raise ValueError("bands: edges are not in order")


def _require_coverage(coverage: float) -> None:
    number("coverage", coverage, above=0.0)
    if coverage >= 1.0:
        raise SpecError(f"coverage is {coverage:g}, but must be below 1", hint="for 90 %, pass 0.9")


def _usable(errors: FloatArray, speeds: FloatArray, blocks: IntArray) -> BoolArray:
    """Return (N, n) a mask of the finite errors with finite speeds."""
    if errors.ndim != 2 or speeds.shape != errors.shape or blocks.shape != errors.shape[:1]:
        raise FitError(
            f"the shapes of errors {errors.shape}, speeds {speeds.shape} and trajectories "
            f"{blocks.shape} do not match",
            hint="pass the shapes (N, n), (N, n) and (N,)",
        )
    usable: BoolArray = np.isfinite(errors) & np.isfinite(speeds)
    for joint in np.flatnonzero(~usable.any(axis=0)):
        raise FitError(
            f"joint {joint + 1} of {errors.shape[1]} has no finite error to calibrate a band with",
            hint="hold out a trajectory on which the model is valid",
        )
    return usable


def _bands(
    sizes: FloatArray, speeds: FloatArray, blocks: IntArray, edges: FloatArray,
    coverage: float, strict: bool,
) -> list[tuple[float, float]]:  # fmt: skip
    """Return the half width and the guaranteed share for each speed range of one joint."""
    where = range_numbers(speeds[:, None], edges[None])[:, 0]
    bands = []
    for chosen in range(len(edges) + 1):
        first, last = window_of(chosen, where, blocks, len(edges) + 1, LEAST_SAMPLES)
        rows = (where >= first) & (where <= last)
        bands.append(conformal_quantile(sizes[rows], blocks[rows], coverage, strict=strict))
    return bands


def speed_edges(speeds: FloatArray, ranges: int, standstill: float) -> FloatArray:
    """Return (ranges − 1,) the speeds between ranges: the standstill limit, followed by quantiles.

    All speed ranges above standstill contain the same number of samples.

    Args:
        speeds: (N,) magnitudes of one joint's velocity [rad/s].
        ranges: Number of speed ranges, including standstill.
        standstill: Upper speed limit of the first range [rad/s].
    """
    moving = speeds[speeds > standstill]
    if ranges < 2 or len(moving) == 0:
        return np.full(max(ranges - 1, 0), standstill)
    inner = np.quantile(moving, np.arange(1, ranges - 1) / (ranges - 1))
    return np.concatenate([[standstill], inner])


def range_numbers(speeds: FloatArray, edges: FloatArray) -> IntArray:
    """Return the range index of each speed, (N, n) or (n,).

    A speed at an edge belongs to the range below the edge.
    """
    return np.asarray((speeds[..., None] > edges).sum(axis=-1), dtype=np.int64)


def window_of(
    chosen: int, where: IntArray, blocks: IntArray, ranges: int, least: int
) -> tuple[int, int]:
    """Return the first and last speed range around `chosen` that together have enough samples.

    A window of ranges is large enough if at least half of the trajectories contribute at least
    `least` samples to it in total. If no window of ranges is large enough, all ranges are returned.

    Args:
        chosen: Index of the speed range at the centre of the window.
        where: (N,) index of the speed range of each sample.
        blocks: (N,) index of the trajectory to which each sample belongs.
        ranges: Number of speed ranges in total.
        least: Minimum number of samples in the window.
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
    """Return an error bound for the next trajectory, and the guaranteed share of its samples.

    If K trajectories have equal weights, the quantile at level p contains on average at least
    p·K/(K + 1) of a new trajectory, for any correlation of its samples (hierarchical conformal
    prediction: Lee, Barber & Willett 2023). With `strict`, the quantile level is increased until
    the guaranteed share is the requested coverage. Without `strict`, the effective number of
    samples replaces K in this increase. If all samples of a trajectory are equal, `strict` does not
    change the bound. If the samples are independent, the increase of the quantile level without
    `strict` is negligible.

    Args:
        sizes: (N,) magnitudes of errors, N > 0.
        blocks: (N,) index of the trajectory to which each error belongs.
        coverage: Requested share of the samples inside the bands.
        strict: Whether to guarantee the requested share.
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
    """Return the quantile level of `size` observations that covers the next observation.

    A level above 1 means that there are too few observations.
    """
    return coverage * (size + 1.0) / size


def effective_samples(outside: BoolArray, numbers: IntArray, count: int) -> float:
    """Return the number of independent samples that contain as much information.

    If the samples were independent, the share outside the bands would vary between trajectories
    with the variance of a binomial distribution. The ratio of the actual variance between
    trajectories to the binomial variance is the design effect of cluster samples (Kish 1965). The
    effective number of samples is at least the number of blocks and at most the number of samples.
    A single block gives 1.

    Args:
        outside: (N,) mask of the samples outside the bands.
        numbers: (N,) block index of each sample.
        count: Total number of blocks.
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
    """Return the smallest value whose cumulative weight is at least `level`.

    A level of 1 or more returns the largest value.
    """
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    place = int(np.searchsorted(reached, level - ROUNDING))
    return float(values[order[min(place, len(order) - 1)]])


def block_numbers(blocks: IntArray) -> tuple[IntArray, int]:
    """Return (N,) the index of each row's block from 0, and the number of blocks."""
    names, numbers = np.unique(blocks, return_inverse=True)
    return numbers, len(names)


def block_weights(numbers: IntArray, count: int) -> FloatArray:
    """Return (N,) weights with sum 1 that give every block the same total weight."""
    sizes = np.bincount(numbers, minlength=count)
    weights: FloatArray = 1.0 / (count * sizes[numbers])
    return weights


@dataclass(frozen=True, eq=False)
class BandCoverage:
    """Observed share of samples inside the bands.

    Attributes:
        asked: Requested share of samples inside the bands.
        share: (n,) mean observed share over trajectories, to be compared with `asked`.
        by_range: (n, R) observed share in each speed range; NaN for a range without samples.
        worst: (n,) observed share in the trajectory with the smallest share.
        mean_half_width: (n,) mean half width of the bands, in the unit of the errors.
        trajectories: Number of trajectories that were evaluated.
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
        """Return the observed shares of samples inside the bands.

        Args:
            inside: (N, n) mask of the errors inside their band.
            usable: (N, n) mask of the errors that are counted.
            where: (N, n) index of the speed range of each error.
            half_widths: (n, R) half widths of the bands.
            blocks: (N,) index of the trajectory to which each row belongs.
            asked: Requested share of samples inside the bands.
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
        """Return a summary of the coverage in one line."""
        return (
            f"{100.0 * self.share.mean():.1f} % of the samples of {self.trajectories} trajectories "
            f"lie within bands made for {100.0 * self.asked:g} % (worst joint "
            f"{100.0 * self.share.min():.1f} %, worst trajectory {100.0 * self.worst.min():.1f} %)"
        )

    def facts(self) -> dict[str, object]:
        """Return the coverage as entries for a model file or a report."""
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
