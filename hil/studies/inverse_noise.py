"""What every error is to be seen beside: the noise, and repeating the last torque."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, freqz

from hil.core import FloatArray
from hil.data import nyquist_fraction, persistence, persistence_rmse, sample_rate
from hil.studies.inverse_cases import Case

FREQUENCIES = 1 << 14

WIDEST = 0.5
"""Of the band: a cut-off above leaves too little beside it to tell noise from signal."""


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """Torque of a moment ago, repeated.

    Attributes:
        age_s: How old it mostly is: samples come when they come.
        error: (n,) what that leaves [N·m].
    """

    age_s: float
    error: FloatArray


def white_noise_left(removed: FloatArray, case: Case) -> FloatArray:
    """(n,) RMS of the noise in the filtered torque, if white noise was filtered.

    NaN where the cut-off leaves less than half of the band above it: signal is then most of that.

    Args:
        removed: (n,) RMS of what the filter took out.
        case: Says how it filtered.
    """
    rate = sample_rate(case.judge["t"][: case.judge.offsets[1]])
    settings = case.filters
    fraction = nyquist_fraction(settings.effort, settings.unit, rate)
    if fraction > WIDEST:
        return np.full_like(removed, np.nan)
    b, a = butter(settings.order, fraction)
    # Forwards and backwards: the gain is the square of one pass's magnitude.
    gain = np.abs(freqz(b, a, FREQUENCIES)[1]) ** 2
    share = np.sqrt(np.mean(gain**2) / np.mean((1.0 - gain) ** 2))
    return np.asarray(share * removed)


def persistence_of(case: Case, latency_s: float) -> Held:
    """What taking the newest filtered torque that is `latency_s` old for that of now comes to."""
    error = persistence_rmse(case.judge, latency_s, "effort_f", case.rows)
    age = case.judge["t"] - persistence(case.judge, latency_s, "t")
    return Held(float(np.nanmedian(age[case.rows])), error * case.scale)
