"""Inputs and targets brought to mean 0 and variance 1 inside, and back again outside."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from hil.core import FitError, FloatArray
from hil.networks.lm.rows import Rows

CONSTANT = 1e-12
"""A column whose deviation is below this share of its size does not vary."""


class ConstantInputWarning(UserWarning):
    """An input has the same value in every row, so the network cannot learn from it."""


@dataclass(frozen=True, slots=True, eq=False)
class Scaling:
    """Mean and deviation of inputs and targets.

    Attributes:
        input_mean, input_scale: (1 or B, d).
        target_mean, target_scale: (B,).
    """

    input_mean: FloatArray
    input_scale: FloatArray
    target_mean: FloatArray
    target_scale: FloatArray

    @staticmethod
    def of(rows: Rows) -> Scaling:
        """From the weighted rows; constant columns are warned of and only centred.

        What averaging took away counts too, so that averaged rows are scaled as all of them.

        Raises:
            FitError: Values are so large that their squares overflow.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            x_mean = np.einsum("n,bnd->bd", rows.weight, rows.X)
            x_square = np.einsum("n,bnd->bd", rows.weight, (rows.X - x_mean[:, None]) ** 2)
            y_mean = rows.weight @ rows.Y
            y_square = rows.weight @ (rows.Y - y_mean) ** 2 + rows.scatter
        if not np.all(np.isfinite(x_square)) or not np.all(np.isfinite(y_square)):
            raise FitError("inputs or targets are too large to be squared: are the units right?")
        x_scale = _deviation(x_square, x_mean)
        constant = np.flatnonzero(np.all(x_scale == 0, axis=0))
        if len(constant):
            listed = ", ".join(str(k + 1) for k in constant)
            warnings.warn(
                f"input {listed} of {rows.X.shape[2]} has the same value in every row: the network "
                "learns nothing from it, and predictions at other values of it mean nothing",
                ConstantInputWarning,
                stacklevel=4,
            )
        y_scale = _deviation(y_square, y_mean)
        return Scaling(x_mean, _nonzero(x_scale), y_mean, _nonzero(y_scale))

    def single(self, network: int) -> Scaling:
        """That of one network alone."""
        one = slice(network, network + 1)
        inputs = one if len(self.input_mean) > 1 else slice(None)
        return Scaling(
            self.input_mean[inputs],
            self.input_scale[inputs],
            self.target_mean[one],
            self.target_scale[one],
        )

    def inputs(self, X: FloatArray) -> FloatArray:
        """Standardised (1 or B, N, d) of (N, d) or (B, N, d)."""
        batch = X[None] if X.ndim == 2 else X
        return (batch - self.input_mean[:, None]) / self.input_scale[:, None]

    def targets(self, Y: FloatArray) -> FloatArray:
        """Standardised (B, N) of (N, B)."""
        return ((Y - self.target_mean) / self.target_scale).T

    def outputs(self, standard: FloatArray) -> FloatArray:
        """(N, B) in the unit of the target, of (B, N)."""
        return standard.T * self.target_scale + self.target_mean


def _deviation(square: FloatArray, mean: FloatArray) -> FloatArray:
    found = np.sqrt(square)
    found[found <= CONSTANT * np.abs(mean)] = 0.0
    return found


def _nonzero(scale: FloatArray) -> FloatArray:
    return np.where(scale > 0, scale, 1.0)
