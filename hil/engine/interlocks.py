"""From what a spec says to interlocks that can judge this robot; what cannot be is refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from hil.core import BoolArray, PlanError, did_you_mean, plugins
from hil.engine.freshness import STALE_AFTER_S
from hil.engine.interlock_collection import Interlocks, Off
from hil.engine.interlock_context import Distances as Distances
from hil.engine.interlock_context import InterlockContext
from hil.engine.interlock_distance import LeastDistance
from hil.engine.interlock_protocol import Action as Action
from hil.engine.interlock_protocol import HasMargin as HasMargin
from hil.engine.interlock_protocol import Interlock as Interlock
from hil.engine.interlock_protocol import Margin as Margin
from hil.engine.interlock_protocol import Trip as Trip
from hil.engine.interlock_recording import Backlog, FreeSpace
from hil.engine.interlock_speed import SpeedScaling
from hil.engine.interlock_speed import is_slowed as is_slowed
from hil.engine.interlock_threshold import PerJoint, Threshold
from hil.spec import COOLER_C, INTERLOCK_KINDS

GROUP = "hil.interlocks"
MEMBERS = ("name", "action", "check", "clear")

OWN_LIMIT_SHARE = 0.95
"""Of the robot's own torque limits: drives that saturate at a limit never report more than it."""

DEGREES = 180 / np.pi

Limit = float | tuple[float, ...]


class Partly(NamedTuple):
    """An interlock that does not watch every joint, and why."""

    interlock: Interlock
    why: str


Build = Callable[[Any, InterlockContext], Interlock | str | Partly]
"""Makes an interlock from its entry in the spec, or says why it does not watch here."""


def interlocks_from_spec(
    specs: Sequence[Any], context: InterlockContext | None = None
) -> Interlocks:
    """The interlocks a spec asks for; nothing is started.

    A limit that the spec gives must be judgeable on this robot. One that it leaves to the robot or
    the station is not watched where they have none: see `Interlocks.off`.

    Args:
        specs: `ExperimentSpec.interlocks`.
        context: What is known of the run.

    Raises:
        PlanError: An interlock cannot be judged on this robot, or there is no such kind; all that
            is wrong is listed. An interlock nobody judges would be worse than none.
        PluginError: A plug-in does not load.
    """
    known = context or InterlockContext()
    watching: list[Interlock] = []
    off: list[Off] = []
    problems: list[str] = []
    for number, spec in enumerate(specs):
        if spec.kind == "stale":
            continue
        try:
            made = _made(spec, known)
        except PlanError as error:
            problems.append(f"interlocks.{number} ({spec.kind}): {error.message}")
            continue
        if isinstance(made, str):
            off.append(Off(spec.kind, made))
        elif isinstance(made, Partly):
            watching.append(made.interlock)
            off.append(Off(spec.kind, made.why))
        else:
            watching.append(made)
    if problems:
        raise PlanError("\n".join(problems), hint="change these entries of `interlocks`")
    stale = (spec.after_s for spec in specs if spec.kind == "stale")
    return Interlocks(watching, min(stale, default=STALE_AFTER_S), off)


def _made(spec: Any, context: InterlockContext) -> Interlock | str | Partly:
    if not getattr(spec, "enabled", True):
        return "switched off in the spec"
    return _BUILDERS.get(spec.kind, _plugged)(spec, context)


def _tracking_error(spec: Any, context: InterlockContext) -> Interlock:
    return Threshold(spec.kind, "q", _limit(spec.limit_rad, context), "rad", minus="q_target")


def _temperature(spec: Any, context: InterlockContext) -> Interlock:
    limit = _limit(spec.limit_c, context)
    resume = limit - COOLER_C if spec.resume_below_c is None else spec.resume_below_c
    # Not every arm measures temperatures; one that does not cannot be stopped by them.
    return Threshold(
        spec.kind, "temperature", limit, "°C", required=False, action=spec.action, resume=resume
    )


def _speed(spec: Any, context: InterlockContext) -> Interlock:
    return Threshold(spec.kind, "qd", _limit(spec.limit_deg_s, context) / DEGREES, "°/s", DEGREES)


def _current(spec: Any, context: InterlockContext) -> Interlock:
    if context.effort_kind != "current":
        raise PlanError("this robot measures torques: use kind: torque with limit_nm")
    return Threshold(spec.kind, "effort", _limit(spec.limit_a, context), "A")


