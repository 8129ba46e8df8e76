"""Interlocks: conditions that must hold for every state sample of a run.

An interlock is asked about every block before the engine reads the next one (`hil.engine.reading`),
on the control thread. It therefore never waits, and it judges by level and not by edge: a violation
that goes on is reported again with every block. What it returns is a `Trip`; whether that stops
the robot or pauses the run at the next checkpoint is the interlock's `action`.

A quantity that an interlock needs and the robot does not deliver while it moves trips too: what
cannot be seen is not safe (temperatures excepted, which not every arm measures). For the same
reason `interlocks_from_spec` refuses a limit of the spec that cannot be judged on this robot.

The file goes from the protocol, which plug-ins implement as well, over the interlocks of a run and
how they are built from a spec, to the built-in kinds.
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
"""Default of the interlock `stale`: wall time without a newer sample [s]."""

Action = Literal["stop", "pause"]


@dataclass(frozen=True, slots=True)
class Trip:
    """Why motion was stopped.

    Attributes:
        interlock: Its name.
        joint: Index of the joint concerned, −1 when it is no joint's fault.
        value: What was found, NaN for what could not be measured.
        limit: What would have been allowed; both in `unit`.
        device_time: Of the sample [s].
        subject: What `value` is of, where it is not the joint's.
        least: Whether the value must be above the limit instead of below.
        lost: Whether what is not measured was measured before.
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
        """Return the trip in words."""
        what = self.subject or joint_names[self.joint]
        missing = "was measured, is not any more" if self.lost else "not measured"
        found = missing if math.isnan(self.value) else f"at {self.value:.4g} {self.unit}"
        bound = "at least" if self.least else "limit"
        return (
            f"interlock {self.interlock}: {what} {found}, {bound} {self.limit:.4g} {self.unit}, "
            f"device time {self.device_time:.3f} s"
        )

    def error(self, joint_names: Sequence[str]) -> InterlockTripped:
        """Return the trip as the error that ends the run."""
        return InterlockTripped(
            self.text(joint_names),
            hint="find the cause before running again; the data up to the trip is kept",
        )


@dataclass(frozen=True, slots=True)
class Margin:
    """How far a quantity is from its limit at one moment; for people, nothing is judged by it.

    Attributes:
        value, limit: In `unit`; of what is nearest to its limit.
        share: 1 where nothing is near, 0 at the limit and beyond.
        joint: Index of the joint concerned, −1 when it is no joint's.
        subject: What `value` is of, where it is not the joint's.
        least: Whether the value must be above the limit instead of below.
    """

    value: float
    limit: float
    unit: str
    share: float
    joint: int = -1
    subject: str = ""
    least: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return asdict(self)


class Interlock(Protocol):
    """One condition that must hold for every sample.

    A plug-in registered under `hil.interlocks` is called as `plugin(context, action=…, **own)`
    with the spec's other keys and returns one of these. What it raises ends the run.
    """

    @property
    def name(self) -> str:
        """Shown when it trips."""

    @property
    def action(self) -> Action:
        """What happens then; `pause` only where going on to the next checkpoint is safe."""

    def check(self, block: StructArray) -> Trip | None:
        """Return the first violation in the block, or None; asked for each block, must not wait."""

    def clear(self, block: StructArray) -> bool:
        """Return whether every row is well inside the limit again; asked while paused."""


@runtime_checkable
class HasMargin(Protocol):
    """An interlock that also knows how far its quantity is from its limit."""

    def margin(self, block: StructArray) -> Margin | None:
        """Return the margin of the last row of a block; None when nothing is known.

        Asked a few times a second on another thread than `check`, at the same time.
        """


class Distances(Protocol):
    """R distances that follow from the joint positions.

    `hil.dynamics.SampleDistances` and `hil.dynamics.FlangeSpace` are such.
    """

    @property
    def names(self) -> Sequence[tuple[str, str]]:
        """(R,) between which two things."""

    @property
    def reach(self) -> FloatArray:
        """(R, n) metres that each can change per radian of each joint, at most."""

    def distances(self, q: FloatArray) -> FloatArray:
        """Return (R, N) distances [m] at `q` (N, n)."""

    def copy_for_thread(self) -> Distances:
        """Return the same distances for another thread."""


