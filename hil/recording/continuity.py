"""Is the recording without holes? Judged by the device clock, counted while recording."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hil.core import FloatArray, StructArray

_GAP_PERIODS = 1.5
_DUPLICATE_PERIODS = 0.1


@dataclass(frozen=True, slots=True)
class Counts:
    """What one topic's samples looked like, with T = 1/rate.

    Attributes:
        samples: Rows recorded.
        gaps: Device time advanced by more than 1.5 T: at least one sample is missing.
        missing: Samples that the gaps swallowed, rounded.
        duplicates: Device time advanced by less than 0.1 T, stood still or went back.
        overruns: Nothing is missing, but the host received the sample more than 1.5 T after
            the one before: the loop that reads could not keep up.
        first_time: Device time of the first sample [s], NaN before it.
        last_time: Device time of the last sample [s].
        last_host_time: Host time of the last sample [s].
    """

    samples: int = 0
    gaps: int = 0
    missing: int = 0
    duplicates: int = 0
    overruns: int = 0
    first_time: float = float("nan")
    last_time: float = float("nan")
    last_host_time: float = float("nan")

    def after(self, rows: StructArray, rate_hz: float) -> Counts:
        """The counts once `rows` (any record with `device_time`, `host_time`) have come in."""
        if not len(rows):
            return self
        device, host = rows["device_time"], rows["host_time"]
        steps = _steps(self.last_time, device) * rate_hz
        host_steps = _steps(self.last_host_time, host) * rate_hz
        gap = steps > _GAP_PERIODS
        return replace(
            self,
            samples=self.samples + len(rows),
            gaps=self.gaps + int(gap.sum()),
            missing=self.missing + int(np.rint(steps[gap] - 1.0).sum()),
            duplicates=self.duplicates + int((steps < _DUPLICATE_PERIODS).sum()),
            overruns=self.overruns + int((~gap & (host_steps > _GAP_PERIODS)).sum()),
            first_time=float(device[0]) if self.samples == 0 else self.first_time,
            last_time=float(device[-1]),
            last_host_time=float(host[-1]),
        )


def _steps(last: float, times: FloatArray) -> FloatArray:
    """(N,) time since the sample before; NaN (which no comparison counts) for the very first."""
    return np.diff(times, prepend=last)
