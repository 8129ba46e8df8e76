"""Preflight: every check before motion, all results at once.

A check looks at one `Situation` (plan, robot, newest state row, context) and answers with a
`CheckResult`. All checks run even if one fails, so that the operator sees everything that is wrong
before going to the robot. A failure blocks the run unless the operator has waived it by name; the
checks in `NEVER_WAIVED` find dangerous motions and cannot be waived. A check that breaks has
failed: nothing that goes wrong here means "go".

The built-in checks stand below in the order in which they are reported; plug-ins of the group
`hil.checks` follow them, and the checks that the robot makes of itself come last.
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
"""Of the disk, for a run to begin: its reserve, and as much for the documents before motion."""

OWN = "robot-"
"""Begins the names of checks that the robot itself has made."""

Figure = float | str | None


@dataclass(frozen=True, slots=True)
class CheckResult:
    """The answer of one check.

    Attributes:
        name: Of the check, as in `waivers`.
        passed: False when the robot should not move.
        message: One sentence with the figures in it.
        measured, limit: What was found and what would have been fine, in SI units.
        hint: What to do about a failure.
        waived: True when a failure was accepted by name before the run.
        waivable: False when this failure may not be accepted, whoever says otherwise.
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
        """True when this result keeps the robot from moving."""
        return not (self.passed or self.waived)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""

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
    """What checks need to know beside plan and robot.

    Attributes:
        folder: Where the recording will be written; it exists.
        collision: Returns the distances of the arm with the plan's loads; None without a model.
        clearance_m: Distance that must be kept.
        waivers: Names of checks whose failure is accepted.
        now: Unix time of this host [s].
        free_bytes: Free space of the file system a folder lies on.
    """

    folder: Path
    collision: Callable[[Plan], Clearance] | None = None
    clearance_m: float = 0.0
    waivers: tuple[str, ...] = ()
    now: Callable[[], float] = time.time
    free_bytes: Callable[[Path], int] = field(default=free_bytes)


@dataclass(frozen=True, eq=False)
class Situation:
    """What every check looks at: one plan, one robot, the robot's newest state row."""

    plan: Plan
    robot: Robot
    state: np.void
    context: Context


class Check(Protocol):
    """A check, built in or registered under `hil.checks`; its name is what it is registered as.

    It may read the robot but must not move it. What it raises counts as a failure.
    """

    def __call__(self, situation: Situation) -> CheckResult:
        """Look and answer; never raises for a mere failure."""


def preflight_context(
    station_robot: StationRobot, folder: Path, *, waivers: Sequence[str] = ()
) -> Context:
    """Return the context of a run of `station_robot` whose recording goes to `folder`."""
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
    """Raise if the disk has no room for what a run begins with: reserve and documents.

    For before the run has a directory; the recording's own size is checked with everything else.

    Args:
        runs: The folder of runs; it need not exist yet.

    Raises:
        PreflightFailed: There is too little.
    """
    there = next(folder for folder in (runs, *runs.absolute().parents) if folder.is_dir())
    try:
        free = shutil.disk_usage(there).free
    except OSError:
        return  # whatever is wrong: making the directory says it
    if free < TO_BEGIN_BYTES:
        raise PreflightFailed(
            f"disk: {free / 1e6:.1f} MB are free, but a run needs {TO_BEGIN_BYTES / 1e6:.1f} MB to "
            "begin",
            hint=f"make room on the disk of {there}, or record elsewhere: --runs",
        )


def require_waivable(waivers: Collection[str]) -> None:
    """Refuse waivers of checks that do not exist or are never waived.

    Raises:
        SpecError: With every one of them.
    """
    if refused := sorted(NEVER_WAIVED.intersection(waivers)):
        raise SpecError(
            f"the check {refused[0]!r} cannot be waived", hint="mend what it complains about"
        )
    names = _names()
    unknown = [waiver for waiver in waivers if waiver not in names]
    if unknown:
        raise SpecError(
            "\n".join(f"the waiver {waiver!r} names no check" for waiver in unknown),
            hint=did_you_mean(unknown[0], names),
        )


