"""Preflight: all checks before the robot moves, with all results reported together.

A check evaluates one `Situation` (plan, robot, newest state row and context) and returns a
`CheckResult`. All checks run even if one check fails, so that the operator sees all problems before
going to the robot. A failed check blocks the run unless the operator has waived the check by its
name. The checks in `NEVER_WAIVED` detect dangerous motions and cannot be waived. A check that
raises an exception counts as failed.

The built-in checks are defined in this module in the order in which they are reported. Checks of
plug-ins in the group `hil.checks` are reported after the built-in checks, and the checks that the
robot performs itself are reported last.
"""

from __future__ import annotations

import math
import shutil
import tempfile
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from hil.arms import arm_names, is_described, load_arm
from hil.core import HilError, PreflightFailed, SpecError, did_you_mean, plugins
from hil.engine.interlocks import free_bytes
from hil.excitation import Clearance
from hil.planning import Plan, collision_model, recording_bytes, why_plan_not_weighed
from hil.recording import RESERVE_BYTES
from hil.robot import Finding, HasChecks, Robot, Status
from hil.spec import StationRobot

TO_BEGIN_BYTES = 2 * RESERVE_BYTES
"""Free disk space needed to start a run [B]: the reserve of the run, and the same amount for the
first documents."""

OWN = "robot-"
"""Prefix of the names of the checks that the robot performs itself."""

