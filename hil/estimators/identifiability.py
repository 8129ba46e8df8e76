"""What data can tell of parameters, and what they cannot.

`condition_report` gives the condition numbers of a regressor and the combinations of parameters
that it determines worst; `essential_parameters` the parameters that the data cannot do without.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import FloatArray, IntArray
from hil.dynamics import conditioning
from hil.estimators.distributions import fisher_tail
from hil.estimators.least_squares import upper_triangle

SHOWN = 3
"""Directions that are reported, and parameters named of each."""

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
    # A direction has no sign: its largest part is shown as positive.
    sign = 1.0 if vector[order[0]] >= 0 else -1.0
    chosen = [i for i in order if abs(vector[i]) >= FAINTEST]
    return Direction(gain, tuple((names[i], float(sign * vector[i])) for i in chosen))


LEVEL = 0.05
"""Probability that the test ends the dropping although nothing was lost."""


@dataclass(frozen=True, slots=True, eq=False)
class Essential:
    """What is left, and what went in which order.

    Attributes:
        kept: (k,) numbers of the essential parameters, ascending.
        coefficients: (p,) of the fit without the others, which are 0.
        relative_std: (p,) standard deviation over size of those kept, in that fit; else inf.
        dropped: Names, first dropped first.
        p_value: Of the last test that passed; 1 if nothing was dropped.
    """

    kept: IntArray
    coefficients: FloatArray
    relative_std: FloatArray
    dropped: tuple[str, ...]
    p_value: float

    def facts(self) -> dict[str, Any]:
        """For `model.json`."""
        return {"count": len(self.kept), "dropped": list(self.dropped), "p_value": self.p_value}


def essential_parameters(
    X: FloatArray, y: FloatArray, names: Sequence[str], samples: float
) -> Essential:
    """Drop parameters that are noise: small, with large errors.

    Following Pham & Gautier (1991) the parameter with the largest relative standard deviation is
    dropped and the rest fitted again, until an F test against the whole model says that something
    was lost.

    Args:
        X: (m, p) weighted rows of equal variance, or any matrix with their Gram matrix.
        y: (m,) target, weighted alike.
        names: Length p.
        samples: How many independent observations there were: rows over their correlation time.
            The test is as strict as this number is honest.
    """
    p = X.shape[1]
    R = upper_triangle(np.column_stack([X, y]))
    degrees = max(samples - p, 1.0)
    left = list(range(p))
    fit = whole = _fit(R, left)
    dropped: list[int] = []
    p_value = 1.0
    while len(left) > 1:
        candidate = left[int(np.argmax(fit.relative))]
        remaining = [k for k in left if k != candidate]
        smaller = _fit(R, remaining)
        lost = (smaller.squares - whole.squares) / (len(dropped) + 1)
        tested = fisher_tail(lost / (whole.squares / degrees), len(dropped) + 1, degrees)
        if not tested >= LEVEL:
            break
        left, fit, p_value = remaining, smaller, tested
        dropped.append(candidate)
    coefficients, relative = np.zeros(p), np.full(p, np.inf)
    coefficients[left] = fit.coefficients
    relative[left] = fit.relative * np.sqrt(fit.squares / max(samples - len(left), 1.0))
    return Essential(
        np.array(left), coefficients, relative, tuple(names[k] for k in dropped), p_value
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Coefficients, their errors over their sizes for a variance of 1, and the squares left."""

    coefficients: FloatArray
    relative: FloatArray
    squares: float


def _fit(R: FloatArray, columns: Sequence[int]) -> _Fit:
    triangle = upper_triangle(R[:, [*columns, R.shape[1] - 1]])
    k = len(columns)
    factor, target = triangle[:k, :k], triangle[:k, k]
    length = np.linalg.norm(factor, axis=0)
    length[length == 0] = 1.0
    inverse = np.linalg.pinv(factor / length) / length[:, None]
    coefficients = inverse @ target
    error = np.linalg.norm(inverse, axis=1)
    size = np.maximum(np.abs(coefficients), 1e-300)
    squares = float(np.sum((triangle @ np.append(coefficients, -1.0)) ** 2))
    return _Fit(coefficients, error / size, squares)
