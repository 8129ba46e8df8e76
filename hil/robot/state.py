"""The base robot record: one numpy dtype from the driver to the disk and back.

Doubles come first and 32-bit integers last, so a row behind the 4-byte CDR header is a valid
ROS 2 message as it lies in memory (decision record 0002).
"""

from __future__ import annotations

from enum import IntFlag
from typing import Any

import numpy as np

from hil.core import StructArray

STATE_SCHEMA_VERSION = 1


class Status(IntFlag):
    """Bits of the `status` field."""

    MOVING = 1
    """The commanded motion of the segment is still running."""
    HOLDING = 2
    """The commanded position is constant."""
    FAULT = 4
    """The controller reports a fault; `fault_code` says which."""
    MASKED = 8
    """The sample must not be used for identification (set-point ignored, limit active)."""
    SLOWED = 16
    """The sample belongs to a measurement at another speed than planned; set by the engine."""


def state_dtype(n_joints: int) -> np.dtype[Any]:
    """The dtype of the base robot record for `n_joints` joints.

    Fields (SI units; NaN where the robot cannot provide a quantity):

    ========================= ========= ====================================================
    device_time               s         controller clock; gaps and duplicates are judged on it
    host_time                 s         Unix time of reception (virtual epoch on virtual clocks)
    q, qd                     rad(/s)   measured joint position and velocity, (n,)
    effort                    A or N·m  what the robot measures: see `Capabilities.effort_kind`
    temperature               °C        joint temperature, (n,)
    q_target … qdd_target     rad…      commanded position, velocity, acceleration, (n,)
    effort_target             A or N·m  the controller's own effort command, (n,)
    segment                   –         index of the plan step that was executing, −1 if none
    status, fault_code, mode  –         `Status` bits, driver's fault number, driver's mode
    ========================= ========= ====================================================
    """
    per_joint = (
        "q", "qd", "effort", "temperature",
        "q_target", "qd_target", "qdd_target", "effort_target",
    )  # fmt: skip
    fields: list[Any] = [("device_time", "<f8"), ("host_time", "<f8")]
    fields += [(name, "<f8", (n_joints,)) for name in per_joint]
    fields += [(name, "<i4") for name in ("segment", "status", "fault_code", "mode")]
    return np.dtype(fields)


def n_joints_of(block: StructArray) -> int:
    """Number of joints of a block of state rows."""
    return int(block.dtype["q"].shape[0])
