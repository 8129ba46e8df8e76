"""A low-pass of first order, sample by sample."""

from __future__ import annotations

import math

import numpy as np

from hil.core import FloatArray, SpecError


class LowPass:
    """What is slow in a signal (n,); it begins at zero.

    Args:
        cutoff_hz: Where half of the power is left.
        rate_hz: Of the samples.

    Raises:
        SpecError: The cutoff is not between 0 and half the rate.
    """

    def __init__(self, cutoff_hz: float, rate_hz: float) -> None:
        if not 0.0 < cutoff_hz < rate_hz / 2 < math.inf:
            raise SpecError(
                f"a cutoff of {cutoff_hz!r} Hz at {rate_hz!r} samples a second cannot be",
                hint="it must be above 0 and below half the rate",
            )
        self._share = -math.expm1(-2 * math.pi * cutoff_hz / rate_hz)
        self._held: FloatArray | None = None

    def __call__(self, values: FloatArray) -> FloatArray:
        """(n,) the filtered signal after one more sample (n,)."""
        held = np.zeros_like(values) if self._held is None else self._held
        self._held = held + self._share * (values - held)
        return self._held
