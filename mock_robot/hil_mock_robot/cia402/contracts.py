"""What the parts of the mock drives are to each other."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from hil.core import FloatArray

Registers = dict[int, int]
"""Live objects of one drive by `key(index, sub)`: raw integers as on the wire, signed where so."""

STEP_S = 0.001
"""The drives' own position loop, and the step of everything [s]."""


def key(index: int, sub: int = 0) -> int:
    """Where an object is in `Registers`."""
    return index << 8 | sub


Send = Callable[[int, bytes], None]
"""Puts a frame (COB-ID, data) on the bus."""


class Demand(NamedTuple):
    """What one axis asks of its motor during a block of steps.

    Attributes:
        setpoints: (N, 3) position [rad], velocity [rad/s] and acceleration [rad/s²] of the joint.
        torque: Commanded joint torque [N·m] in place of following them; NaN to follow.
        braked: The holding brake is on: no current flows.
        offset: Joint torque [N·m] that the drive adds to what following them takes.
        limit: Most joint torque that the drive may give [N·m].
    """

    setpoints: FloatArray
    torque: float
    braked: bool
    offset: float = 0.0
    limit: float = math.inf


class Measured(NamedTuple):
    """What one axis measures at the end of a block.

    Attributes:
        q, qd: [rad], [rad/s], with the sensors' noise.
        torque: By the drive's own constants from the motor current [N·m at the joint].
        current: Motor current [A].
        celsius: Of the motor [°C].
        true_q, true_qd: Without noise, for those who judge.
        limited: The drive gives all the torque that it may.
    """

    q: float
    qd: float
    torque: float
    current: float
    celsius: float
    true_q: float
    true_qd: float
    limited: bool = False
