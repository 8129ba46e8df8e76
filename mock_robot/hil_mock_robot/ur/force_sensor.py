"""The force and torque sensor in the flange of an e-Series arm: what it carries, what pushes it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hil_mock_robot.ur.chain import Posture
from hil_mock_robot.ur.poses import Triple, inverted, turned

if TYPE_CHECKING:
    from hil_mock_robot.ur.machine import Machine

DAMPING = 0.05
"""Keeps a push finite in a singularity, where the joints do not feel some of it."""


def raw_wrench(machine: Machine, posture: Posture, felt: Triple) -> list[float]:
    """(6,) force [N] and torque [N·m] on the flange, in its axes, about its origin.

    The weight and inertia of what really hangs there, as a point mass that does not turn, and the
    pushes of the side channel. Ideal: no noise, no offset, nothing taken off for what is declared.

    Args:
        machine: Whose arm.
        posture: Where its flange is.
        felt: Acceleration less gravity, in the axes of the flange [m/s²].
    """
    load = machine.body.mounted
    fx, fy, fz = (-load.mass * each for each in felt)
    x, y, z = load.com
    wrench = [fx, fy, fz, y * fz - z * fy, z * fx - x * fz, x * fy - y * fx]
    push = machine.body.pushed
    if not push.any():
        return wrench
    flange = posture.flange
    J = np.array(posture.jacobian((flange[9], flange[10], flange[11]))).reshape(6, 6)
    pushed = np.linalg.solve(J @ J.T + DAMPING**2 * np.eye(6), J @ push).tolist()
    back = inverted(flange)
    along = (*turned(back, *pushed[:3]), *turned(back, *pushed[3:]))
    return [a + b for a, b in zip(wrench, along, strict=True)]
