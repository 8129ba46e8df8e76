"""The slow and the fast part of a residual (PINN paper, eq. 24).

What is slow has the frequencies of the motion; what is fast comes from reversals. The parts are
labels to learn from: the filter may look ahead, since nothing that predicts ever runs it. But it
must not look at what is judged: it runs from the first row of a series that is learned from to the
last, and rows between them that are not are bridged by straight lines.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hil.core import BoolArray, DataError, FloatArray
from hil.networks.residual.motions import Motions

POWER_SHARE = 0.99
"""Of the joints' velocities that lies below the motion's highest frequency."""

ORDER = 2
"""Of the Butterworth filter, forwards and backwards."""

MOST_OF_NYQUIST = 0.8
"""A cut-off above leaves nothing that is fast."""


def motion_frequency(motions: Motions, learn: BoolArray) -> float:
    """The frequency [Hz] below which the motion's velocities have 99 % of their power.

    Every joint counts alike, however quick it is; series are weighted by their length. Only rows
    that are learned from (N,) have a say.

    Raises:
        DataError: Nothing moves.
    """
    bridged = _bridged(motions.qd, motions, learn)
    found = (_cumulative(bridged[rows]) for rows in _spans(motions, learn))
    shares = [share for share in found if share is not None]
    if not shares:
        raise DataError("no joint moves, so the motion has no frequency", hint="set f_cut_hz")
    longest = max(len(share) for share in shares)
    grid = np.linspace(0.0, 1.0, longest)  # of the Nyquist frequency
    lengths = np.array([len(share) for share in shares], dtype=np.float64)
    spread = [np.interp(grid, np.linspace(0, 1, len(s)), s) for s in shares]
    mean = np.average(spread, axis=0, weights=lengths)
    return float(0.5 * motions.rate_hz * grid[np.argmax(mean >= POWER_SHARE)])


def slow_and_fast(
    residual: FloatArray, motions: Motions, f_cut_hz: float, learn: BoolArray
) -> FloatArray:
    """(2, N, n): what a zero-phase low-pass filter lets through, and the rest; they add up.

    Args:
        residual: (N, n).
        motions: Says where series begin and how fast they were sampled.
        f_cut_hz: Cut-off [Hz].
        learn: (N,) rows to learn from: their parts depend on no other row. Parts of the others
            are good for nothing but their sum.
    """
    slow = np.array(residual, dtype=np.float64)
    fraction = f_cut_hz / (0.5 * motions.rate_hz)
    bridged = _bridged(residual, motions, learn)
    for rows in _spans(motions, learn):
        slow[rows] = _low_pass(bridged[rows], fraction)
    return np.stack([slow, residual - slow])


def _spans(motions: Motions, learn: BoolArray) -> Iterator[slice]:
    """From the first row to the last that is learned from, of each series that has any."""
    for rows in motions.slices():
        known = np.flatnonzero(learn[rows])
        if len(known):
            yield slice(rows.start + int(known[0]), rows.start + int(known[-1]) + 1)


def _bridged(values: FloatArray, motions: Motions, learn: BoolArray) -> FloatArray:
    """(N, n) with straight lines where rows within a span are not learned from."""
    out = np.array(values, dtype=np.float64)
    for rows in _spans(motions, learn):
        at = np.arange(rows.start, rows.stop)
        known = learn[rows]
        for j in range(values.shape[1]):
            out[rows, j] = np.interp(at, at[known], values[rows, j][known])
    return out


def _low_pass(values: FloatArray, fraction: float) -> FloatArray:
    from scipy.signal import butter, sosfiltfilt

    if fraction >= MOST_OF_NYQUIST:
        return values
    if len(values) < 2:
        return values
    # The ends are mirrored over a period of the cut-off: a shorter edge swings at slow cut-offs.
    edge = min(len(values) - 1, int(2.0 / fraction))
    filtered: FloatArray = sosfiltfilt(
        butter(ORDER, fraction, output="sos"), values, axis=0, padlen=edge
    )
    return filtered


def _cumulative(qd: FloatArray) -> FloatArray | None:
    """Share of power up to each frequency, mean over the joints that move; None if none does."""
    window = np.hanning(len(qd) + 2)[1:-1, None]
    power = np.abs(np.fft.rfft(window * (qd - qd.mean(axis=0)), axis=0)) ** 2
    total = power.sum(axis=0)
    moving = total > 1e-12 * max(float(total.max(initial=0.0)), 1e-300)
    if not np.any(moving) or float(total.max()) == 0.0:
        return None
    share: FloatArray = np.cumsum(power[:, moving] / total[moving], axis=0).mean(axis=1)
    return share
