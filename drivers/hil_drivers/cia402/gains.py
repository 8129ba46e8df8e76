"""Position control by the master in the modes CSV and CST.

In the mode CSP the drives receive positions and close the position loop themselves. In CSV and CST,
`velocities` and `torques` compare the present position of an axis with the set-point due at the
same time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hil.arms import ArmDescription
from hil_drivers.cia402.bus import Inputs
from hil_drivers.cia402.commissioning import Drive
from hil_drivers.cia402.profile import INT16, INT32, wrapped


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains of the master's position control, per axis.

    In CST the torque is the feed-forward torque + kp·e + kd·ė, with the position error e. In CSV
    the velocity is the velocity of the motion + kv·e.

    Attributes:
        kp: Torque per position error [‰ of rated torque per increment].
        kd: Torque per velocity error [‰ of rated torque per count of velocity].
        limit: Limit of the commanded torque [‰ of rated torque].
        kv: Velocity per position error [counts of velocity per increment].
    """

    kp: tuple[float, ...]
    kd: tuple[float, ...]
    limit: tuple[float, ...]
    kv: tuple[float, ...]


LOOP_RAD_S = 2.0 * math.pi * 4.0
"""Natural frequency of the position loop of a joint in CST [rad/s].

A command acts two cycles later. At 250 Hz the delay is about 10 ms, including the hold of the last
command. With a delay of 10 ms, a critically damped loop of 4 Hz has a phase margin of about 45°;
stiffer loops oscillate.
"""

INERTIA_SHARE = 0.1
"""Minimum assumed joint inertia, including the rotor, as a share of effort_max / qdd_max.

A joint with a larger inertia gets a softer loop, which oscillates a little; a joint with a smaller
inertia would be unstable.
"""

KV_PER_S = 8.0
"""Gain of the position control in CSV: velocity per position error [1/s]."""


def gains_of(
    given: Sequence[Mapping[str, Any]], drives: Sequence[Drive], arm: ArmDescription
) -> Gains:
    """Return the gains of the position control of all axes.

    Args:
        given: Values that the station sets for each axis: `stiffness_nm_rad`, `damping_nms_rad`.
        drives: Drives with the scaling and the torque limit of each axis.
        arm: Description of the joints, from which default gains and torque limits are computed.
    """
    kp, kd, limit, kv = [], [], [], []
    for axis, drive in enumerate(drives):
        profile = drive.profile
        stiffness, damping = _spring_and_damper(given[axis], arm, axis)
        kp.append(stiffness * profile.rad_per_increment / profile.nm_per_count)
        kd.append(damping * profile.rad_s_per_count / profile.nm_per_count)
        kv.append(KV_PER_S * profile.rad_per_increment / profile.rad_s_per_count)
        most_nm = [float(arm.effort_max[axis]), drive.max_torque_nm]
        counts = min(each for each in most_nm if not math.isnan(each)) / abs(profile.nm_per_count)
        limit.append(min(counts, float(INT16[1])))
    return Gains(tuple(kp), tuple(kd), tuple(limit), tuple(kv))


def _spring_and_damper(
    given: Mapping[str, Any], arm: ArmDescription, axis: int
) -> tuple[float, float]:
    """Return stiffness [N·m/rad] and damping [N·m·s/rad] of an axis.

    If the station contains only the stiffness, the damping is that of a critically damped loop.
    """
    inertia = INERTIA_SHARE * float(arm.effort_max[axis] / arm.qdd_max[axis])
    stiffness = float(given.get("stiffness_nm_rad", inertia * LOOP_RAD_S**2))
    damping = float(given.get("damping_nms_rad", 2.0 * math.sqrt(stiffness * inertia)))
    return stiffness, damping


def velocities(
    gains: Gains, velocity: Sequence[int], due: Sequence[int], inputs: Inputs
) -> list[int]:
    """Return the CSV target velocities: velocity of the motion plus position correction."""
    return [
        within(ahead + round(kv * wrapped(wanted - is_at)), INT32[1])
        for ahead, kv, wanted, is_at in zip(velocity, gains.kv, due, inputs.position, strict=True)
    ]


def torques(
    gains: Gains,
    torque: Sequence[int],
    position: Sequence[int],
    velocity: Sequence[int],
    inputs: Inputs,
) -> list[int]:
    """Return the CST target torques: feed-forward torque plus position and velocity correction."""
    return [
        within(
            round(
                torque[i]
                + gains.kp[i] * wrapped(position[i] - inputs.position[i])
                + gains.kd[i] * (velocity[i] - inputs.velocity[i])
            ),
            gains.limit[i],
        )
        for i in range(len(torque))
    ]


def within(value: int, limit: float) -> int:
    """Return a value that is limited to ±`limit`."""
    most = int(limit)
    return most if value > most else -most if value < -most else value
