"""What is known of a UR arm before anybody connects to it."""

from __future__ import annotations

import numpy as np

from hil.arms import load_arm
from hil.robot import Capabilities, Limits
from hil_drivers.ur.options import Options


def capabilities_of(model: str, options: Options) -> Capabilities:
    """Names, rate and what `effort` is."""
    arm = load_arm(model)
    current = options.torque_source == "current"
    return Capabilities(
        joint_names=arm.joint_names,
        rate_hz=options.frequency_hz or arm.rate_hz,
        effort_kind="current" if current else "torque",
        drive_gains=tuple(arm.drive_gains.tolist()) if current else (),
        drive_gains_source=arm.sources.get("drive_gains", "") if current else "",
        clock="wall",
    )


def limits_of(model: str, options: Options) -> Limits:
    """The maker's limits, narrowed by the share of the speed that may be used."""
    arm = load_arm(model)
    return Limits(
        q_min=np.array(arm.q_min),
        q_max=np.array(arm.q_max),
        qd_max=np.array(arm.qd_max) * options.speed_share,
        qdd_max=np.array(arm.qdd_max),
        effort_max=np.array(arm.effort_max),
        payload_max_kg=arm.payload_max_kg,
    )
