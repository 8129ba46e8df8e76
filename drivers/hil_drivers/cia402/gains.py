"""Position control by the master: what it commands in CSV and CST.

In CSP the drives close the position loop and get positions. In the other modes `velocities` and
`torques` compare what an axis shows now with the set-point that it should show by now.
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
    """Position control by the master, per axis.

    In CST torque = feed-forward + kp·e + kd·ė, in CSV velocity = the motion's + kv·e.

    Attributes:
        kp: ‰ of rated torque per increment of position.
        kd: ‰ of rated torque per count of velocity.
        limit: Largest torque commanded [‰].
        kv: Counts of velocity per increment of position.
    """

    kp: tuple[float, ...]
    kd: tuple[float, ...]
    limit: tuple[float, ...]
    kv: tuple[float, ...]


LOOP_RAD_S = 2.0 * math.pi * 4.0
"""Natural frequency of a joint that is led by torque [rad/s].

What is commanded now acts two cycles later: at 250 Hz about 10 ms with the hold of the last one. A
loop of 4 Hz, critically damped, then keeps a phase margin of some 45°; harder ones ring."""

INERTIA_SHARE = 0.1
"""Smallest inertia assumed of a joint, rotor included, as a share of effort_max / qdd_max.
A heavier joint gets a softer loop, which rings a little; a lighter one would be unstable."""

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
    """Return spring [N·m/rad] and damper [N·m·s/rad]; a given spring determines the damper."""
    inertia = INERTIA_SHARE * float(arm.effort_max[axis] / arm.qdd_max[axis])
    stiffness = float(given.get("stiffness_nm_rad", inertia * LOOP_RAD_S**2))
    damping = float(given.get("damping_nms_rad", 2.0 * math.sqrt(stiffness * inertia)))
    return stiffness, damping


def velocities(
    gains: Gains, velocity: Sequence[int], due: Sequence[int], inputs: Inputs
) -> list[int]:
    """Return velocities in CSV: the motion's, corrected towards the positions due by now."""
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
    """Return torques in CST: feed-forward, with spring and damper to the set-point due by now."""
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
    """Return a value, or the limit with its sign if it is larger."""
    most = int(limit)
    return most if value > most else -most if value < -most else value
