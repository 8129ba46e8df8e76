"""How well data determine parameters, and which combinations of them they determine worst."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import FloatArray
from hil.dynamics import conditioning
from hil.estimators.least_squares import upper_triangle

SHOWN = 3
"""Directions that are told, and parameters named of each."""

FAINTEST = 0.1
"""A parameter with a smaller part in a direction is not named."""


@dataclass(frozen=True, slots=True)
class Direction:
    """A combination of parameters, in units of their columns' lengths.

    Attributes:
        gain: Length of the regressor along it over that along the best determined one; its
            reciprocal is by how much larger its error is.
        parts: (parameter, share), shares of a vector of length 1, largest first.
    """

    gain: float
    parts: tuple[tuple[str, float], ...]

    def __str__(self) -> str:
        inside = " ".join(f"{share:+.2f}·({name})" for name, share in self.parts)
        return f"{inside}: {self.gain:.3g} of the best"


@dataclass(frozen=True, slots=True)
class ConditionReport:
    """Condition numbers and the directions behind them.

    Attributes:
        raw: Condition number as the regressor stands, mixed units and all.
        scaled: With all columns scaled to length 1; errors of parameters do not depend on units.
        worst: The least determined directions, worst first.
    """

    raw: float
    scaled: float
    worst: tuple[Direction, ...]

    def facts(self) -> dict[str, Any]:
        """For `model.json`."""
        return {
            "raw": self.raw,
            "scaled": self.scaled,
            "worst": [{"gain": d.gain, "parts": dict(d.parts)} for d in self.worst],
        }


def condition_report(X: FloatArray, names: Sequence[str]) -> ConditionReport:
    """Report on a regressor (m, p), or any matrix with its Gram matrix, weighted or not.

    Args:
        X: (m, p); columns of zeros are reported as not determined at all.
        names: Length p.
    """
    numbers = conditioning(X)
    R = upper_triangle(X)
    length = np.linalg.norm(R, axis=0)
    _, gains, directions = np.linalg.svd(R / np.where(length > 0, length, 1.0))
    padded = np.zeros(len(names))
    padded[: len(gains)] = gains
    largest = padded[0] if padded[0] > 0 else 1.0
    worst = tuple(
        _direction(float(padded[k] / largest), directions[k], names)
        for k in range(len(names) - 1, max(len(names) - 1 - SHOWN, -1), -1)
    )
    return ConditionReport(numbers.raw, numbers.scaled, worst)


def _direction(gain: float, vector: FloatArray, names: Sequence[str]) -> Direction:
    order = np.argsort(-np.abs(vector))[:SHOWN]
    # A direction has no sign: its largest part is told as positive.
    sign = 1.0 if vector[order[0]] >= 0 else -1.0
    chosen = [i for i in order if abs(vector[i]) >= FAINTEST]
    return Direction(gain, tuple((names[i], float(sign * vector[i])) for i in chosen))
