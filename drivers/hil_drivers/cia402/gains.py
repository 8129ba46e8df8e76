"""Gains with which the master leads joints in CST and CSV: a spring and a damper, in drive's units.

What is commanded now acts two cycles later: at 250 Hz about 10 ms with the hold of the last one. A
loop of 4 Hz, critically damped, then keeps a phase margin of some 45°; harder ones ring.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from hil.arms import ArmDescription
from hil_drivers.cia402.drives import Drive
from hil_drivers.cia402.player import Gains
from hil_drivers.cia402.profile import INT16

LOOP_RAD_S = 2.0 * math.pi * 4.0
"""Natural frequency of a joint that is led by torque [rad/s]."""

INERTIA_SHARE = 0.1
"""Least inertia of a joint, rotor included, in terms of effort_max / qdd_max of the arm: with more
of it the loop gets softer and rings a little, with less it would not be stable."""

KV_PER_S = 8.0
"""In CSV, velocity per error of position [1/s]."""


def gains_of(
    given: Sequence[Mapping[str, Any]], drives: Sequence[Drive], arm: ArmDescription
) -> Gains:
    """The gains of all axes.

    Args:
        given: What the station says of each axis: `stiffness_nm_rad`, `damping_nms_rad`.
        drives: Say what their numbers mean, and to what torque they limit themselves.
        arm: Says what the joints are like.
    """
    kp, kd, limit, kv = [], [], [], []
    for axis, drive in enumerate(drives):
        profile = drive.profile
        stiffness, damping = _joint(given[axis], arm, axis)
        kp.append(stiffness * profile.rad_per_increment / profile.nm_per_count)
        kd.append(damping * profile.rad_s_per_count / profile.nm_per_count)
        kv.append(KV_PER_S * profile.rad_per_increment / profile.rad_s_per_count)
        most_nm = [float(arm.effort_max[axis]), drive.max_torque_nm]
        counts = min(each for each in most_nm if not math.isnan(each)) / abs(profile.nm_per_count)
        limit.append(min(counts, float(INT16[1])))
    return Gains(tuple(kp), tuple(kd), tuple(limit), tuple(kv))


def _joint(given: Mapping[str, Any], arm: ArmDescription, axis: int) -> tuple[float, float]:
    """Spring [N·m/rad] and damper [N·m·s/rad]; the damper follows a spring that is given."""
    inertia = INERTIA_SHARE * float(arm.effort_max[axis] / arm.qdd_max[axis])
    stiffness = float(given.get("stiffness_nm_rad", inertia * LOOP_RAD_S**2))
    damping = float(given.get("damping_nms_rad", 2.0 * math.sqrt(stiffness * inertia)))
    return stiffness, damping
