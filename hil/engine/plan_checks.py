"""Checks of the plan against this robot and this host."""

from __future__ import annotations

import tempfile
from datetime import UTC, datetime

import numpy as np

from hil.core import FloatArray
from hil.engine.preflight_check import CheckResult, Situation
from hil.planning import recording_bytes, why_plan_not_weighed

LIMIT_TOLERANCE = 1e-9
CLOCK_TOLERANCE_S = 5.0
EARLIEST = datetime(2024, 1, 1, tzinfo=UTC).timestamp()
"""A host that believes to live before this has lost its clock's battery."""


def limits(situation: Situation) -> CheckResult:
    """No set-point is beyond what the controller itself reports as its limits."""
    goes, allowed = situation.plan.extremes, situation.robot.limits
    margins = {
        "position [rad]": np.minimum(goes.q_min - allowed.q_min, allowed.q_max - goes.q_max),
        "velocity [rad/s]": allowed.qd_max - goes.qd_max,
        "acceleration [rad/s²]": allowed.qdd_max - goes.qdd_max,
    }
    what, worst = min(margins.items(), key=lambda item: float(item[1].min()))
    told = ", ".join(_beyond(situation, name, margin) for name, margin in margins.items())
    return CheckResult(
        "limits",
        bool(worst.min() >= -LIMIT_TOLERANCE),
        f"smallest distance to the robot's limits: {told}",
        measured=f"{what} {worst.min():.4g}",
        limit=0.0,
        hint="plan again with lower excitation limits, or see the controller's safety settings",
    )


def load(situation: Situation) -> CheckResult:
    """The heaviest load is within the robot's rated payload."""
    heaviest = max(entry.payload.mass for entry in situation.plan.loads)
    rated = situation.robot.limits.payload_max_kg
    return CheckResult(
        "load",
        heaviest <= rated,
        f"the heaviest load is {heaviest:.3f} kg, the robot is rated for {rated:.3f} kg",
        measured=heaviest,
        limit=rated,
        hint="take a lighter load",
    )


def weighing(situation: Situation) -> CheckResult:
    """Says whether loads are going to be weighed; what comes of it is judged when they are.

    A waiver of this name is for that judgement (`hil.workflow.weighing`).
    """
    reason = why_plan_not_weighed(situation.plan, situation.robot.capabilities)
    poses = len({step.pose for step in situation.plan if step.kind == "weigh"})
    told = f"each load is weighed at {poses} {'pose' if poses == 1 else 'poses'} first"
    return CheckResult("weighing", True, f"no load is weighed: {reason}" if reason else told)


def first_move(situation: Situation) -> CheckResult:
    """The first motion is clear, from where the arm stands now."""
    context, first = situation.context, situation.plan.motions[0]
    if context.collision is None:
        return CheckResult(
            "first-move",
            False,
            "nobody knows whether the first motion is clear: this robot has no collision model",
            hint="bring the arm to a clear pose by hand (teach pendant) and plan again",
        )
    path = first.sample(situation.plan.rate_hz).q
    everything = np.vstack([situation.state["q"], first.q_start, path])
    distance = float(context.collision(situation.plan).clearance(everything).min())
    return CheckResult(
        "first-move",
        distance >= context.clearance_m,
        f"the first motion keeps {1e3 * distance:.1f} mm from everything",
        measured=distance,
        limit=context.clearance_m,
        hint="jog the robot to a pose with more room around it and plan again",
    )


def rate(situation: Situation) -> CheckResult:
    """Set-points are sampled at the rate the robot takes them."""
    plan_hz, robot_hz = situation.plan.rate_hz, situation.robot.capabilities.rate_hz
    return CheckResult(
        "rate",
        abs(plan_hz - robot_hz) <= 1e-6 * robot_hz,
        f"the plan is sampled at {plan_hz:g} Hz, the robot runs at {robot_hz:g} Hz",
        measured=plan_hz,
        limit=robot_hz,
        hint="leave out record.rate_hz and plan again",
    )


def disk(situation: Situation) -> CheckResult:
    """There is twice the space that the recording is expected to take."""
    free = situation.context.free_bytes(situation.context.folder)
    needed = 2 * recording_bytes(situation.plan)
    return CheckResult(
        "disk",
        free >= needed,
        f"{free / 1e6:.0f} MB are free, twice the recording is {needed / 1e6:.0f} MB",
        measured=float(free),
        limit=float(needed),
        hint=f"make room on the disk of {situation.context.folder}, or record elsewhere: --runs",
    )


def folder(situation: Situation) -> CheckResult:
    """A file can be written where the recording goes."""
    where = situation.context.folder
    try:
        with tempfile.TemporaryFile(dir=where) as file:
            file.write(b"hil")
            file.flush()
    except OSError as error:
        return CheckResult(
            "folder",
            False,
            f"{where} cannot be written to: {error.strerror or error}",
            hint="choose another folder: --runs",
        )
    return CheckResult("folder", True, f"{where} can be written to")


def clock(situation: Situation) -> CheckResult:
    """The host knows the time, and the robot's samples are stamped with it."""
    now, stamped = situation.context.now(), float(situation.state["host_time"])
    virtual = situation.robot.capabilities.clock == "virtual"
    off = 0.0 if virtual else abs(now - stamped)
    return CheckResult(
        "clock",
        now >= EARLIEST and off <= CLOCK_TOLERANCE_S,
        f"it is {datetime.fromtimestamp(now, UTC):%Y-%m-%d %H:%M} UTC on this host"
        + ("" if virtual else f", the newest sample is stamped {off:.1f} s off"),
        measured=off,
        limit=CLOCK_TOLERANCE_S,
        hint="set the clock of this host (timedatectl) and see whether samples still arrive",
    )


def _beyond(situation: Situation, name: str, margin: FloatArray) -> str:
    joint = situation.plan.joint_names[int(margin.argmin())]
    return f"{name} {margin.min():.4g} ({joint})"
