"""Interlocks: conditions that every state sample of a run must satisfy.

Every interlock checks every block of rows on the control thread before the engine reads the next
block (`hil.engine.reading`). The check of an interlock must therefore never wait. Interlocks check
the level of a quantity, not its change: a persistent violation is reported again for every block.
An interlock reports a violation as an object of the class `Trip`. The attribute `action` of the
interlock determines whether a trip stops the robot or pauses the run at the next checkpoint.

An interlock also trips if the robot stops delivering a required quantity while it moves, because an
unmeasured quantity cannot be assumed safe (temperatures are excepted, because not every arm
measures them). Because an unmeasured quantity cannot be assumed safe, `interlocks_from_spec` also
rejects a limit of the spec that cannot be checked on this robot.

The file contains, in this order: the protocol of interlocks, which plug-ins also implement; the
interlocks of a run and their construction from a spec; the built-in kinds of interlocks.
"""

from __future__ import annotations

import dataclasses
import math
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, overload, runtime_checkable

import numpy as np

from hil.core import (
    BoolArray,
    FloatArray,
    InterlockTripped,
    PlanError,
    StructArray,
    did_you_mean,
    plugins,
)
from hil.robot import ClockKind, EffortKind, Status
from hil.spec import COOLER_C, INTERLOCK_KINDS, WorkspaceInterlock

STALE_AFTER_S = 0.5
"""Default limit of the interlock `stale`: maximum wall time without a newer sample [s]."""

Action = Literal["stop", "pause"]


@dataclass(frozen=True, slots=True)
class Trip:
    """Violation of one interlock by one sample.

    Attributes:
        interlock: Name of the interlock that was violated.
        joint: Index of the joint; −1 if the violation does not concern a single joint.
        value: Measured value of the monitored quantity in `unit`; NaN if the quantity was not
            measured.
        limit: Limit of the monitored quantity in `unit`.
        unit: Unit of `value` and `limit`.
        device_time: Device time of the sample that violates the limit [s].
        subject: Name of the monitored quantity if the quantity does not belong to a joint.
        least: Whether `limit` is a minimum instead of a maximum.
        lost: Whether the quantity was measured earlier in the run but is not measured now.
    """

    interlock: str
    joint: int
    value: float
    limit: float
    unit: str
    device_time: float
    subject: str = ""
    least: bool = False
    lost: bool = False

    def text(self, joint_names: Sequence[str]) -> str:
        """Return the violation as a readable sentence."""
        what = self.subject or joint_names[self.joint]
        missing = "is no longer measured" if self.lost else "is not measured"
        state = missing if math.isnan(self.value) else f"at {self.value:.4g} {self.unit}"
        bound = "at least" if self.least else "limit"
        return (
            f"interlock {self.interlock}: {what} {state}, {bound} {self.limit:.4g} {self.unit}, "
            f"device time {self.device_time:.3f} s"
        )

    def error(self, joint_names: Sequence[str]) -> InterlockTripped:
        """Return the violation as the error that ends the run."""
        return InterlockTripped(
            self.text(joint_names),
            hint="find the cause before running again; the data up to the trip is kept",
        )