@dataclass(frozen=True, slots=True, eq=False)
class InterlockContext:
    """What is known of one run; whatever is left out cannot be watched.

    Attributes:
        joint_names: Length n.
        effort_kind: What the robot measures, see `Capabilities`.
        drive_gains: Torque per current [N·m/A] per joint, empty when unknown.
        effort_max: The robot's own torque limits [N·m] per joint, empty when unknown.
        clearance: Distances of the arm with its loads to itself and everything around; None for
            an arm without collision bodies.
        clearance_m: Distance [m] that the plan keeps.
        flange: Returns the distances of flange and payload to the faces of a workspace; None where
            the position of the flange is not known.
        behind_s: How far writing is behind reading [s], for `check`; None if nothing is recorded.
        folder: The run directory, for `check`; None if nothing is recorded.
        speed_scaling: Executed over planned speed, the lowest of the newest block; None for a
            robot that does not report it.
        clock: `virtual` robots stand still while the recorder catches up.
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
    """An interlock of the spec that does not watch, and why."""

    name: str
    why: str


class Interlocks(Sequence[Interlock]):
    """The interlocks of a run; close them after it.

    Args:
        watching: In the order in which they are judged.
        stale_after_s: How long the robot's state may stand still [s]; the engine sees to that.
        off: What does not watch.
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
        """List what watches and what does not: `{name, action, limit}`, and `why` if it is off.

        A plug-in's limit is its `watches`, if it has one.
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
        """End what runs beside the control thread. Idempotent."""
        for interlock in self._watching:
            close = getattr(interlock, "close", None)
            if close is not None:
                close()


# From a spec to interlocks that can judge this robot.

GROUP = "hil.interlocks"
MEMBERS = ("name", "action", "check", "clear")

OWN_LIMIT_SHARE = 0.95
"""Of the robot's own torque limits: drives that saturate at a limit never report more than it."""

DEGREES = 180 / np.pi

PerJoint = float | FloatArray
"""One number for every joint, or (n,)."""


class Partly(NamedTuple):
    """An interlock that does not watch every joint, and why."""

    interlock: Interlock
    why: str


def interlocks_from_spec(
    specs: Sequence[Any], context: InterlockContext | None = None
) -> Interlocks:
    """Build the interlocks a spec asks for; nothing is started.

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
    context = context or InterlockContext()
    watching: list[Interlock] = []
    off: list[Off] = []
    problems: list[str] = []
    for number, spec in enumerate(specs):
        if spec.kind == "stale":  # judged by the engine itself, see `hil.engine.reading`
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
    names = context.joint_names or tuple(f"joint {i + 1}" for i in range(len(unknown)))
    whose = ", ".join(name for name, one in zip(names, unknown, strict=True) if one)
    _only_if_left_out(spec.limit_nm, f"the drive gains are not known for {whose}")
    why = f"the robot's own torque limits or drive gains are not known for {whose}"
    if unknown.all():
        return why
    known_gains = np.where(unknown, 1.0, gains)
    limit = np.where(unknown, np.inf, limit)
    watching = Threshold(spec.kind, "effort", limit / known_gains, "N·m", known_gains)
    return Partly(watching, f"{why}; it watches the other joints")


def _known(values: PerJoint) -> BoolArray:
    """Return where there is a number that a quantity can be compared with."""
    return np.isfinite(values) & np.greater(values, 0)


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
        built = plugin(context, action=spec.action, **spec.parameters)
    except Exception as error:  # a plug-in may raise anything
        raise PlanError(f"it refuses what it was given: {type(error).__name__}: {error}") from error
    if lacking := [member for member in MEMBERS if not hasattr(built, member)]:
        raise PlanError(f"its plug-in is no interlock: it lacks {', '.join(lacking)}")
    interlock: Interlock = built
    return interlock


Build = Callable[[Any, InterlockContext], Interlock | str | Partly]
"""Builds an interlock from its entry in the spec, or returns why it does not watch here."""

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


def _only_if_left_out(limit: object, why: str) -> str:
    """Return the reason not to watch; refuse it for a limit that the spec gives."""
    if limit is not None:
        raise PlanError(why)
    return why


# The built-in kinds.

CLEAR_SHARE = 0.9
"""A quantity below this share of its limit is well inside again."""

_ALL = np.array(True)


@dataclass(slots=True, eq=False)
class Threshold:
    """Trips when |value| of a joint exceeds `limit`, or is missing where it must not be.

    Attributes:
        name: Shown when it trips.
        field: Field of the state record; `minus` is subtracted from it when given.
        limit: In the unit of the record; one number, or (n,).
        unit, scale: For people: `limit * scale` is in `unit`.
        required: Whether NaN (not measured) trips while the arm moves. If not, it does so only
            for joints that were measured before.
        action: What a trip does.
        resume: Below this, in the unit of the record, the quantity is well inside again; by
            default 90 % of the limit.
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
        # Of which joints a value is to come: of all, or of those that one came of.
        self._expected = np.array(self.required)

    @property
    def watches(self) -> str:
        """The limit, for people; from the lowest to the highest where joints differ.

        A limit that is infinite is none.
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
        # One comparison settles the usual block. NaN is not within a limit, so that it goes on.
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
        """See `HasMargin.margin`: that of the joint which is nearest to its limit."""
        magnitude = self._magnitude(block[-1:])[0]
        limit, scale = (np.broadcast_to(x, magnitude.shape) for x in (self.limit, self.scale))
        used = np.where(np.isfinite(limit), magnitude / limit, np.nan)  # no limit: no margin
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
        """Return (N, n) what is NaN although a value is to come of that joint."""
        unknown = np.isnan(magnitude)
        expected = np.logical_or.accumulate(~unknown, axis=0) | self._expected
        self._expected = expected[-1]
        missing: BoolArray = unknown & expected
        return missing


CLEAR_BY_M = 0.005
"""Distances so much above the least are well inside again [m]."""

ROOMY_M = 0.1
"""With so much to spare a distance counts as not near its limit at all [m]."""


class LeastDistance:
    """Trips when any of several distances falls below a least one.

    Every sample is judged, few are computed. A joint that turns by Δq moves no point by more than
    its distance from the joint's axis times |Δq|, so between two positions a distance changes by
    at most Σ |Δq_j| · reach_j, whichever way the arm took. While that is less than what every
    distance had to spare at the last position computed, none needs computing.

    Args:
        name: Shown when it trips.
        measured: The distances, from measured joint positions.
        least_m: Least distance [m].
        shown: What is watched, for people; by default the least distance.

    Attributes:
        computed: Samples whose distances were computed so far.
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
        # `margin` is asked on another thread and needs distances of its own.
        self._measured, self._looked = measured, measured.copy_for_thread()
        self._least = least_m
        self._before: StructArray | None = None
        self._n = measured.reach.shape[1]
        # Nothing was computed yet: nothing is proven anywhere.
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
        """See `HasMargin.margin`: that of the pair with the least distance."""
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
        """Return the first row from `begin` that is not proven to be far enough; len(q) if none."""
        if begin == len(q):
            return begin
        spent = np.abs(q[begin:] - self._at) @ self._spent
        # NaN is not less.
        if spent.max() < 1.0:
            return len(q)
        return begin + int(np.logical_not(spent < 1.0).argmax())

    def _judged(self, block: StructArray, row: int) -> Trip | None:
        """Compute the distances of one row and judge them; they then prove what lies around it."""
        q = block["q"][row]
        if not np.isfinite(q).all():
            joint = int(np.argmin(np.isfinite(q)))
            moves = _moving(block, self._before)[row]
            return self._trip(block, row, float("nan"), joint=joint) if moves else None
        distances = self._measured.distances(q[None])[:, 0]
        self.computed += 1
        spare = distances - self._least
        if (spare > 0).all():
            # A joint spends of a pair's spare what it can reach; the pair it spends most of counts.
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
    """Return (N,) rows that say `MOVING`, or whose set-point is another one than a row earlier.

    What is not measured matters there. A driver that forgets `MOVING` must not keep an interlock
    from seeing that a sensor is dead.

    Args:
        block: State rows (N,).
        before: The block before it, None for the first one.
    """
    target = block["q_target"]
    first = target[:1] if before is None or not len(before) else before["q_target"][-1:]
    # A set-point that the robot does not report is NaN, and says nothing: NaN is not above 0.
    steps = np.abs(np.diff(target, axis=0, prepend=first))
    stepped = np.any(steps > 0, axis=1)
    moves: BoolArray = np.logical_or(stepped, block["status"] & Status.MOVING)
    return moves


