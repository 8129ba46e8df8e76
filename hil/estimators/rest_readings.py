"""What an arm's drives gave at poses it held, friction told from the rest by the two approaches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, DataError, FloatArray
from hil.data import Conditions, Dataset, series_means

SAME_POSE_RAD = 0.01
"""Poses whose joints are all nearer than this to one another are one pose."""


@dataclass(frozen=True, slots=True, eq=False)
class RestReadings:
    """Efforts at P poses; of a pose that was approached from both sides, the mean of both.

    Attributes:
        q: (P, n) positions [rad].
        effort: (P, n) in the unit of the data.
        half: (P, n) half the difference between the approaches; NaN where there was one only.
        sides: Per pose, the approaches there were: +1, −1, and 0 for an unknown one.
    """

    q: FloatArray
    effort: FloatArray
    half: FloatArray
    sides: tuple[frozenset[int], ...]

    @property
    def one_sided(self) -> BoolArray:
        """(P,) poses at which friction does not cancel."""
        return np.asarray(~np.isfinite(self.half).all(axis=1))

    @staticmethod
    def of(dwells: Dataset) -> RestReadings:
        """Put dwells together, pose by pose."""
        q, effort = (series_means(dwells, dwells[name]) for name in ("q", "effort"))
        poses: dict[tuple[str, int], dict[int, list[int]]] = {}
        for number, condition in enumerate(dwells.conditions):
            sides = poses.setdefault(_pose(condition, number), {})
            sides.setdefault(condition.approach, []).append(number)
        rows = [_read(q, effort, sides) for sides in poses.values()]
        at, mean, half = (np.array(column) for column in zip(*rows, strict=True))
        return RestReadings(at, mean, half, tuple(map(frozenset, poses.values())))

    def matching(self, other: RestReadings) -> RestReadings:
        """The readings of `other` at the poses of this one, in this order.

        Raises:
            DataError: It was not at one of them, or came there from elsewhere.
        """
        apart = np.max(np.abs(self.q[:, None] - other.q[None]), axis=2)
        nearest = np.argmin(apart, axis=1)
        missing = [
            pose
            for pose, there in enumerate(nearest)
            if apart[pose, there] > SAME_POSE_RAD or self.sides[pose] != other.sides[there]
        ]
        if missing:
            raise DataError(
                f"{len(missing)} of {len(self.q)} poses were not held with the bare flange, or not "
                "approached from the same sides",
                hint="run the same program with and without the load",
            )
        sides = tuple(other.sides[there] for there in nearest)
        return RestReadings(other.q[nearest], other.effort[nearest], other.half[nearest], sides)


def _pose(condition: Conditions, number: int) -> tuple[str, int]:
    """Dwells without a number of a pose, or without a side, are poses of their own."""
    known = condition.pose >= 0 and condition.approach
    return (condition.source, condition.pose) if known else ("", number)


def _read(
    q: FloatArray, effort: FloatArray, sides: dict[int, list[int]]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position, effort and half difference (n,) of one pose, both sides weighing the same."""
    at, mean = (
        np.mean([values[numbers].mean(axis=0) for numbers in sides.values()], axis=0)
        for values in (q, effort)
    )
    if not {1, -1} <= sides.keys():
        return at, mean, np.full_like(mean, np.nan)
    return at, mean, (effort[sides[1]].mean(axis=0) - effort[sides[-1]].mean(axis=0)) / 2
