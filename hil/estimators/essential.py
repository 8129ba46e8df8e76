"""Essential parameters: those the data cannot do without.

Small parameters with large errors are noise. Following Pham & Gautier (1991) the parameter with
the largest relative standard deviation is dropped and the rest fitted again, until an F test
against the whole model says that something was lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import FloatArray, IntArray
from hil.estimators.least_squares import upper_triangle

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
    X: FloatArray, y: FloatArray, names: Sequence[str], samples: float, level: float = LEVEL
) -> Essential:
    """Drop parameters until the data object.

    Args:
        X: (m, p) weighted rows of equal variance, or any matrix with their Gram matrix.
        y: (m,) target, weighted alike.
        names: Length p.
        samples: How many independent observations there were: rows over their correlation time.
            The test is as strict as this number is honest.
        level: Of the test.
    """
    from scipy.stats import f as fisher

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
        tested = float(fisher.sf(lost / (whole.squares / degrees), len(dropped) + 1, degrees))
        if not tested >= level:
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