class Backlog:
    """Trips when writing has fallen behind reading.

    Args:
        behind_s: How far, now [s]; cheap, and never waits.
        limit_s: How far it may be [s].
        action: What a trip does.
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
"""Between two looks at the disk [s]."""

NO_ANSWER_S = 10.0
"""A disk that has not answered for so long counts as broken [s]."""

CLEAR_FACTOR = 1.2
"""A disk with so many times the least space has enough again."""


def free_bytes(folder: Path) -> int:
    """Return the free space [B] where `folder` is, for the user of this process."""
    return shutil.disk_usage(folder).free


class FreeSpace:
    """Trips when a disk fills up, or does not answer.

    A thread of its own looks: asking a network disk that is gone takes for ever. It begins with
    the first check, which waits for its first answer: at that time the run is only being armed.

    Args:
        folder: Returns a folder on the disk.
        least_mb: Least free space [MB].
        action: What a trip does.
        free: Free space of a folder's disk [B]; may wait or raise `OSError`.
        now: Monotonic clock [s].
        poll_s: Between two looks [s].
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
        """End the thread; one that waits for a disk is left to it."""
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
"""Of the planned speed; a controller that reports less executes other motions than planned."""


def is_slowed(share: float) -> bool:
    """Return whether motions are slower than planned; what is not known (NaN) is not."""
    return share < LEAST_SPEED_SHARE


class SpeedScaling:
    """Trips when the robot's controller scales the speed of motions down.

    Args:
        share: Executed over planned speed, the lowest of the newest block; NaN when not known.
        action: What a trip does.
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
