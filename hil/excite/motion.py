"""Motions as parameters: what a plan stores and a robot is given samples of.

Three kinds suffice: a straight line in joint space from rest to rest, a finite Fourier series,
and standing still. `sample` is a pure function, so plan, preview, collision check and execution
see the same set-points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from hil.typing import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Set-points at a fixed rate: `t` (N,), `q`, `qd`, `qdd` (N, n) in rad, rad/s, rad/s²."""

    t: FloatArray
    q: FloatArray
    qd: FloatArray
    qdd: FloatArray


class Motion(Protocol):
    """A commanded motion from rest to rest."""

    @property
    def duration_s(self) -> float:
        """Time from the first to the last set-point [s]."""

    @property
    def q_start(self) -> FloatArray:
        """Joint position before the first set-point, (n,)."""

    @property
    def q_end(self) -> FloatArray:
        """Joint position of the last set-point, (n,)."""

    def sample(self, rate_hz: float) -> Samples:
        """Set-points at t = 1/rate, 2/rate, … up to and including `duration_s`."""

    def to_dict(self) -> dict[str, Any]:
        """JSON form with a `kind` key; floats survive the round trip exactly."""