@dataclass(frozen=True, slots=True)
class Margin:
    """Distance of a monitored quantity from its limit at one moment, used only for display.

    Attributes:
        value, limit: Measured value that is nearest to its limit, and this limit, both in `unit`.
        unit: Unit of `value` and `limit`.
        share: Remaining share of the distance to the limit: 1 far from the limit, 0 at the limit
            and beyond.
        joint: Index of the joint; −1 if the quantity does not belong to a joint.
        subject: Name of the quantity if the quantity does not belong to a joint.
        least: Whether `limit` is a minimum instead of a maximum.
    """

    value: float
    limit: float
    unit: str
    share: float
    joint: int = -1
    subject: str = ""
    least: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return the margin as JSON data."""
        return asdict(self)


class Interlock(Protocol):
    """Condition that every state sample of a run must satisfy.

    A plug-in registered under `hil.interlocks` is called as `plugin(context, action=…, **own)`,
    with the remaining keys of its spec entry as `own`, and returns an interlock. An exception
    raised by an interlock ends the run.
    """

    @property
    def name(self) -> str:
        """Name of the interlock in messages and events."""

    @property
    def action(self) -> Action:
        """Reaction to a violation, `stop` or `pause`; `pause` must be safe until the checkpoint.

        Until the next checkpoint, the motion continues after a violation with the action `pause`.
        """

    def check(self, block: StructArray) -> Trip | None:
        """Return the first violation of the limit in the block of rows, or None.

        The engine calls this method for each block, so that the method must never wait.
        """

    def clear(self, block: StructArray) -> bool:
        """Return whether all rows are well within the limit; called during a pause."""


@runtime_checkable
class HasMargin(Protocol):
    """Interlock that can also return the margin of its quantity."""

    def margin(self, block: StructArray) -> Margin | None:
        """Return the margin of the last row of a block; None if the margin is unknown.

        This method is called a few times per second on a different thread than `check`, possibly at
        the same time as `check`.
        """


class Distances(Protocol):
    """Set of R distances that are functions of the joint positions.

    The classes `hil.dynamics.SampleDistances` and `hil.dynamics.FlangeSpace` implement this
    protocol.
    """

    @property
    def names(self) -> Sequence[tuple[str, str]]:
        """Names of the two bodies of each of the R distances."""

    @property
    def reach(self) -> FloatArray:
        """(R, n) maximum change of each distance per rotation of each joint [m/rad]."""

    def distances(self, q: FloatArray) -> FloatArray:
        """Return the distances [m] at the joint positions `q` (N, n) as an array (R, N)."""

    def copy_for_thread(self) -> Distances:
        """Return a copy of the distance functions for use in a different thread."""


@dataclass(frozen=True, slots=True, eq=False)
class InterlockContext:
    """Properties of one run that interlocks need; properties that are left out cannot be monitored.

    Attributes:
        joint_names: Names of the n joints.
        effort_kind: Kind of the measured effort, see `Capabilities`.
        drive_gains: Drive gains, torque per current [N·m/A] per joint; empty if unknown.
        effort_max: Torque limits of the robot [N·m] per joint; empty if unknown.
        clearance: Distances of the arm with its loads to itself and to its surroundings; None for
            an arm without collision bodies.
        clearance_m: Minimum distance for which the plan was checked [m].
        flange: Callback that returns the distances of flange and payload to the faces of a
            workspace; None if the flange position is unknown.
        behind_s: Callback that returns by how much writing is behind reading [s], called in
            `check`; None without a recording.
        folder: Callback that returns the run directory, called in `check`; None without a
            recording.
        speed_scaling: Callback that returns the lowest ratio of executed to planned speed in the
            newest block; None if the robot does not report it.
        clock: Clock of the robot; a robot with a `virtual` clock pauses while the recorder catches
            up.
    """

    joint_names: tuple[str, ...] = ()
    effort_kind: EffortKind = "current"
    drive_gains: tuple[float, ...] = ()
    effort_max: tuple[float, ...] = ()
    clearance: Distances | None = None
    clearance_m: float = 0.0
    flange: Callable[[WorkspaceInterlock], Distances] | None = None
    behind_s: Callable[[], float] | None = None
    folder: Callable[[], Path] | None = None
    speed_scaling: Callable[[], float] | None = None
    clock: ClockKind = "wall"


class Off(NamedTuple):
    """Interlock that is inactive on this robot, with the reason for its inactivity."""

    name: str
    why: str


class Interlocks(Sequence[Interlock]):
    """Interlocks of a run; the caller closes them after the run.

    Args:
        watching: Active interlocks in the order in which the engine calls them.
        stale_after_s: Maximum time without a new robot state [s], which the engine itself checks.
        off: Inactive interlocks.
    """

    def __init__(
        self, watching: Sequence[Interlock], stale_after_s: float, off: Sequence[Off] = ()
    ) -> None:
        self._watching = tuple(watching)
        self.stale_after_s = stale_after_s
        self.off = tuple(off)

    @overload
    def __getitem__(self, index: int) -> Interlock: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Interlock, ...]: ...

    def __getitem__(self, index: int | slice) -> Interlock | tuple[Interlock, ...]:
        return self._watching[index]

    def __iter__(self) -> Iterator[Interlock]:
        return iter(self._watching)

    def __len__(self) -> int:
        return len(self._watching)

    def describe(self) -> list[dict[str, str]]:
        """List all interlocks as `{name, action, limit}`, with `why` for an inactive interlock.

        The listed limit of a plug-in is its attribute `watches`, if the plug-in has this attribute.
        """
        rows = [
            {"name": one.name, "action": one.action, "limit": str(getattr(one, "watches", ""))}
            for one in self._watching
        ]
        rows.append({"name": "stale", "action": "stop", "limit": f"{self.stale_after_s:g} s"})
        return rows + [
            {"name": off.name, "action": "off", "limit": "", "why": off.why} for off in self.off
        ]

    def close(self) -> None:
        """Stop the threads of all interlocks. Idempotent."""
        for interlock in self._watching:
            close = getattr(interlock, "close", None)
            if close is not None:
                close()


# Construction of interlocks from a spec.

GROUP = "hil.interlocks"
MEMBERS = ("name", "action", "check", "clear")

OWN_LIMIT_SHARE = 0.95
"""Share of the torque limits of the robot that is used as the limit of an interlock.

