"""What a residual network reads of a recording: motion, the physical prediction, torque."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hil.core import DataError, FloatArray, IntArray
from hil.data import Dataset, motion_rates
from hil.networks.residual.settings import ResidualSettings

RATE_TOLERANCE = 0.05
"""Difference of sample rates, as a share, beyond which a network's memory means another time."""


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """Series of evenly spaced samples of n joints.

    Attributes:
        q, qd, qdd: (N, n) [rad, rad/s, rad/s²].
        base: (N, n) effort the physical model predicts.
        effort: (N, n) measured effort that may be heard, in the unit of `base`; None without.
        offsets: (S + 1,) row at which each series begins; the last entry is N.
        rate_hz: Samples per second of the series that move.
    """

    q: FloatArray
    qd: FloatArray
    qdd: FloatArray
    base: FloatArray
    effort: FloatArray | None
    offsets: IntArray
    rate_hz: float

    @staticmethod
    def of(dataset: Dataset, base: FloatArray, settings: ResidualSettings) -> Motions:
        """Of a dataset with filtered columns, no rows left out.

        A history of torque is taken as recorded: a filter without phase shift would bring what
        comes later into what has been. The paper's `measured` torque is the filtered one.

        Args:
            dataset: Prepared (`hil.data.filters.prepare`).
            base: (N, n) what the physical model predicts for its rows, in its unit of effort.
            settings: Which torque is heard.

        Raises:
            DataError: Nothing moves, or series are sampled at different rates.
        """
        effort = {"motion": None, "history": "effort", "measured": "effort_f"}[settings.inputs]
        return Motions(
            q=dataset["q_f"],
            qd=dataset["qd_f"],
            qdd=dataset["qdd_f"],
            base=base,
            effort=None if effort is None else dataset[effort],
            offsets=dataset.offsets,
            rate_hz=one_rate(dataset),
        )

    def __len__(self) -> int:
        return len(self.q)

    @property
    def n(self) -> int:
        """Number of joints."""
        return int(self.q.shape[1])

    def slices(self) -> Iterator[slice]:
        """The rows of each series that has any."""
        for start, stop in pairwise(self.offsets.tolist()):
            if stop > start:
                yield slice(start, stop)

    def heard(self, settings: ResidualSettings) -> FloatArray | None:
        """(N, n) torque as each row hears it, NaN where none has arrived; None: it hears none.

        A joint's own network hears what the physical model left then; one for all joints hears
        the torque.

        Raises:
            DataError: It should hear a torque, and there is none.
        """
        if settings.inputs == "motion":
            return None
        if self.effort is None:
            raise DataError(
                f"inputs: {settings.inputs} needs the measured torque, but none was given",
                hint="give recordings with an effort, or choose inputs: motion",
            )
        if settings.inputs == "measured":
            return self.effort
        source = self.effort - self.base if settings.layout == "grouped" else self.effort
        lag = settings.lag(self.rate_hz)
        out = np.full_like(source, np.nan)
        for rows in self.slices():
            if rows.stop - rows.start > lag:
                out[rows][lag:] = source[rows][:-lag]
        return out


def one_rate(dataset: Dataset) -> float:
    """Samples per second of the series that move; those at rest may have any rate.

    Raises:
        DataError: Nothing moves for at least two samples, or two series differ by more than 5 %.
    """
    rates = motion_rates(dataset)
    if not rates:
        raise DataError(
            "a residual network needs a motion of at least two samples, but there is none",
            hint="give trajectories",
        )
    (low, slow), (high, quick) = min(rates), max(rates)
    if high > (1.0 + RATE_TOLERANCE) * low:
        raise DataError(
            f"{slow} is sampled at {low:.4g} Hz and {quick} at {high:.4g} Hz, but the memory of "
            "a residual network counts samples",
            hint="use recordings of one rate",
        )
    return float(np.median([rate for rate, _ in rates]))