def require_preflight(
    plan: Plan,
    robot: Robot,
    context: Context,
    keep: Callable[[str, dict[str, Any]], object] | None = None,
) -> list[CheckResult]:
    """Run `preflight` and raise if something blocks.

    Args:
        plan: What is about to be executed.
        robot: Connected.
        context: Folder, collision model and waivers.
        keep: Called as `keep("preflight.json", document)` with all results before any error.

    Raises:
        PreflightFailed: At least one check failed and was not waived; all are in the message.
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
    """Run every check, built in, plugged in and the robot's own; the robot does not move.

    Args:
        plan: What is about to be executed.
        robot: Connected; one block of its state is read, and the first load is declared to it.
        context: Folder, collision model and waivers.

    Returns:
        One result per check, failed ones that `context.waivers` names and may marked as waived.

    Raises:
        SpecError: A waiver names a check that does not exist or cannot be waived.
        RobotError: The robot's state cannot be read.
    """
    names = _names()
    require_waivable(context.waivers)
    situation = Situation(plan, robot, robot.read()[-1], context)
    results = []
    for name in names:
        result = _run(name, situation)
        waived = not result.passed and name in context.waivers and result.waivable
        results.append(replace(result, waived=waived))
    # Last: a load has been declared by then, which the robot may have read back.
    return [*results, *own_checks(robot)]


def _names() -> list[str]:
    return [*BUILT_IN, *(name for name in plugins.names("hil.checks") if name not in BUILT_IN)]


def _run(name: str, situation: Situation) -> CheckResult:
    """Return one check's result under its registered name; a check that breaks has failed."""
    try:
        check: Check = BUILT_IN.get(name) or plugins.load("hil.checks", name)
        return replace(check(situation), name=name)
    except HilError as error:
        return CheckResult(name, False, error.message, hint=error.hint)
    except Exception as error:  # a plug-in may raise anything, and none of it means "go"
        reason = f"{type(error).__name__}: {error}"
        hint = "mend or uninstall the check, or waive it by name"
        return CheckResult(name, False, f"the check itself broke: {reason}", hint=hint)


def own_checks(robot: Robot) -> list[CheckResult]:
    """Return what a robot that opts into `hil.robot.HasChecks` has found out about itself."""
    if not isinstance(robot, HasChecks):
        return []
    try:
        findings = list(robot.checks())
    except HilError as error:
        findings = [Finding("checks", False, error.message, hint=error.hint)]
    except Exception as error:  # a driver may raise anything, and none of it means "go"
        reason = f"the robot's own checks broke: {type(error).__name__}: {error}"
        findings = [Finding("checks", False, reason, hint="this is a bug in the driver")]
    return [
        CheckResult(f"{OWN}{each.name}", each.passed, each.message, each.measured, each.limit,
                    each.hint)
        for each in findings
    ]  # fmt: skip


# The built-in checks.


def _identity(situation: Situation) -> CheckResult:
    """The robot is the arm the plan was made for, joints in the same order."""
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
    """The controller reports no fault."""
    state = situation.state
    code, faulty = int(state["fault_code"]), bool(int(state["status"]) & Status.FAULT)
    return CheckResult(
        "fault",
        not faulty and code == 0,
        f"the controller reports fault code {code}, fault bit {'set' if faulty else 'clear'}",
        measured=float(code),
        limit=0.0,
        hint="see the fault at the controller, remove its cause and acknowledge it there",
    )


REST_RAD_S = 0.02


def _rest(situation: Situation) -> CheckResult:
    """The arm does not move."""
    speed = float(np.abs(situation.state["qd"]).max())
    return CheckResult(
        "rest",
        speed <= REST_RAD_S,
        f"the fastest joint moves at {speed:.4f} rad/s",
        measured=speed,
        limit=REST_RAD_S,
        hint="wait until the arm has come to rest; nothing else may command it",
    )


POSE_TOLERANCE_RAD = 0.01


