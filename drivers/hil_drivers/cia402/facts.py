"""What is known of an arm on CiA 402 drives: from its description, then from the drives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hil.arms import load_arm
from hil.robot import Capabilities, Limits
from hil.typing import FloatArray
from hil_drivers.cia402.options import Options
from hil_drivers.cia402.profile import AxisProfile

PER_MILLE = 1000.0


def capabilities_of(
    model: str, options: Options, profiles: Sequence[AxisProfile] = ()
) -> Capabilities:
    """Names, rate and what `effort` is.

    Args:
        model: Built-in arm.
        options: Of the station.
        profiles: Of the axes, once the drives were asked: gains are then their own.
    """
    arm = load_arm(model)
    current = options.effort == "current"
    gains = tuple(p.drive_gain for p in profiles) or tuple(arm.drive_gains.tolist())
    source = "rated torque and current of the drives (6075h, 6076h) times gear, or the station"
    return Capabilities(
        joint_names=arm.joint_names,
        rate_hz=options.rate_hz,
        effort_kind="current" if current else "torque",
        drive_gains=gains if current else (),
        drive_gains_source=(source if profiles else arm.sources["drive_gains"]) if current else "",
        clock="wall",
    )


def limits_of(model: str) -> Limits:
    """The maker's limits."""
    arm = load_arm(model)
    return Limits(
        q_min=np.array(arm.q_min),
        q_max=np.array(arm.q_max),
        qd_max=np.array(arm.qd_max),
        qdd_max=np.array(arm.qdd_max),
        effort_max=np.array(arm.effort_max),
        payload_max_kg=arm.payload_max_kg,
    )


def narrowed(
    limits: Limits, q_min: FloatArray, q_max: FloatArray, max_torque: FloatArray
) -> Limits:
    """The stricter ones of the maker's and the drives' limits.

    Args:
        limits: The maker's.
        q_min: (n,) software position limits of the drives (607Dh) [rad]; NaN where off.
        q_max: The same for the other end.
        max_torque: (n,) torque limits of the drives (6072h) at the joint [N·m]; NaN if unknown.
    """
    return replace(
        limits,
        q_min=np.fmax(limits.q_min, q_min),
        q_max=np.fmin(limits.q_max, q_max),
        effort_max=np.fmin(limits.effort_max, max_torque),
    )