Drives that saturate at their torque limit never report a higher torque, so that an interlock at the
torque limit itself would never trip.
"""

DEGREES = 180 / np.pi

PerJoint = float | FloatArray
"""Limit of a quantity: one number for all joints, or an array (n,)."""


class Partly(NamedTuple):
    """Interlock that monitors only some joints, with the reason."""

    interlock: Interlock
    why: str


def interlocks_from_spec(
    specs: Sequence[Any], context: InterlockContext | None = None
) -> Interlocks:
    """Build the interlocks of a spec; no thread is started.

    Each limit that the spec contains must be checkable on this robot. If the spec leaves a limit to
    the robot or station and neither of them defines the limit, the interlock is inactive: see
    `Interlocks.off`.

    Args:
        specs: Entries of `ExperimentSpec.interlocks` in the spec.
        context: Known properties of the run that interlocks need.

    Raises:
        PlanError: An interlock cannot be checked on this robot, or the kind of an interlock does
            not exist. The message of the `PlanError` lists all problems. An interlock that is
            silently not checked is more dangerous than a missing interlock.
        PluginError: A plug-in interlock cannot be loaded.
    """
    context = context or InterlockContext()
    watching: list[Interlock] = []
    off: list[Off] = []
    problems: list[str] = []
    for number, spec in enumerate(specs):
        if spec.kind == "stale":  # checked by the engine itself, see `hil.engine.reading`
            continue
        if not getattr(spec, "enabled", True):
            off.append(Off(spec.kind, "switched off in the spec"))
            continue
        build = _BUILDERS.get(spec.kind, _plugged)
        try:
            built = build(spec, context)
        except PlanError as error:
            problems.append(f"interlocks.{number} ({spec.kind}): {error.message}")
            continue
        if isinstance(built, str):
            off.append(Off(spec.kind, built))
        elif isinstance(built, Partly):
            watching.append(built.interlock)
            off.append(Off(spec.kind, built.why))
        else:
            watching.append(built)
    if problems:
        raise PlanError("\n".join(problems), hint="change these entries of `interlocks`")
    stale = (spec.after_s for spec in specs if spec.kind == "stale")
    return Interlocks(watching, min(stale, default=STALE_AFTER_S), off)


def _tracking_error(spec: Any, context: InterlockContext) -> Interlock:
    return Threshold(spec.kind, "q", _limit(spec.limit_rad, context), "rad", minus="q_target")


def _temperature(spec: Any, context: InterlockContext) -> Interlock:
    limit = _limit(spec.limit_c, context)
    resume = limit - COOLER_C if spec.resume_below_c is None else spec.resume_below_c
    # Not every arm measures temperatures, so missing temperatures do not trip.
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
            return _reason_unless_specified(spec.limit_nm, f"{why}: use kind: current with limit_a")
        # Arms with inverted current direction have negative gains.
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
    names = context.joint_names or tuple(f"joint {i + 1}" for i in range(len(unknown)))
    whose = ", ".join(name for name, one in zip(names, unknown, strict=True) if one)
    _reason_unless_specified(spec.limit_nm, f"the drive gains are not known for {whose}")
    why = f"the robot's own torque limits or drive gains are not known for {whose}"
    if unknown.all():
        return why
    known_gains = np.where(unknown, 1.0, gains)
    limit = np.where(unknown, np.inf, limit)
    watching = Threshold(spec.kind, "effort", limit / known_gains, "N·m", known_gains)
    return Partly(watching, f"{why}; the interlock monitors the other joints only")


def _known(values: PerJoint) -> BoolArray:
    """Return a mask of the array elements that are finite numbers above 0."""
    return np.isfinite(values) & np.greater(values, 0)


def _workspace(spec: Any, context: InterlockContext) -> Interlock:
    if context.flange is None:
        raise PlanError("the kinematics of this robot are unknown")
    space = context.flange(spec)
    faces = len({name for _, name in space.names})
    return LeastDistance(spec.kind, space, 0.0, shown=f"{faces} faces")


def _clearance(spec: Any, context: InterlockContext) -> Interlock | str:
    if context.clearance is None:
        return _reason_unless_specified(spec.least_m, "this robot has no collision bodies")
    least = 0.5 * context.clearance_m if spec.least_m is None else spec.least_m
    return LeastDistance(spec.kind, context.clearance, least)


def _recorder(spec: Any, context: InterlockContext) -> Interlock | str:
    if context.clock == "virtual":
        return "not needed on a virtual clock"
    if context.behind_s is None:
        return "nothing is recorded"
    return Backlog(context.behind_s, spec.behind_s, action=spec.action)


def _disk(spec: Any, context: InterlockContext) -> Interlock | str:
    if context.folder is None:
        return "nothing is recorded"
    return FreeSpace(context.folder, spec.free_mb, action=spec.action)


def _speed_scaling(spec: Any, context: InterlockContext) -> Interlock | str:
    if context.speed_scaling is None:
        return "not reported by the robot"
    return SpeedScaling(context.speed_scaling, action=spec.action)


def _plugged(spec: Any, context: InterlockContext) -> Interlock:
    known = plugins.names(GROUP)
    if spec.kind not in known:
        hint = did_you_mean(spec.kind, [*INTERLOCK_KINDS, *known])
        raise PlanError(f"unknown interlock kind {spec.kind!r}; {hint}")
    plugin = plugins.load(GROUP, spec.kind)
    try:
        built = plugin(context, action=spec.action, **spec.parameters)
    except Exception as error:  # a plug-in can raise any exception
        raise PlanError(f"it rejects its parameters: {type(error).__name__}: {error}") from error
    if lacking := [member for member in MEMBERS if not hasattr(built, member)]:
        raise PlanError(f"its plug-in is not an interlock: it lacks {', '.join(lacking)}")
    interlock: Interlock = built
    return interlock


Build = Callable[[Any, InterlockContext], Interlock | str | Partly]
"""Function that builds an interlock from its spec entry, or returns the reason why the interlock
is inactive on this robot."""

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


def _limit(limit: float | tuple[float, ...], context: InterlockContext) -> PerJoint:
    if not isinstance(limit, tuple):
        return limit
    if context.joint_names and len(limit) != len(context.joint_names):
        raise PlanError(f"{len(limit)} limits for {len(context.joint_names)} joints")
    return np.array(limit)


def _reason_unless_specified(limit: object, why: str) -> str:
    """Return why an interlock is inactive, or raise `PlanError` if the spec has its limit."""
    if limit is not None:
        raise PlanError(why)
    return why


# Built-in kinds.

CLEAR_SHARE = 0.9
"""Share of the limit below which a quantity counts as well within its limit again."""

_ALL = np.array(True)


@dataclass(slots=True, eq=False)
class Threshold:
    """Interlock that trips if a joint quantity exceeds its limit or a value is missing.

    Attributes:
        name: Name of the interlock in messages.
        field: Field of the state record that is monitored; the field `minus` is subtracted if set.
        limit: Maximum absolute value in the unit of the state record; one number, or an array (n,).
        unit, scale: Unit for display; `limit * scale` is in `unit`.
        required: Whether a missing value (NaN) trips the interlock while the arm moves. If
            `required` is false, NaN trips the interlock only for joints that were measured earlier
            in the run.
        action: Reaction to a violation: `stop` or `pause`.
        resume: Value, in the unit of the state record, below which the quantity is well within the
            limit again; by default 90 % of the limit.
    """

    name: str
    field: str
    limit: PerJoint
    unit: str
    scale: PerJoint = 1.0
    minus: str = ""
    required: bool = True
    action: Action = "stop"
    resume: PerJoint | None = None
    _expected: BoolArray = dataclasses.field(init=False)
    _before: StructArray | None = dataclasses.field(default=None, init=False)

    def __post_init__(self) -> None:
        # Joints that must have a value: all joints, or the joints that had a value before.
        self._expected = np.array(self.required)

    @property
    def watches(self) -> str:
        """Limit as text for display, as a range if the joints have different limits.

        Infinite limits of joints are omitted from the displayed range.
        """
        limits = np.ravel(self.limit * np.asarray(self.scale))
        limits = limits[np.isfinite(limits)]
        shown = dict.fromkeys(f"{limit:.4g}" for limit in (limits.min(), limits.max()))
        return f"{' to '.join(shown)} {self.unit}"

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        if not len(block):
            return None
        before, self._before = self._before, block
        magnitude = self._magnitude(block)
        # One comparison is enough for a normal block. NaN fails the comparison.
        if (magnitude <= self.limit).all():
            self._expected = _ALL
            return None
        bad, missing = magnitude > self.limit, self._missing(magnitude)
        if missing.any():
            bad |= missing & _moving(block, before)[:, None]
        if not bad.any():
            return None
        row, joint = np.argwhere(bad)[0]
        limit, scale = (np.broadcast_to(x, magnitude.shape[1:]) for x in (self.limit, self.scale))
        return Trip(
            self.name,
            int(joint),
            float(magnitude[row, joint] * scale[joint]),
            float(limit[joint] * scale[joint]),
            self.unit,
            float(block["device_time"][row]),
            lost=bool(missing[row, joint]) and not self.required,
        )

    def clear(self, block: StructArray) -> bool:
        """See `Interlock.clear`."""
        resume = CLEAR_SHARE * self.limit if self.resume is None else self.resume
        magnitude = self._magnitude(block)
        return not ((magnitude > resume) | self._missing(magnitude)).any()

    def margin(self, block: StructArray) -> Margin | None:
        """Return the margin of the joint that is nearest to its limit; see `HasMargin.margin`."""
        magnitude = self._magnitude(block[-1:])[0]
        limit, scale = (np.broadcast_to(x, magnitude.shape) for x in (self.limit, self.scale))
        used = np.where(np.isfinite(limit), magnitude / limit, np.nan)  # no margin without a limit
        if np.isnan(used).all():
            return None
        joint = int(np.nanargmax(used))
        value, most = float(magnitude[joint] * scale[joint]), float(limit[joint] * scale[joint])
        share = max(0.0, 1.0 - float(used[joint]))
        return Margin(value, most, self.unit, share, joint)

    def _magnitude(self, block: StructArray) -> FloatArray:
        values: FloatArray = block[self.field]
        return np.abs(values - block[self.minus] if self.minus else values)

    def _missing(self, magnitude: FloatArray) -> BoolArray:
        """Return an (N, n) mask of NaN values of joints for which a measured value is expected."""
        unknown = np.isnan(magnitude)
        expected = np.logical_or.accumulate(~unknown, axis=0) | self._expected
        self._expected = expected[-1]
        missing: BoolArray = unknown & expected
        return missing


CLEAR_BY_M = 0.005
"""Margin above the minimum distance at which a distance counts as well within its limit again
[m]."""

ROOMY_M = 0.1
"""Margin above the minimum distance from which the display shows a distance as far from its
limit [m]."""


class LeastDistance:
    """Interlock that trips if any of several distances falls below a minimum distance.

    Every sample is checked, but the distances are computed for only a few samples. A joint rotation
    Δq moves a point of the arm by at most the distance of the point from the joint axis times |Δq|.
    Between two joint positions, a distance therefore changes by at most Σ |Δq_j| · reach_j, for any
    path between them. No distance needs to be computed while this bound is smaller than the margin
    of every distance at the last joint position for which the distances were computed.

    Args:
        name: Name of the interlock in messages.
        measured: Object that computes the distances from the measured joint positions.
        least_m: Least distance [m].
        shown: Description of the limit for display; by default the minimum distance.

    Attributes:
        computed: Number of samples for which the distances were computed so far.
    """

    def __init__(
        self,
        name: str,
        measured: Distances,
        least_m: float,
        *,
        shown: str = "",
    ) -> None:
        self.name = name
        self.action: Action = "stop"
        self.watches = shown or f"{1e3 * least_m:.4g} mm"
        self.computed = 0
        # `margin` is called on a different thread and needs its own copy.
        self._measured, self._looked = measured, measured.copy_for_thread()
        self._least = least_m
        self._before: StructArray | None = None
        self._n = measured.reach.shape[1]
        # No distances have been computed yet, so no position is proven to be safe.
        self._at, self._spent = np.zeros(self._n), np.full(self._n, np.nan)

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        q = block["q"]
        trip: Trip | None = None
        row = self._next_in_doubt(q, 0)
        while row < len(q) and (trip := self._judged(block, row)) is None:
            row = self._next_in_doubt(q, row + 1)
        self._before = block
        return trip

    def clear(self, block: StructArray) -> bool:
        """See `Interlock.clear`."""
        q = block["q"]
        known = bool(np.isfinite(q).all())
        return known and bool((self._measured.distances(q) >= self._least + CLEAR_BY_M).all())

    def margin(self, block: StructArray) -> Margin | None:
        """Return the margin of the pair with the smallest distance; see `HasMargin.margin`."""
        q = block["q"][-1:]
        if not np.isfinite(q).all():
            return None
        distances = self._looked.distances(q)[:, 0]
        pair = int(distances.argmin())
        share = float(np.clip((distances[pair] - self._least) / ROOMY_M, 0.0, 1.0))
        subject = " and ".join(self._measured.names[pair])
        value, least = 1e3 * float(distances[pair]), 1e3 * self._least
        return Margin(value, least, "mm", share, subject=subject, least=True)

    def _next_in_doubt(self, q: FloatArray, begin: int) -> int:
        """Return the index of the first row from `begin` that is not proven to be safe.

        The returned index is len(q) if all rows are proven to be safe.
        """
        if begin == len(q):
            return begin
        spent = np.abs(q[begin:] - self._at) @ self._spent
        # Comparisons with NaN are false.
        if spent.max() < 1.0:
            return len(q)
        return begin + int(np.logical_not(spent < 1.0).argmax())

    def _judged(self, block: StructArray, row: int) -> Trip | None:
        """Compute and check the distances of one row; update the bound of nearby rows."""
        q = block["q"][row]
        if not np.isfinite(q).all():
            joint = int(np.argmin(np.isfinite(q)))
            moves = _moving(block, self._before)[row]
            return self._trip(block, row, float("nan"), joint=joint) if moves else None
        distances = self._measured.distances(q[None])[:, 0]
        self.computed += 1
        spare = distances - self._least
        if (spare > 0).all():
            # Largest share of a margin that one radian of each joint can consume, over all pairs.
            self._at = q.copy()
            self._spent = (self._measured.reach / spare[:, None]).max(axis=0, initial=0.0)
            return None
        if (spare >= 0).all():
            return None
        pair = int(distances.argmin())
        subject = " and ".join(self._measured.names[pair])
        return self._trip(block, row, float(distances[pair]), subject=subject)

    def _trip(
        self, block: StructArray, row: int, value: float, *, joint: int = -1, subject: str = ""
    ) -> Trip:
        time_s = float(block["device_time"][row])
        return Trip(
            self.name, joint, 1e3 * value, 1e3 * self._least, "mm", time_s, subject, least=True
        )


def _moving(block: StructArray, before: StructArray | None) -> BoolArray:
    """Return an (N,) mask of rows with the bit `MOVING` or with a changed set-point.

    A missing measured value violates an interlock only in the rows of this mask. The set-point is
    compared in addition to the bit `MOVING`, because a driver that does not set `MOVING` must not
    hide a failed sensor from an interlock.

    Args:
        block: State rows (N,).
        before: The previous block of rows; None for the first block.
    """
    target = block["q_target"]
    first = target[:1] if before is None or not len(before) else before["q_target"][-1:]
    # A set-point that the robot does not report is NaN and counts as unchanged.
    steps = np.abs(np.diff(target, axis=0, prepend=first))
    stepped = np.any(steps > 0, axis=1)
    moves: BoolArray = np.logical_or(stepped, block["status"] & Status.MOVING)
    return moves


class Backlog:
    """Interlock that trips if writing the recording is too far behind reading the robot.

    Args:
        behind_s: Callback that returns the present delay of writing [s]; the callback must be fast
            and never wait.
        limit_s: Maximum allowed delay of writing [s].
        action: Reaction to a violation: `stop` or `pause`.
    """

    name = "recorder"

    def __init__(
        self, behind_s: Callable[[], float], limit_s: float, *, action: Action = "stop"
    ) -> None:
        self.action = action
        self.watches = f"{limit_s:g} s behind"
        self._behind_s = behind_s
        self._limit_s = limit_s

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        behind = self._behind_s()
        if behind <= self._limit_s:
            return None
        time_s = float(block["device_time"][-1])
        return Trip(self.name, -1, behind, self._limit_s, "s", time_s, "backlog of the recorder")

    def clear(self, block: StructArray) -> bool:
        """See `Interlock.clear`."""
        return self._behind_s() <= 0.5 * self._limit_s

    def margin(self, block: StructArray) -> Margin | None:
        """See `HasMargin.margin`."""
        behind, limit = self._behind_s(), self._limit_s
        return Margin(behind, limit, "s", max(0.0, 1 - behind / limit), subject="backlog")


POLL_S = 1.0
"""Time between two queries of the free space of a disk [s]."""

NO_ANSWER_S = 10.0
"""Time without an answer to a query of the free space after which a disk counts as failed [s]."""

CLEAR_FACTOR = 1.2
"""Multiple of the minimum free space above which a disk counts as having enough space again."""


def free_bytes(folder: Path) -> int:
    """Return the free space [B] of the disk of `folder` for the user of this process."""
    return shutil.disk_usage(folder).free


class FreeSpace:
    """Interlock that trips if a disk is nearly full or does not answer a query of its free space.

    A separate thread queries the disk, because a query of a disconnected network disk can block
    forever. The thread starts with the first call of `check`, which waits for the first answer; at
    this time the run is only being armed and the arm does not move.

    Args:
        folder: Callback that returns a folder on the monitored disk.
        least_mb: Minimum free space [MB].
        action: Reaction to a violation: `stop` or `pause`.
        free: Callback that returns the free space of the disk of a folder [B]; the callback can
            wait or raise `OSError`.
        now: Monotonic clock [s].
        poll_s: Time between two queries of the free space [s].
    """

    name = "disk"

    def __init__(
        self,
        folder: Callable[[], Path],
        least_mb: float,
        *,
        action: Action = "stop",
        free: Callable[[Path], int] = free_bytes,
        now: Callable[[], float] = time.monotonic,
        poll_s: float = POLL_S,
    ) -> None:
        self.action = action
        self.watches = f"{least_mb:g} MB free"
        self._folder = folder
        self._least_mb = least_mb
        self._free = free
        self._now = now
        self._poll_s = poll_s
        self._free_mb, self._answered = float("inf"), now()
        self._first, self._closing = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        if self._thread is None:
            self._begin()
        silent = self._now() - self._answered > NO_ANSWER_S
        if not silent and self._free_mb >= self._least_mb:
            return None
        found = float("nan") if silent else self._free_mb
        subject = f"free space for {self._folder()}"
        time_s = float(block["device_time"][-1])
        return Trip(self.name, -1, found, self._least_mb, "MB", time_s, subject, least=True)

    def clear(self, block: StructArray) -> bool:
        """See `Interlock.clear`."""
        return self.check(block) is None and self._free_mb >= CLEAR_FACTOR * self._least_mb

    def margin(self, block: StructArray) -> Margin | None:
        """See `HasMargin.margin`."""
        free, least = self._free_mb, self._least_mb
        if math.isinf(free):
            return None
        share = max(0.0, 1 - least / free) if free > 0 else 0.0
        return Margin(free, least, "MB", share, subject="free space", least=True)

    def close(self) -> None:
        """Stop the query thread without waiting for a disk that does not answer."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(self._poll_s)

    def _begin(self) -> None:
        self._answered, folder = self._now(), self._folder()
        self._thread = threading.Thread(
            target=self._look, args=(folder,), name="hil-free-space", daemon=True
        )
        self._thread.start()
        self._first.wait(self._poll_s)

    def _look(self, folder: Path) -> None:
        while not self._closing.is_set():
            try:
                self._free_mb = self._free(folder) / 1e6
                self._answered = self._now()
            except OSError:  # counts as no answer
                pass
            self._first.set()
            self._closing.wait(self._poll_s)