def _pose(situation: Situation) -> CheckResult:
    """The arm stands where the plan starts, else its first motion would jump."""
    off = np.abs(situation.state["q"] - situation.plan.q_start)
    joint = situation.plan.joint_names[int(off.argmax())]
    return CheckResult(
        "pose",
        bool(off.max() <= POSE_TOLERANCE_RAD),
        f"{joint} is {off.max():.4f} rad from where the plan starts",
        measured=float(off.max()),
        limit=POSE_TOLERANCE_RAD,
        hint="the robot was moved since the plan was made: plan again from here",
    )


def _first_move(situation: Situation) -> CheckResult:
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


LIMIT_TOLERANCE = 1e-9


def _limits(situation: Situation) -> CheckResult:
    """No set-point is beyond what the controller itself reports as its limits."""
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
        hint="plan again with lower excitation limits, or see the controller's safety settings",
    )


NO_GUESSES = ("q_limits", "q_min", "q_max", "qd_max", "qdd_max", "capsule")
"""Begin the words for what every plan and interlock rests on: no waiver is for guesses of them."""


def _guessed(situation: Situation) -> CheckResult:
    """Nothing about the arm is guessed, unless no real arm is moved: plans go up to its limits."""
    model, robot = situation.plan.robot_model, situation.robot
    guesses = load_arm(model).guessed if is_described(model) else ()
    kept = [word for word in guesses if word.casefold().startswith(NO_GUESSES)]
    words = ", ".join(guesses)
    never = f"; a waiver is not for {', '.join(kept)}" if kept else ""
    mocked = robot.capabilities.clock == "virtual" or robot.identity.driver == "mock"
    message = f"the description of the arm is guessed in {words}" if words else "nothing is guessed"
    return CheckResult(
        "guessed",
        mocked or not words,
        message + (", which moves a mock alone" if words and mocked else ""),
        measured=words,
        limit="",
        hint=f"put in what the maker says, and take it out of `guessed` in {model}{never}",
        waivable=not kept,
    )


def _load(situation: Situation) -> CheckResult:
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


def _payload(situation: Situation) -> CheckResult:
    """The controller takes the load the plan begins with and reads the same back.

    A load that the operator is yet to mount is declared when it is mounted, not before: a
    controller that compensates for a load that is not there lifts the arm.
    """
    # A resumed plan may begin with another load than the first.
    begins = next((step.load for step in situation.plan if step.kind == "payload"), 0)
    first = situation.plan.loads[begins]
    if first.prompt:
        return CheckResult("payload", True, "declared and read back once the load is mounted")
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
    """Whether loads are going to be weighed; always passes, the result is judged in the run.

    A waiver of this name is for that judgement (`hil.workflow`).
    """
    reason = why_plan_not_weighed(situation.plan, situation.robot.capabilities)
    poses = len({step.pose for step in situation.plan if step.kind == "weigh"})
    planned = f"each load is weighed at {poses} {'pose' if poses == 1 else 'poses'} first"
    return CheckResult("weighing", True, f"no load is weighed: {reason}" if reason else planned)


def _rate(situation: Situation) -> CheckResult:
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


TEMPERATURE_RANGE_C = (-10.0, 80.0)


def _temperature(situation: Situation) -> CheckResult:
    """Joint temperatures are believable; a robot that reports none passes."""
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
        hint="let the arm cool down or warm up, or see whether a sensor is broken",
    )


CLOCK_TOLERANCE_S = 5.0
EARLIEST = datetime(2024, 1, 1, tzinfo=UTC).timestamp()
"""A host that believes to live before this has lost its clock's battery."""


def _clock(situation: Situation) -> CheckResult:
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


def _disk(situation: Situation) -> CheckResult:
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


def _folder(situation: Situation) -> CheckResult:
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
"""In the order in which they are run and reported."""

NEVER_WAIVED = frozenset({"identity", "fault", "rest", "pose", "first-move", "limits"})
"""Checks whose failure means that motion would be dangerous whoever says otherwise."""
