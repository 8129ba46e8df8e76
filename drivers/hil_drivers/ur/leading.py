"""Leading an arm along a segment by `servoj`: what to command at a tick, and when to give up."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray, RobotFault
from hil.robot import Segment
from hil_drivers.ur.feed import Feed
from hil_drivers.ur.lag import LagWatch
from hil_drivers.ur.options import Options


class Leading:
    """One segment being led along.

    Args:
        segment: Its set-points.
        rate_hz: Of set-points.
        begun: Device time at which it begins [s].
        options: How late, and how far beside the path, is too much.
    """

    def __init__(self, segment: Segment, rate_hz: float, begun: float, options: Options) -> None:
        self._feed = Feed(segment.q, rate_hz, begun)
        self._lag = LagWatch(options.lag_s, options.lag_rad)
        self._options = options

    @property
    def over(self) -> bool:
        """Whether the last set-point was commanded."""
        return self._feed.over

    def due(self, row: np.void) -> FloatArray:
        """(n,) what to command in answer to a state of the controller [rad].

        Raises:
            RobotFault: We are too late, or the arm does not follow.
        """
        now, options = float(row["timestamp"]), self._options
        q = self._feed.due(now)
        if self._feed.late_s > options.late_s:
            raise RobotFault(
                f"set-points were {self._feed.late_s:.3f} s late at device time {now:.3f} s, "
                f"{options.late_s:g} s are allowed",
                hint="give the computer less to do, or the arm's station a larger late_s",
            )
        self._lag.tell(now, q)
        if self._lag.lost(row["target_q"]):
            off = self._lag.off(row["target_q"])
            raise RobotFault(
                f"joint {int(off.argmax())} is led {off.max():.4f} rad beside the path at device "
                f"time {now:.3f} s, {options.lag_rad:g} rad are allowed",
                hint="is the speed slider at 100 %? else raise gain, or lag_s and lag_rad",
            )
        return q
