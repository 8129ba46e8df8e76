"""How far off a prediction may be: split-conformal bands per joint and speed range.

The bands are quantiles of errors that a model made where it had not learned, so they need no
assumption about those errors but one: that the motions to come are like those of the calibration.
A joint errs most where it hardly moves, because friction is known least there; bands that do not
depend on speed would be too wide for most of a motion and too narrow for its reversals.

What is guaranteed, and how samples that depend on each other are weighed, is said in
`hil.estimators.block_quantile` and in docs/explanation/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from hil.core import BoolArray, FitError, FloatArray, IntArray, SpecError
from hil.estimators.band_coverage import BandCoverage
from hil.estimators.block_quantile import conformal_quantile
from hil.estimators.parameters import number, whole
from hil.estimators.speed_ranges import range_numbers, speed_edges, window_of

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
        found = np.array(bands).reshape(len(joints), ranges, 2)
        return cls(coverage, np.array(edges), found[..., 0].copy(), found[..., 1].copy())

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

    def to_arrays(self, prefix: str = "bands_") -> dict[str, FloatArray]:
        """For a model file."""
        return {
            f"{prefix}coverage": np.array([self.asked]),
            f"{prefix}edges": self.edges,
            f"{prefix}half_widths": self.half_widths,
            f"{prefix}guaranteed": self.guaranteed,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, FloatArray], prefix: str = "bands_") -> SpeedBands:
        """What `to_arrays` wrote.

        Raises:
            KeyError: One is missing.
            ValueError: They do not go together, or hold what cannot be.
        """
        names = ("coverage", "edges", "half_widths", "guaranteed")
        coverage, edges, half_widths, guaranteed = (arrays[prefix + name] for name in names)
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


def _bands(
    sizes: FloatArray, speeds: FloatArray, blocks: IntArray, edges: FloatArray,
    coverage: float, strict: bool,
) -> list[tuple[float, float]]:  # fmt: skip
    """Half width and what is guaranteed of it, for each range of one joint."""
    where = range_numbers(speeds[:, None], edges[None])[:, 0]
    found = []
    for chosen in range(len(edges) + 1):
        first, last = window_of(chosen, where, blocks, len(edges) + 1, LEAST_SAMPLES)
        rows = (where >= first) & (where <= last)
        found.append(conformal_quantile(sizes[rows], blocks[rows], coverage, strict=strict))
    return found


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


def _require_coverage(coverage: float) -> None:
    number("coverage", coverage, above=0.0)
    if coverage >= 1.0:
        raise SpecError(
            f"coverage is {coverage:g}, but must be below 1", hint="say 0.9 for nine in ten"
        )
