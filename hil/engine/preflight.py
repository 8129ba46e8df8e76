"""All checks before motion, every result at once."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hil.arms import is_described, load_arm
from hil.core import HilError, PreflightFailed, SpecError, did_you_mean, plugins
from hil.engine import plan_checks, robot_checks
from hil.engine.preflight_check import Check, CheckResult, Context, Situation
from hil.excitation import Clearance
from hil.planning import Plan, collision_model
from hil.recording import BYTES as RESERVE_BYTES
from hil.robot import Robot
from hil.spec import StationRobot

BUILT_IN: dict[str, Check] = {
    "identity": robot_checks.identity,
    "fault": robot_checks.fault,
    "rest": robot_checks.rest,
    "pose": robot_checks.pose,
    "first-move": plan_checks.first_move,
    "limits": plan_checks.limits,
    "guessed": robot_checks.guessed,
    "load": plan_checks.load,
    "payload": robot_checks.payload,
    "weighing": plan_checks.weighing,
    "rate": plan_checks.rate,
    "temperature": robot_checks.temperature,
    "clock": plan_checks.clock,
    "disk": plan_checks.disk,
    "folder": plan_checks.folder,
}
"""In the order in which they are reported."""

NEVER_WAIVED = frozenset({"identity", "fault", "rest", "pose", "first-move", "limits"})
"""Checks whose failure means that motion would be dangerous whoever says otherwise."""

TO_BEGIN_BYTES = 2 * RESERVE_BYTES
"""Of the disk, for a run to begin: its reserve, and as much for the documents before motion."""


def preflight_context(
    station_robot: StationRobot, folder: Path, *, waivers: Sequence[str] = ()
) -> Context:
    """The context of a run of `station_robot` whose recording goes to `folder`."""
    surroundings = station_robot.surroundings

    def collision(plan: Plan) -> Clearance:
        loads = [(load.payload, load.size_m) for load in plan.loads]
        return collision_model(load_arm(station_robot.model), surroundings, loads)

    known = is_described(station_robot.model)
    return Context(
        folder=folder,
        collision=collision if known else None,
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
    results = [_run(name, situation) for name in names]
    # Last: a load has been declared by then, which the robot may have read back.
    return [*(_waived(each, context.waivers) for each in results), *robot_checks.own_checks(robot)]


def require_preflight(
    plan: Plan,
    robot: Robot,
    context: Context,
    keep: Callable[[str, dict[str, Any]], object] | None = None,
) -> list[CheckResult]:
    """`preflight`, and an error when something blocks.

    Args:
        plan: What is about to be executed.
        robot: Connected.
        context: Folder, collision model and waivers.
        keep: Called as `keep("preflight.json", document)` with all results before any error.

    Raises:
        PreflightFailed: At least one check failed and was not waived; all are in the message.
    """
    results = preflight(plan, robot, context)
    if keep is not None:
        keep("preflight.json", document_of(results, context))
    blocking = [result for result in results if result.blocks]
    if blocking:
        lines = [f"{result.name}: {result.message}" for result in blocking]
        hints = [f"{result.name}: {result.hint}" for result in blocking if result.hint]
        raise PreflightFailed("\n".join(lines), hint="\n    ".join(hints))
    return results


def document_of(results: Sequence[CheckResult], context: Context) -> dict[str, Any]:
    """What the run directory keeps as `preflight.json`."""
    return {
        "passed": not any(result.blocks for result in results),
        "waivers": list(context.waivers),
        "checks": [result.to_dict() for result in results],
    }


def _waived(result: CheckResult, waivers: Sequence[str]) -> CheckResult:
    """The result, its failure accepted where somebody has said so and may."""
    named = not result.passed and result.name in waivers
    return replace(result, waived=named and result.waivable)


def _run(name: str, situation: Situation) -> CheckResult:
    """One check's result under its registered name; a check that breaks has failed."""
    try:
        check: Check = BUILT_IN.get(name) or plugins.load("hil.checks", name)
        return replace(check(situation), name=name)
    except HilError as error:
        return CheckResult(name, False, error.message, hint=error.hint)
    except Exception as error:  # a plug-in may raise anything, and none of it means "go"
        told = f"{type(error).__name__}: {error}"
        hint = "mend or uninstall the check, or waive it by name"
        return CheckResult(name, False, f"the check itself broke: {told}", hint=hint)


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


def _names() -> list[str]:
    return [*BUILT_IN, *(name for name in plugins.names("hil.checks") if name not in BUILT_IN)]
