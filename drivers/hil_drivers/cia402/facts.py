"""What is known of an arm on CiA 402 drives: from its description, then from the drives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.arms import load_arm
from hil.robot import Capabilities, Identity, Limits
from hil_drivers.cia402.drives import Commissioned
from hil_drivers.cia402.left_faults import LeftFault
from hil_drivers.cia402.options import Options

GAINS = "rated torque and current of the drives (6075h, 6076h) times gear, or the station's"


def capabilities_of(
    model: str, options: Options, drives: Commissioned | None = None
) -> Capabilities:
    """Names, rate and what `effort` is.

    Args:
        model: Built-in arm.
        options: Of the station.
        drives: Once they were asked: gains are then their own.
    """
    arm = load_arm(model)
    current = options.effort == "current"
    gains = tuple(arm.drive_gains.tolist()) if drives is None else drives.scaling.drive_gains
    source = arm.sources["drive_gains"] if drives is None else GAINS
    return Capabilities(
        joint_names=arm.joint_names,
        rate_hz=options.rate_hz,
        effort_kind="current" if current else "torque",
        drive_gains=gains if current else (),
        drive_gains_source=source if current else "",
        clock="wall",
    )


def limits_of(model: str, drives: Commissioned | None = None) -> Limits:
    """The maker's limits; of two, the stricter one, once the drives were asked for theirs."""
    arm = load_arm(model)
    q_min, q_max, effort = np.array(arm.q_min), np.array(arm.q_max), np.array(arm.effort_max)
    if drives is not None:  # what is NaN is not limited by them
        q_min, q_max = np.fmax(q_min, drives.q_min), np.fmin(q_max, drives.q_max)
        effort = np.fmin(effort, drives.max_torque)
    return Limits(
        q_min=q_min,
        q_max=q_max,
        qd_max=np.array(arm.qd_max),
        qdd_max=np.array(arm.qdd_max),
        effort_max=effort,
        payload_max_kg=arm.payload_max_kg,
    )


def identity_of(model: str, drives: Commissioned, were_reset: Sequence[LeftFault]) -> Identity:
    """Which arm this is: its drives, by their own words (1018h), with all that was read of them."""
    details = dict(drives.details)
    if were_reset:
        details["faults_reset"] = "; ".join(map(str, were_reset))

    def all_of(name: str) -> str:
        return " ".join(f"{drive.objects.get(name, 0):x}" for drive in drives.drives)

    return Identity(
        model=model,
        serial=all_of("serial"),
        firmware=all_of("revision"),
        driver="cia402",
        details=details,
    )
