"""One stop: how hard, whether the arm obeys, and by when it has to stand."""

from __future__ import annotations

import numpy as np

from hil_drivers.ur.options import RAMP_SLACK_S, Options
from hil_drivers.ur.phases import still
from hil_drivers.ur.standing import STILL_RAD_S

RAMP_GRACE_S = 0.3
"""Device time to be seen standing after the time of a ramp [s]."""

HARDEST_M_S2 = 150.0
"""UR's own limit of a deceleration at the tool [m/s²]."""


class Ramp:
    """What is known of one stop from when it is asked for until the arm stands.

    Nobody can feed the watchdog while the controller executes a stop: `ur-rtde` keeps the command
    in the register that counts as food, and writing there would take it back. So a ramp has to
    be over before the watchdog bites. `options_of` sees to that for moves; how fast the tool goes
    is not known before, so leading is stopped harder where the time would not do.

    Args:
        row: The newest one.
        options: Of the arm.
        led: Whether the arm was led along, which ends by decelerating the tool, not the joints.

    Attributes:
        deceleration: To be asked for [rad/s² of the fastest joint; where led, m/s² of the tool].
        told: Whether the program has answered that the stop was made.
    """

    def __init__(self, row: np.void, options: Options, *, led: bool) -> None:
        fastest, tool = _fastest(row), _tool_speed(row)
        self.deceleration = options.stop_rad_s2
        ramp_s = fastest / options.stop_rad_s2
        if led:
            within_s = max(1.0 / options.watchdog_hz - RAMP_SLACK_S, RAMP_SLACK_S)
            self.deceleration = min(max(options.stop_m_s2, tool / within_s), HARDEST_M_S2)
            ramp_s = max(ramp_s, tool / self.deceleration)
        self._until = float(row["timestamp"]) + ramp_s + RAMP_GRACE_S
        self._most = fastest
        self.told = False

    def falls(self, row: np.void) -> bool:
        """Whether the controller commands less speed than before: it has begun to obey."""
        fastest = _fastest(row)
        self._most = max(self._most, fastest)
        return fastest < self._most - STILL_RAD_S

    def stands(self, row: np.void) -> bool:
        """Whether the arm has come to rest, rather than not having begun to move."""
        return self.told and still(row)

    def overdue(self, row: np.void) -> bool:
        """Whether the arm should stand by now, and does not; said once."""
        if float(row["timestamp"]) <= self._until:
            return False
        self._until = np.inf
        return not self.stands(row)


def _fastest(row: np.void) -> float:
    """Of the joints, as commanded [rad/s]."""
    return float(np.abs(row["target_qd"]).max())


def _tool_speed(row: np.void) -> float:
    """As commanded; the larger of its translation [m/s] and its turning [rad/s]."""
    if "target_TCP_speed" in (row.dtype.names or ()):
        twist = row["target_TCP_speed"]
        return float(max(np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])))
    # No tool turns faster than all joints together.
    return float(np.abs(row["target_qd"]).sum())