def _torque(spec: Any, context: InterlockContext) -> Interlock | str | Partly:
    gains: PerJoint = 1.0
    if context.effort_kind == "current":
        if not context.drive_gains:
            why = "this robot measures currents, and its drive gains are not known"
            return _only_if_left_out(spec.limit_nm, f"{why}: use kind: current with limit_a")
        # An arm whose currents count the other way round has gains below zero.
        gains = np.abs(context.drive_gains)
    if spec.limit_nm is not None:
        limit = _limit(spec.limit_nm, context)
    elif context.effort_max:
        limit = OWN_LIMIT_SHARE * np.array(context.effort_max)
    else:
        return "the robot's own torque limits are not known"
    unknown = ~(_known(limit) & _known(gains))
    if not unknown.any():
        return Threshold(spec.kind, "effort", limit / gains, "N·m", gains)
    whose = _names(unknown, context)
    _only_if_left_out(spec.limit_nm, f"the drive gains are not known for {whose}")
    why = f"the robot's own torque limits or drive gains are not known for {whose}"
    if unknown.all():
        return why
    known_gains = np.where(unknown, 1.0, gains)
    limit = np.where(unknown, np.inf, limit)
    watching = Threshold(spec.kind, "effort", limit / known_gains, "N·m", known_gains)
    return Partly(watching, f"{why}; it watches the other joints")


def _workspace(spec: Any, context: InterlockContext) -> Interlock:
    if context.flange is None:
        raise PlanError("nobody can tell where the flange of this robot is")
    space = context.flange(spec)
    faces = len({name for _, name in space.names})
    return LeastDistance(spec.kind, space, 0.0, shown=f"{faces} faces")


def _clearance(spec: Any, context: InterlockContext) -> Interlock | str:
    if context.clearance is None:
        return _only_if_left_out(spec.least_m, "this robot has no collision bodies")
    least = 0.5 * context.clearance_m if spec.least_m is None else spec.least_m
    return LeastDistance(spec.kind, context.clearance, least)


def _recorder(spec: Any, context: InterlockContext) -> Interlock | str:
    if context.clock == "virtual":
        return "a virtual clock waits for it"
    if context.behind_s is None:
        return "nothing is recorded"
    return Backlog(context.behind_s, spec.behind_s, action=spec.action)


def _disk(spec: Any, context: InterlockContext) -> Interlock | str:
    if context.folder is None:
        return "nothing is recorded"
    return FreeSpace(context.folder, spec.free_mb, action=spec.action)


def _speed_scaling(spec: Any, context: InterlockContext) -> Interlock | str:
    if context.speed_scaling is None:
        return "the robot does not report it"
    return SpeedScaling(context.speed_scaling, action=spec.action)


def _plugged(spec: Any, context: InterlockContext) -> Interlock:
    known = plugins.names(GROUP)
    if spec.kind not in known:
        hint = did_you_mean(spec.kind, [*INTERLOCK_KINDS, *known])
        raise PlanError(f"there is no interlock of kind {spec.kind!r}; {hint}")
    plugin = plugins.load(GROUP, spec.kind)
    try:
        made = plugin(context, action=spec.action, **spec.parameters)
    except Exception as error:  # a plug-in may raise anything
        raise PlanError(f"it refuses what it was given: {type(error).__name__}: {error}") from error
    if lacking := [member for member in MEMBERS if not hasattr(made, member)]:
        raise PlanError(f"its plug-in is no interlock: it lacks {', '.join(lacking)}")
    interlock: Interlock = made
    return interlock


_BUILDERS: dict[str, Build] = {
    "tracking_error": _tracking_error,
    "temperature": _temperature,
    "speed": _speed,
    "current": _current,
    "torque": _torque,
    "workspace": _workspace,
    "clearance": _clearance,
    "recorder": _recorder,
    "disk": _disk,
    "speed_scaling": _speed_scaling,
}


def _limit(limit: Limit, context: InterlockContext) -> PerJoint:
    """One number, or (n,)."""
    if not isinstance(limit, tuple):
        return limit
    if context.joint_names and len(limit) != len(context.joint_names):
        raise PlanError(f"{len(limit)} limits for {len(context.joint_names)} joints")
    return np.array(limit)


def _known(values: PerJoint) -> BoolArray:
    """Where there is a number that a quantity can be compared with."""
    return np.isfinite(values) & np.greater(values, 0)


def _names(chosen: BoolArray, context: InterlockContext) -> str:
    names = context.joint_names or tuple(f"joint {i + 1}" for i in range(len(chosen)))
    return ", ".join(name for name, one in zip(names, chosen, strict=True) if one)


def _only_if_left_out(limit: object, why: str) -> str:
    """The reason not to watch, which is none for a limit that somebody wrote down."""
    if limit is not None:
        raise PlanError(why)
    return why