LEAST_SPEED_SHARE = 0.99
"""Minimum ratio of executed to planned speed.

A controller that reports a lower ratio executes different motions than the planned motions.
"""


def is_slowed(share: float) -> bool:
    """Return whether motions are slower than planned, from a ratio of executed to planned speed.

    An unknown ratio (NaN) counts as not slowed.
    """
    return share < LEAST_SPEED_SHARE


class SpeedScaling:
    """Interlock that trips if the controller of the robot reduces the speed of the motions.

    Args:
        share: Callback that returns the lowest ratio of executed to planned speed in the newest
            block; NaN if unknown.
        action: Reaction to a violation: `stop` or `pause`.
    """

    name = "speed_scaling"
    watches = f"at least {LEAST_SPEED_SHARE:.0%}"

    def __init__(self, share: Callable[[], float], *, action: Action = "pause") -> None:
        self.action = action
        self._share = share

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        share = self._share()
        if not is_slowed(share):
            return None
        return Trip(
            self.name,
            -1,
            100.0 * share,
            100.0 * LEAST_SPEED_SHARE,
            "%",
            float(block["device_time"][-1]),
            "the robot's speed scaling (speed slider)",
            least=True,
        )

    def clear(self, block: StructArray) -> bool:
        """See `Interlock.clear`."""
        return not is_slowed(self._share())
