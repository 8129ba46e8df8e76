"""Identifiability of parameters from data.

`condition_report` returns the condition numbers of a regressor and its least determined
combinations of parameters. `essential_parameters` returns the parameters without which the data
cannot be explained.
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
"""Number of reported directions, and number of parameters named per direction."""

FAINTEST = 0.1
"""Minimum component of a direction above which its parameter is named."""


@dataclass(frozen=True, slots=True)
class Direction:
    """Combination of parameters, with each parameter in units of its column's norm.

    Attributes:
        gain: Norm of the regressor in the direction of the combination, relative to the best
            determined direction. The reciprocal of `gain` is the ratio of the parameter errors.
        parts: Pairs (parameter, component) of the unit vector of the combination, largest component
            first.
    """

    gain: float
    parts: tuple[tuple[str, float], ...]

    def __str__(self) -> str:
        inside = " ".join(f"{share:+.2f}·({name})" for name, share in self.parts)
        return f"{inside}: {self.gain:.3g} of the best"


@dataclass(frozen=True, slots=True)
class ConditionReport:
    """Condition numbers and least determined directions of a regressor.

    Attributes:
        raw: Condition number of the unscaled regressor, with mixed units.
        scaled: Condition number with all columns scaled to length 1, independent of units.
        worst: Least determined parameter directions, the worst direction first.
    """

    raw: float
    scaled: float
    worst: tuple[Direction, ...]

    def facts(self) -> dict[str, Any]:
        """Return the condition numbers and directions as entries for `model.json`."""
        return {
            "raw": self.raw,
            "scaled": self.scaled,
            "worst": [{"gain": d.gain, "parts": dict(d.parts)} for d in self.worst],
        }


def condition_report(X: FloatArray, names: Sequence[str]) -> ConditionReport:
    """Return the condition report of a regressor, or of a matrix with the same Gram matrix.

    Args:
        X: (m, p) regressor, weighted or unweighted; columns of zeros are reported as not
            determined.
        names: Names of the p parameters.
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
    # The sign of a direction is arbitrary; its largest component is reported as positive.
    sign = 1.0 if vector[order[0]] >= 0 else -1.0
    chosen = [i for i in order if abs(vector[i]) >= FAINTEST]
    return Direction(gain, tuple((names[i], float(sign * vector[i])) for i in chosen))


LEVEL = 0.05
"""Level of the F test: probability that dropping stops at a parameter that is not essential."""


@dataclass(frozen=True, slots=True, eq=False)
class Essential:
    """Essential parameters, and order in which the other parameters were dropped.

    Attributes:
        kept: (k,) indices of the essential parameters, ascending.
        coefficients: (p,) coefficients of the reduced fit; 0 for dropped parameters.
        relative_std: (p,) ratio of standard deviation to magnitude in the reduced fit; infinite for
            dropped parameters.
        dropped: Names of the dropped parameters, in the order of dropping.
        p_value: p-value of the last accepted test; 1 if no parameter was dropped.
    """

    kept: IntArray
    coefficients: FloatArray
    relative_std: FloatArray
    dropped: tuple[str, ...]
    p_value: float

    def facts(self) -> dict[str, Any]:
        """Return the essential parameters and the test result as entries for `model.json`."""
        return {"count": len(self.kept), "dropped": list(self.dropped), "p_value": self.p_value}


def essential_parameters(
    X: FloatArray, y: FloatArray, names: Sequence[str], samples: float
) -> Essential:
    """Return the essential parameters; small parameters with large errors are dropped.

    The selection of parameters follows Pham & Gautier (1991). The parameter with the largest
    relative standard deviation is dropped and the remaining parameters are fitted again, until an F
    test against the full model is significant.

    Args:
        X: (m, p) weighted rows of equal variance, or a matrix with the same Gram matrix.
        y: (m,) target, multiplied by the same weights as X.
        names: Names of the p parameters.
        samples: Number of independent observations: rows divided by their correlation time in
            samples. The level of the test is correct only if `samples` is correct.
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
    """Coefficients, relative errors for unit variance, and sum of squared residuals of a fit."""

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