Figure = float | str | None


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of one preflight check.

    Attributes:
        name: Name of the check, which is also used to waive the check.
        passed: Whether the robot is allowed to move according to the check.
        message: One sentence with the measured and allowed values.
        measured, limit: Value measured by the check, and allowed value, both in SI units.
        hint: Action that removes the cause of the failure.
        waived: Whether the operator accepted the failure by name before the run.
        waivable: Whether the failure can be waived at all.
    """

    name: str
    passed: bool
    message: str
    measured: Figure = None
    limit: Figure = None
    hint: str = ""
    waived: bool = False
    waivable: bool = True

    @property
    def blocks(self) -> bool:
        """Whether the result of the check prevents the robot from moving."""
        return not (self.passed or self.waived)

    def to_dict(self) -> dict[str, Any]:
        """Return the result of the check as JSON data."""

        def writable(figure: Figure) -> Figure:
            # JSON has no number for NaN and infinity.
            odd = isinstance(figure, float) and not math.isfinite(figure)
            return str(figure) if odd else figure

        return {
            "name": self.name,
            "passed": self.passed,
            "waived": self.waived,
            "message": self.message,
            "measured": writable(self.measured),
            "limit": writable(self.limit),
            "hint": self.hint,
        }


@dataclass(frozen=True, eq=False)
class Context:
    """Input of the preflight checks in addition to plan and robot.

    Attributes:
        folder: Existing folder into which the recording will be written.
        collision: Callback that returns the distances of the arm with the loads of the plan; None
            without a collision model of the arm.
        clearance_m: Required clearance [m].
        waivers: Names of the checks whose failure the operator accepts.
        now: Callback that returns the Unix time of this host [s].
        free_bytes: Callback that returns the free space of the file system of a folder [B].
    """

    folder: Path
    collision: Callable[[Plan], Clearance] | None = None
    clearance_m: float = 0.0
    waivers: tuple[str, ...] = ()
    now: Callable[[], float] = time.time
    free_bytes: Callable[[Path], int] = field(default=free_bytes)


@dataclass(frozen=True, eq=False)
class Situation:
    """Input of every preflight check: plan, robot, newest state row of the robot, and context."""

    plan: Plan
    robot: Robot
    state: np.void
    context: Context


class Check(Protocol):
    """Preflight check, built in or registered under `hil.checks`; its name is the registered name.

    A check can read the robot but must not move it. An exception raised by a check counts as a
    failure.
    """

    def __call__(self, situation: Situation) -> CheckResult:
        """Return the result of the check; a failed check raises no exception."""


def preflight_context(
    station_robot: StationRobot, folder: Path, *, waivers: Sequence[str] = ()
) -> Context:
    """Return the context of a run of `station_robot` whose recording is written to `folder`."""
    surroundings = station_robot.surroundings

    def collision(plan: Plan) -> Clearance:
        loads = [(load.payload, load.size_m) for load in plan.loads]
        return collision_model(load_arm(station_robot.model), surroundings, loads)

    return Context(
        folder=folder,
        collision=collision if is_described(station_robot.model) else None,
        clearance_m=surroundings.clearance_m,
        waivers=tuple(waivers),
    )


def require_room_to_begin(runs: Path) -> None:
    """Raise if the disk has too little space for the reserve and the first documents of a run.

    This function is called before the run directory exists. A later preflight check evaluates the
    disk space for the recording itself.

    Args:
        runs: Folder of all runs, which possibly does not exist yet.

    Raises:
        PreflightFailed: The disk has too little free space.
    """
    there = next(folder for folder in (runs, *runs.absolute().parents) if folder.is_dir())
    try:
        free = shutil.disk_usage(there).free
    except OSError:
        return  # creating the directory reports the same problem
    if free < TO_BEGIN_BYTES:
        raise PreflightFailed(
            f"disk: {free / 1e6:.1f} MB are free, but a run needs {TO_BEGIN_BYTES / 1e6:.1f} MB to "
            "begin",
            hint=f"free space on the disk of {there}, or record to a different disk: --runs DIR",
        )


def require_waivable(waivers: Collection[str]) -> None:
    """Raise if a waiver names a check that does not exist or that cannot be waived.

    Raises:
        SpecError: At least one waiver does not name a check that can be waived.
    """
    if refused := sorted(NEVER_WAIVED.intersection(waivers)):
        raise SpecError(
            f"the check {refused[0]!r} cannot be waived",
            hint="correct the problem that the check reports",
        )
    names = _names()
    unknown = [waiver for waiver in waivers if waiver not in names]
    if unknown:
        raise SpecError(
            "\n".join(f"the waiver {waiver!r} is not the name of a check" for waiver in unknown),
            hint=did_you_mean(unknown[0], names),
        )


def require_preflight(
    plan: Plan,
    robot: Robot,
    context: Context,
    keep: Callable[[str, dict[str, Any]], object] | None = None,
) -> list[CheckResult]:
    """Run all preflight checks and raise if a result blocks the run.

    Args:
        plan: Plan that will be executed.
        robot: Connected robot.
        context: Folder of the recording, collision model and waivers.
        keep: Callback `keep("preflight.json", document)` that stores the results of all checks
            before an error is raised.

    Raises:
        PreflightFailed: At least one check failed without a waiver; the message lists all such
            checks.
    """
    results = preflight(plan, robot, context)
    blocking = [result for result in results if result.blocks]
    if keep is not None:
        document = {
            "passed": not blocking,
            "waivers": list(context.waivers),
            "checks": [result.to_dict() for result in results],
        }
        keep("preflight.json", document)
    if blocking:
        lines = [f"{result.name}: {result.message}" for result in blocking]
        hints = [f"{result.name}: {result.hint}" for result in blocking if result.hint]
        raise PreflightFailed("\n".join(lines), hint="\n    ".join(hints))
    return results


def preflight(plan: Plan, robot: Robot, context: Context) -> list[CheckResult]:
    """Run the built-in checks, plug-in checks and checks of the robot; the robot does not move.

    Args:
        plan: Plan that will be executed.
        robot: Connected robot; one block of its state is read, and the first load of the plan is
            declared to the robot.
        context: Folder of the recording, collision model and waivers.

    Returns:
        One result per check, in the order of the report. A failed check is marked as waived if
        `context.waivers` contains its name and the check can be waived.

    Raises:
        SpecError: A waiver names a check that does not exist or that cannot be waived.
        RobotError: The state of the robot cannot be read.
    """
    names = _names()
    require_waivable(context.waivers)
    situation = Situation(plan, robot, robot.read()[-1], context)
    results = []
    for name in names:
        result = _run(name, situation)
        waived = not result.passed and name in context.waivers and result.waivable
        results.append(replace(result, waived=waived))
    # The checks of the robot run last, because they can use the declared load.
    return [*results, *own_checks(robot)]


def _names() -> list[str]:
    return [*BUILT_IN, *(name for name in plugins.names("hil.checks") if name not in BUILT_IN)]


def _run(name: str, situation: Situation) -> CheckResult:
    """Return the result of one check under its registered name.

    An exception raised by the check counts as a failure.
    """
    try:
        check: Check = BUILT_IN.get(name) or plugins.load("hil.checks", name)
        return replace(check(situation), name=name)
    except HilError as error:
        return CheckResult(name, False, error.message, hint=error.hint)
    except Exception as error:  # a plug-in can raise any exception, which counts as a failure
        reason = f"{type(error).__name__}: {error}"
        hint = "repair or uninstall the check, or waive it by name"
        return CheckResult(name, False, f"the check raised {reason}", hint=hint)


def own_checks(robot: Robot) -> list[CheckResult]:
    """Return the results of the checks of a robot that implements `hil.robot.HasChecks`."""
    if not isinstance(robot, HasChecks):
        return []
    try:
        findings = list(robot.checks())
    except HilError as error:
        findings = [Finding("checks", False, error.message, hint=error.hint)]
    except Exception as error:  # a driver can raise any exception, which counts as a failure
        reason = f"the robot's own checks raised {type(error).__name__}: {error}"
        findings = [Finding("checks", False, reason, hint="this is a bug in the driver")]
    return [
        CheckResult(f"{OWN}{each.name}", each.passed, each.message, each.measured, each.limit,
                    each.hint)
        for each in findings
    ]  # fmt: skip


# Built-in checks.


def _identity(situation: Situation) -> CheckResult:
    """Check that the robot model matches the plan and that the joint order is the same."""
    plan, robot = situation.plan, situation.robot
    model, joints = robot.identity.model, robot.capabilities.joint_names
    differs = {model, plan.robot_model} <= set(arm_names()) and model != plan.robot_model
    return CheckResult(
        "identity",
        not differs and joints == plan.joint_names,
        f"the robot is a {model} with the joints {', '.join(joints)}",
        measured=model,
        limit=plan.robot_model,
        hint=f"the plan is for a {plan.robot_model} with {', '.join(plan.joint_names)}",
    )


def _fault(situation: Situation) -> CheckResult:
    """Check that the controller reports no fault."""
    state = situation.state
    code, faulty = int(state["fault_code"]), bool(int(state["status"]) & Status.FAULT)
    return CheckResult(
        "fault",
        not faulty and code == 0,
        f"the controller reports fault code {code}, fault bit {'set' if faulty else 'clear'}",
        measured=float(code),
        limit=0.0,
        hint="read the fault on the controller, remove its cause and acknowledge it there",
    )


REST_RAD_S = 0.02


def _rest(situation: Situation) -> CheckResult:
    """Check that the arm does not move before the run."""
    speed = float(np.abs(situation.state["qd"]).max())
    return CheckResult(
        "rest",
        speed <= REST_RAD_S,
        f"the fastest joint moves at {speed:.4f} rad/s",
        measured=speed,
        limit=REST_RAD_S,
        hint="wait for standstill of the arm; no other program may command it",
    )


POSE_TOLERANCE_RAD = 0.01


def _pose(situation: Situation) -> CheckResult:
    """Check that the arm is at the start pose of the plan.

    From any other pose, the first motion would start with a jump of the set-point.
    """
    off = np.abs(situation.state["q"] - situation.plan.q_start)
    joint = situation.plan.joint_names[int(off.argmax())]
    return CheckResult(
        "pose",
        bool(off.max() <= POSE_TOLERANCE_RAD),
        f"{joint} is {off.max():.4f} rad away from the start of the plan",
        measured=float(off.max()),
        limit=POSE_TOLERANCE_RAD,
        hint="the robot was moved after planning: plan again from this pose",
    )


def _first_move(situation: Situation) -> CheckResult:
    """Check that the first motion is collision-free from the present pose of the arm."""
    context, first = situation.context, situation.plan.motions[0]
    if context.collision is None:
        return CheckResult(
            "first-move",
            False,
            "the first motion cannot be checked: this robot has no collision model",
            hint="move the arm to a clear pose with the teach pendant and plan again",
        )
    path = first.sample(situation.plan.rate_hz).q
    everything = np.vstack([situation.state["q"], first.q_start, path])
    distance = float(context.collision(situation.plan).clearance(everything).min())
    return CheckResult(
        "first-move",
        distance >= context.clearance_m,
        f"the first motion has a clearance of {1e3 * distance:.1f} mm",
        measured=distance,
        limit=context.clearance_m,
        hint="jog the robot to a pose with more clearance and plan again",
    )


LIMIT_TOLERANCE = 1e-9


def _limits(situation: Situation) -> CheckResult:
    """Check that no set-point exceeds the limits that the controller reports."""
    goes, allowed = situation.plan.extremes, situation.robot.limits
    margins = {
        "position [rad]": np.minimum(goes.q_min - allowed.q_min, allowed.q_max - goes.q_max),
        "velocity [rad/s]": allowed.qd_max - goes.qd_max,
        "acceleration [rad/s²]": allowed.qdd_max - goes.qdd_max,
    }
    what, worst = min(margins.items(), key=lambda item: float(item[1].min()))
    joints = situation.plan.joint_names
    each = ", ".join(
        f"{name} {margin.min():.4g} ({joints[int(margin.argmin())]})"
        for name, margin in margins.items()
    )
    return CheckResult(
        "limits",
        bool(worst.min() >= -LIMIT_TOLERANCE),
        f"smallest distance to the robot's limits: {each}",
        measured=f"{what} {worst.min():.4g}",
        limit=0.0,
        hint="plan again with lower excitation limits, or check the controller's safety settings",
    )


NO_GUESSES = ("q_limits", "q_min", "q_max", "qd_max", "qdd_max", "capsule")
"""Prefixes of the names of guessed values that cannot be waived, because every plan and
interlock uses these values."""


def _guessed(situation: Situation) -> CheckResult:
    """Check that no value of the arm description is guessed, unless the robot is a mock.

    Plans use the full range up to the limits in the arm description.
    """
    model, robot = situation.plan.robot_model, situation.robot
    guesses = load_arm(model).guessed if is_described(model) else ()
    kept = [word for word in guesses if word.casefold().startswith(NO_GUESSES)]
    words = ", ".join(guesses)
    never = f"; {', '.join(kept)} cannot be waived" if kept else ""
    mocked = robot.capabilities.clock == "virtual" or robot.identity.driver == "mock"
    message = f"guessed values of the arm: {words}" if words else "no value of the arm is guessed"
    return CheckResult(
        "guessed",
        mocked or not words,
        message + ("; allowed, because only a mock moves" if words and mocked else ""),
        measured=words,
        limit="",
        hint="enter the values of the manufacturer, and remove their names from `guessed` in "
        f"{model}{never}",
        waivable=not kept,
    )


def _load(situation: Situation) -> CheckResult:
    """Check that the heaviest load does not exceed the rated payload of the robot."""
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


def _payload(situation: Situation) -> CheckResult:
    """Check that the controller accepts the first load of the plan and reports equal values.

    A load that the operator mounts during the run is declared after mounting, not in preflight: a
    controller that compensates for a load that is not mounted yet would lift the arm.
    """
    # A resumed plan can begin with a different load than the first.
    begins = next((step.load for step in situation.plan if step.kind == "payload"), 0)
    first = situation.plan.loads[begins]
    if first.prompt:
        return CheckResult("payload", True, "declared and read back after the load is mounted")
    back = situation.robot.set_payload(first.payload)
    return CheckResult(
        "payload",
        first.payload.agrees_with(back),
        f"declared {first.payload}, the robot reads back {back}",
        measured=back.mass,
        limit=first.payload.mass,
        hint="check the payload settings of the controller",
    )


def _weighing(situation: Situation) -> CheckResult:
    """Return a passed check that reports whether the run will check the payloads.

    The payloads themselves are evaluated during the run. A waiver of this check applies to the
    evaluation of the payloads during the run (`hil.workflow`).
    """
    reason = why_plan_not_weighed(situation.plan, situation.robot.capabilities)
    poses = len({step.pose for step in situation.plan if step.kind == "weigh"})
    planned = f"payload check of each load at {poses} {'pose' if poses == 1 else 'poses'} first"
    return CheckResult("weighing", True, f"no payload check: {reason}" if reason else planned)


def _rate(situation: Situation) -> CheckResult:
    """Check that the set-points of the plan are sampled at the sampling rate of the robot."""
    plan_hz, robot_hz = situation.plan.rate_hz, situation.robot.capabilities.rate_hz
    return CheckResult(
        "rate",
        abs(plan_hz - robot_hz) <= 1e-6 * robot_hz,
        f"the plan is sampled at {plan_hz:g} Hz, the robot runs at {robot_hz:g} Hz",
        measured=plan_hz,
        limit=robot_hz,
        hint="leave out record.rate_hz and plan again",
    )


TEMPERATURE_RANGE_C = (-10.0, 80.0)


def _temperature(situation: Situation) -> CheckResult:
    """Check that joint temperatures, if the robot reports any, are plausible."""
    known = situation.state["temperature"][np.isfinite(situation.state["temperature"])]
    if not len(known):
        return CheckResult("temperature", True, "the robot reports no joint temperatures")
    low, high = TEMPERATURE_RANGE_C
    worst = float(known[np.abs(known - (low + high) / 2).argmax()])
    return CheckResult(
        "temperature",
        low <= worst <= high,
        f"joint temperatures are {known.min():.1f} to {known.max():.1f} °C",
        measured=worst,
        limit=high if worst > low else low,
        hint="let the arm cool down or warm up, or check the temperature sensors",
    )


CLOCK_TOLERANCE_S = 5.0
EARLIEST = datetime(2024, 1, 1, tzinfo=UTC).timestamp()
"""Unix time before which a host clock counts as invalid [s], for example after a failure of the
clock battery."""


def _clock(situation: Situation) -> CheckResult:
    """Check that the host time is plausible and agrees with the sample time stamps."""
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
        hint="set the clock of this host (timedatectl) and check that samples arrive",
    )


def _disk(situation: Situation) -> CheckResult:
    """Check that the free disk space is at least twice the expected size of the recording."""
    free = situation.context.free_bytes(situation.context.folder)
    needed = 2 * recording_bytes(situation.plan)
    return CheckResult(
        "disk",
        free >= needed,
        f"{free / 1e6:.0f} MB are free; twice the recording needs {needed / 1e6:.0f} MB",
        measured=float(free),
        limit=float(needed),
        hint=f"free space on the disk of {situation.context.folder}, or choose another: --runs DIR",
    )


def _folder(situation: Situation) -> CheckResult:
    """Check that the folder for the recording is writable."""
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
            hint="choose a different folder: --runs DIR",
        )
    return CheckResult("folder", True, f"{where} can be written to")


BUILT_IN: dict[str, Check] = {
    "identity": _identity,
    "fault": _fault,
    "rest": _rest,
    "pose": _pose,
    "first-move": _first_move,
    "limits": _limits,
    "guessed": _guessed,
    "load": _load,
    "payload": _payload,
    "weighing": _weighing,
    "rate": _rate,
    "temperature": _temperature,
    "clock": _clock,
    "disk": _disk,
    "folder": _folder,
}
"""Built-in checks in the order in which they run and are reported."""

NEVER_WAIVED = frozenset({"identity", "fault", "rest", "pose", "first-move", "limits"})
"""Names of checks that cannot be waived, because motion after the failure of such a check would
be dangerous."""
