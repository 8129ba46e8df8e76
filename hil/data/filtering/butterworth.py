"""The zero-phase low-pass filter, and sample rates it refers to."""

from __future__ import annotations

import numpy as np

from hil.core import BoolArray, DataError, FloatArray

MAX_NYQUIST_FRACTION = 0.8
"""Above this the bilinear transform squeezes the stop band to nothing."""

CLOCK = 5e-3
"""Share by which a robot's clock may run slow: 50 Hz is 0.8 of the Nyquist frequency at 125 Hz, and
has to be allowed at 124.98 Hz."""

MIN_NYQUIST_FRACTION = 1e-6
"""Below this nothing passes, and soon the filter cannot be computed."""

PAUSE_STEPS = 3.0
"""A step in time longer than this many median steps is a pause: no filter may run across it."""


def sample_rate(t: FloatArray) -> float:
    """Mean sample rate [Hz] of time stamps (N,), pauses left out.

    What a pause is, `PAUSE_STEPS` says; series read from recordings hold none. The mean is used
    because stamps of millisecond resolution alternate (10 ms, 12 ms), so their median is off by
    several per cent.

    Raises:
        DataError: Fewer than two samples, or time does not increase.
    """
    steps = np.diff(t)
    if len(steps) == 0 or not np.all(steps > 0):
        raise DataError(
            "the sample rate needs at least two strictly increasing time stamps",
            hint="import the file again with --drop-bad-rows, or leave the series out",
        )
    return float(1.0 / np.mean(steps[~is_pause(steps)]))


def is_pause(steps: FloatArray) -> BoolArray:
    """(M,) which of the steps in time (M,) between successive samples are pauses."""
    if not len(steps):
        return np.zeros(0, dtype=bool)
    longer: BoolArray = steps > PAUSE_STEPS * np.median(steps)
    return longer


def nyquist_fraction(cutoff: float, unit: str, rate_hz: float) -> float:
    """The cut-off as a fraction of the Nyquist frequency.

    Raises:
        DataError: It lies above 0.8 of the Nyquist frequency, or below a millionth.
    """
    fraction = cutoff if unit == "nyquist" else cutoff / (0.5 * rate_hz)
    if 0 < fraction < MIN_NYQUIST_FRACTION:
        raise DataError(
            f"a cut-off at {cutoff:.4g} {unit} lets nothing through of samples at {rate_hz:.4g} Hz",
            hint="look at the unit of the time stamps: they have to be seconds; or raise the "
            "cut-off",
        )
    if not 0 < fraction <= MAX_NYQUIST_FRACTION * (1 + CLOCK):
        highest = 0.5 * MAX_NYQUIST_FRACTION * rate_hz
        raise DataError(
            f"a cut-off at {fraction:.3g} of the Nyquist frequency is too high "
            f"for samples at {rate_hz:.4g} Hz",
            hint=f"choose at most {MAX_NYQUIST_FRACTION} (nyquist) or {highest:.4g} (hz)",
        )
    return fraction


def zero_phase(values: FloatArray, fraction: float, order: int = 5) -> FloatArray:
    """Butterworth filter along axis 0, forwards and backwards, without phase shift.

    Args:
        values: (N,) or (N, …).
        fraction: Cut-off as a fraction of the Nyquist frequency.
        order: Order of one pass.

    Raises:
        DataError: There are too few samples for the filter's edges.
    """
    from scipy.signal import butter, sosfiltfilt

    needed = shortest_series(order)
    if len(values) < needed:
        raise DataError(
            f"{len(values)} samples are too few for a zero-phase filter of order {order}",
            hint=f"it needs {needed}; leave the series out or lower the order",
        )
    sections = butter(order, fraction, output="sos")
    filtered: FloatArray = sosfiltfilt(sections, values, axis=0, padlen=needed - 1)
    return filtered


def shortest_series(order: int) -> int:
    """Fewest samples that `zero_phase` of this order accepts."""
    return 3 * (order + 1) + 1
