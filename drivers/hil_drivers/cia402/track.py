"""A motion in the drives' own integers, read at any place between its rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from hil.core import IntArray

_HALF, _WHOLE = 1 << 31, 1 << 32


@dataclass(frozen=True, eq=False)
class Track:
    """A motion as the drives take it, one row per cycle.

    Attributes:
        segment: Index of the plan's step.
        position: (N, n) of 607Ah, N ≥ 1; begins where the drives hold.
        velocity: (N, n) of 60FFh.
        torque: (N, n) feed-forward, ‰ as 6071h and 60B2h.
    """

    segment: int
    position: IntArray
    velocity: IntArray
    torque: IntArray

    @cached_property
    def rows(self) -> list[tuple[list[int], list[int], list[int]]]:
        """Position, velocity and torque row by row, as plain integers."""
        columns = (self.position.tolist(), self.velocity.tolist(), self.torque.tolist())
        return list(zip(*columns, strict=True))

    def between(self, at: float) -> tuple[list[int], list[int], list[int]]:
        """Position, velocity and torque at a place between rows, counted from 0."""
        row = int(at)
        last = len(self.rows) - 1
        if row >= last:
            return self.rows[last]
        share, here, there = at - row, self.rows[row], self.rows[row + 1]
        position = [
            wrapped(p + round(share * wrapped(q - p)))
            for p, q in zip(here[0], there[0], strict=True)
        ]
        velocity, torque = (
            [round(p + share * (q - p)) for p, q in zip(here[i], there[i], strict=True)]
            for i in (1, 2)
        )
        return position, velocity, torque

    def steps_at(self, at: float) -> list[int]:
        """Increments of position per row from a place on; zeros at the end."""
        row = int(at)
        if row >= len(self.rows) - 1:
            return [0] * len(self.rows[0][0])
        return [
            wrapped(q - p) for p, q in zip(self.rows[row][0], self.rows[row + 1][0], strict=True)
        ]


def wrapped(value: int) -> int:
    """As 32 bits with sign: what a counter that runs over shows, and the shorter way round."""
    return (value + _HALF) % _WHOLE - _HALF


def farthest(a: Sequence[int], b: Sequence[int], scale: Sequence[float]) -> tuple[float, int]:
    """The largest distance between positions, and whose axis it is, each times its scale."""
    return max(
        (abs(wrapped(p - q)) * by, axis)
        for axis, (p, q, by) in enumerate(zip(a, b, scale, strict=True))
    )
