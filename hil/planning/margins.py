"""Margins: how far a plan stays away from every limit, with an error where it does not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.arms import ArmDescription
from hil.core import PlanError
from hil.excitation import Workspace
from hil.planning.extremes import Extremes, extremes_of
from hil.planning.plan import LoadStep, Step
from hil.planning.quality import effort_margin

TOLERANCE = 1e-9
"""Set-points computed to bind at a limit may exceed it by rounding."""

MOST_PROBLEMS = 20


def margins_of(
    steps: Sequence[Step],
    loads: Sequence[LoadStep],
    arm: ArmDescription,
    gravity: tuple[float, float, float],
    workspace: Workspace,
) -> dict[str, float]:
    """The smallest margin of any joint at any set-point, all ≥ 0.

    ======================== ==========================================================
    position_rad             to the robot's position limits
    velocity_rad_s           to the spec's `max_velocity_deg_s` or the robot's limit
    acceleration_rad_s2      to the spec's `max_acceleration_deg_s2` or the robot's limit
    robot_velocity_rad_s     to the robot's velocity limits alone
    robot_acceleration_rad_s2  to the robot's acceleration limits alone
    effort_nm                to the robot's torque limits: nominal rigid body, no friction
    clearance_m              smallest distance to anything, itself and the payload included;
                             at least the station's `clearance_m`
    ======================== ==========================================================

    Raises:
        PlanError: A set-point is beyond a limit; the steps concerned are listed.
    """
    motions = [step.motion for step in steps if step.motion is not None]
    distances = workspace.clearances(motions)
    _require_clear(steps, distances, workspace.clearance_m)
    goes = extremes_of(motions, workspace.rate_hz)
    margins = _kinematic(goes, arm, workspace)
    payloads = [load.payload for load in loads]
    margins["effort_nm"] = effort_margin(arm, gravity, payloads, motions, workspace.rate_hz)
    _require_positive(margins)
    margins["clearance_m"] = float(distances.min())
    return {name: max(value, 0.0) for name, value in margins.items()}


def _kinematic(goes: Extremes, arm: ArmDescription, workspace: Workspace) -> dict[str, float]:
    velocity = float((arm.qd_max - goes.qd_max).min())
    acceleration = float((arm.qdd_max - goes.qdd_max).min())
    return {
        "position_rad": float(min((goes.q_min - arm.q_min).min(), (arm.q_max - goes.q_max).min())),
        "velocity_rad_s": min(velocity, workspace.velocity - float(goes.qd_max.max())),
        "acceleration_rad_s2": min(
            acceleration, workspace.acceleration - float(goes.qdd_max.max())
        ),
        "robot_velocity_rad_s": velocity,
        "robot_acceleration_rad_s2": acceleration,
    }


def _require_positive(margins: dict[str, float]) -> None:
    negative = [f"{name}: {value:.4g}" for name, value in margins.items() if value < -TOLERANCE]
    if negative:
        raise PlanError(
            "the motion is beyond its limits; margins below zero are\n" + "\n".join(negative),
            hint="lower excitation.max_velocity_deg_s and excitation.max_acceleration_deg_s2, "
            "or take a lighter load",
        )


def _require_clear(steps: Sequence[Step], distances: np.ndarray, clearance_m: float) -> None:
    moving = [step for step in steps if step.motion is not None]
    close = [
        f"step {step.index} ({step.kind}) comes within {1e3 * distance:.1f} mm of something, "
        f"{1e3 * clearance_m:.1f} mm are required"
        for step, distance in zip(moving, distances, strict=True)
        if distance < clearance_m
    ]
    if close:
        more = [f"… and {len(close) - MOST_PROBLEMS} more"] if len(close) > MOST_PROBLEMS else []
        raise PlanError(
            "\n".join(close[:MOST_PROBLEMS] + more),
            hint="see whether the station's surroundings are as described",
        )
