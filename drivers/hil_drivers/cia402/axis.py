"""One CiA 402 axis as its master sees it: the state machine, the modes, and whether it obeys.

The state machine (`State`, `Goal`, controlwords) is a set of pure functions: what a drive is told
next follows from the statusword that it has just sent and from where it is to be brought. No state
is kept here that could differ from the drive's own, and all axes go through the states at once.
The controlword by state and goal, with the state that it leads to:

| drive's state          | goal: enabled                        | goal: off                     |
|------------------------|--------------------------------------|-------------------------------|
| not ready to switch on | 00h: stays, and goes on by itself    | 00h                           |
| switch on disabled     | 06h shutdown: ready                  | 00h: stays                    |
| ready to switch on     | 07h switch on: switched on           | 00h disable voltage: disabled |
| switched on            | 0Fh enable: operation enabled        | 06h shutdown: ready           |
| operation enabled      | 0Fh: stays                           | 07h switch on: switched on    |
| quick stop active      | 02h: brakes, then disabled by itself | 00h disable voltage: disabled |
| fault reaction active  | 00h: brakes, then fault by itself    | 00h                           |
| fault                  | 00h: stays                           | 00h: stays                    |
| none of CiA 402        | 02h quick stop                       | 00h disable voltage           |

The goal quick stop is 02h in every state. A fault is left by 80h after 00h, on request only: switch
on disabled.

Two watches compare what an axis does with what it was told, and say so in words: `Tracking` while
it is enabled, `BrakeWatch` while it stops. They find drives that are scaled wrongly, do not follow,
or do not brake. What follows from that, for all axes together, is decided by the `supervisor`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum

from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.bus import Inputs
from hil_drivers.cia402.mapping import LATENCY
from hil_drivers.cia402.profile import wrapped


class State(Enum):
    """State of a drive; the value is its name in messages."""

    NOT_READY = "not ready to switch on"
    DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "in no state of CiA 402"


class Goal(Enum):
    """Where a drive is to be brought."""

    OFF = "switch on disabled"
    ENABLED = "operation enabled"
    QUICK_STOP = "quick stop"


POWERED = frozenset({State.ENABLED, State.QUICK_STOP, State.FAULT_REACTION})
"""The motor carries current: the axis may move."""

FAULTY = (State.FAULT, State.FAULT_REACTION)

DISABLE_VOLTAGE, QUICK_STOP, SHUTDOWN, SWITCH_ON, ENABLE = 0x00, 0x02, 0x06, 0x07, 0x0F
FAULT_RESET = 0x80
"""Controlwords (6040h); bit 2 is active-low, bit 7 counts when it rises."""

WARNING, REMOTE, INTERNAL_LIMIT = 0x0080, 0x0200, 0x0800
FOLLOWS_COMMAND, FOLLOWING_ERROR = 0x1000, 0x2000
"""Bits of the statusword (6041h); the last two mean this in CSP, CSV and CST."""

_BY_4F = {
    0x00: State.NOT_READY,
    0x40: State.DISABLED,
    0x0F: State.FAULT_REACTION,
    0x08: State.FAULT,
}

_BY_6F = {
    0x21: State.READY,
    0x23: State.SWITCHED_ON,
    0x27: State.ENABLED,
    0x07: State.QUICK_STOP,
}


def state_of(statusword: int) -> State:
    """Return the state in a statusword (CiA 402, masks 4Fh and 6Fh)."""
    return _BY_4F.get(statusword & 0x4F) or _BY_6F.get(statusword & 0x6F, State.UNKNOWN)


_TOWARDS_ENABLED = {
    State.DISABLED: SHUTDOWN,
    State.READY: SWITCH_ON,
    State.SWITCHED_ON: ENABLE,
    State.ENABLED: ENABLE,
    State.QUICK_STOP: QUICK_STOP,
    State.UNKNOWN: QUICK_STOP,
}
"""An axis that brakes is let brake: it gets to `DISABLED` on its own (605Ah = 2)."""

_TOWARDS_OFF = {State.ENABLED: SWITCH_ON, State.SWITCHED_ON: SHUTDOWN}


def controlword_towards(state: State, goal: Goal) -> int:
    """The controlword for the next step from a state towards a goal.

    Never resets a fault: in `FAULT` it is disable voltage, whatever the goal.

    Args:
        state: By its newest statusword.
        goal: `OFF` is meant for an axis at rest: it goes down one step at a time, and takes the
            voltage from an axis that is in quick stop.
    """
    if goal is Goal.QUICK_STOP:
        return QUICK_STOP
    steps = _TOWARDS_ENABLED if goal is Goal.ENABLED else _TOWARDS_OFF
    return steps.get(state, DISABLE_VOLTAGE)


def controlword_resetting(state: State, last: int) -> int:
    """Return the controlword of a fault reset, for requests only: one rising edge of bit 7.

    Args:
        state: By its newest statusword; outside of `FAULT` the bit is cleared.
        last: The controlword sent before this one; disable voltage to begin with.
    """
    if state is State.FAULT and last in (DISABLE_VOLTAGE, FAULT_RESET):
        return FAULT_RESET
    return DISABLE_VOLTAGE


_SAID = {
    WARNING: "warning",
    INTERNAL_LIMIT: "internal limit active",
    FOLLOWING_ERROR: "following error",
}


def statusword_text(statusword: int) -> str:
    """A statusword in words, for messages."""
    texts = [text for bit, text in _SAID.items() if statusword & bit]
    if not statusword & REMOTE:
        texts.append("does not listen to the bus (bit 9)")
    return f"{', '.join([state_of(statusword).value, *texts])} (statusword {statusword:04X}h)"


def mode_text(mode: int) -> str:
    """A mode of operation for messages."""
    name = od.MODE_NAMES.get(mode)
    return f"{mode} ({name})" if name else str(mode)


IN_A_ROW = 3
"""Cycles that an axis has to be too far away: a single answer may be a drive's hiccup."""

VELOCITY_OVER_S = 0.04

LEAST_RAD_S, MOST_TIMES = 0.5, 5.0
"""Velocities contradict each other when they differ by more than the first and one is more than so
many times the other, or of other sign: a wrong unit is off by 17 and more."""


class Tracking:
    """Compares the answers of each cycle with the set-points.

    Args:
        period_s: Device time of a cycle [s].
        rad_per_increment: Per axis, of position, with its sign.
        bounds_deg: Mode of operation → how far an axis may be from its set-point [deg], and the
            option that says so.
        rad_s_per_count: Per axis, of velocity, with its sign; empty where it is not measured.
    """

    def __init__(
        self,
        period_s: float,
        rad_per_increment: Sequence[float],
        bounds_deg: Mapping[int, tuple[float, str]],
        rad_s_per_count: Sequence[float] = (),
    ) -> None:
        self._scale, self._unit, self._bounds_deg = rad_per_increment, rad_s_per_count, bounds_deg
        self._bounds = {
            mode: [math.radians(deg) / abs(rad) for rad in rad_per_increment]
            for mode, (deg, _) in bounds_deg.items()
        }
        self._cycles = max(2, round(VELOCITY_OVER_S / period_s))
        self._over_s = self._cycles * period_s
        self._told: deque[list[int]] = deque(maxlen=LATENCY + 1)
        self._from: list[int] | None = None
        self._sum: list[int] = []
        self.restart()

    def restart(self) -> None:
        """Forget earlier cycles: a phase begins."""
        n = len(self._scale)
        self._told.clear()
        self._away, self._contradicts = [0] * n, [0] * n
        self._begin_window(None)

    def judge(self, inputs: Inputs, targets: Sequence[int], mode: int) -> Iterator[tuple[int, str]]:
        """Yield axes that do not follow their set-points, each with the reason.

        Args:
            inputs: Of this cycle.
            targets: Positions that were sent in it.
            mode: That the axes are in.
        """
        self._told.append(list(targets))
        if len(self._told) > LATENCY and mode in self._bounds:
            yield from self._far_away(inputs, mode)
        if self._unit:
            yield from self._contradicting(inputs)

    def _far_away(self, inputs: Inputs, mode: int) -> Iterator[tuple[int, str]]:
        told, bounds = self._told[0], self._bounds[mode]
        for axis, position in enumerate(inputs.position):
            off = abs(wrapped(told[axis] - position))
            if off <= bounds[axis] or not inputs.fresh[axis]:
                self._away[axis] = 0
                continue
            self._away[axis] += 1
            if self._away[axis] >= IN_A_ROW:
                most, option = self._bounds_deg[mode]
                degrees = math.degrees(off * abs(self._scale[axis]))
                yield (
                    axis,
                    f"is {degrees:.1f}° from its set-point, {most:.3g}° are allowed ({option})",
                )

    def _contradicting(self, inputs: Inputs) -> Iterator[tuple[int, str]]:
        """Compare, once per window, the mean reported velocity with the distance travelled."""
        if self._from is None or not all(inputs.fresh):
            self._begin_window(inputs.position.copy() if all(inputs.fresh) else None)
            return
        self._seen += 1
        self._sum = [a + b for a, b in zip(self._sum, inputs.velocity, strict=True)]
        if self._seen < self._cycles:
            return
        for axis, start in enumerate(self._from):
            way = wrapped(inputs.position[axis] - start) * self._scale[axis]
            actual = way / self._over_s
            reported = self._sum[axis] / self._seen * self._unit[axis]
            self._contradicts[axis] = (
                self._contradicts[axis] + 1 if _absurd(reported, actual) else 0
            )
            if self._contradicts[axis] >= IN_A_ROW:
                yield (
                    axis,
                    f"says that it moves at {reported:.3g} rad/s (606Ch), by its positions it is "
                    f"{actual:.3g} rad/s: axes.velocity_unit is wrong, or polarity (607Eh)",
                )
        self._begin_window(inputs.position.copy())

    def _begin_window(self, position: list[int] | None) -> None:
        self._from, self._seen, self._sum = position, 0, [0] * len(self._scale)


def _absurd(reported: float, actual: float) -> bool:
    if abs(reported - actual) <= LEAST_RAD_S:
        return False
    small, large = sorted((abs(reported), abs(actual)))
    return large > MOST_TIMES * small or reported * actual < 0.0


LONGEST_RAMP_S = 0.5
"""How long a quick stop may take from the highest speed of a joint; more is refused."""

MOVES_AFTER_S = 0.2
"""An axis that still moves so long after its ramp does not brake [s]."""

OFF_AFTER_S = 1.0
"""An axis that is still on so long after its ramp does not switch itself off; brakes take their
time to close [s]."""

MOVING_RAD_S = 0.05
SPEED_OVER_S = 0.05


class BrakeWatch:
    """Finds axes that have to be taken the voltage from.

    Args:
        period_s: Device time of a cycle [s].
        rad_per_increment: Per axis; its sign does not matter.
        ramp_s: Per axis, how long its quick stop takes from the highest speed [s].
    """

    def __init__(
        self, period_s: float, rad_per_increment: Sequence[float], ramp_s: Sequence[float]
    ) -> None:
        self._scale, self._ramp_s = [abs(each) for each in rad_per_increment], ramp_s
        cycles = max(1, round(SPEED_OVER_S / period_s))
        self._over_s = cycles * period_s
        self._seen: deque[list[int]] = deque(maxlen=cycles + 1)

    def begin(self) -> None:
        """A quick stop begins."""
        self._seen.clear()

    def complaint(self, axis: int, for_s: float) -> str:
        """Return why an axis with current is to be switched off; empty if it is not.

        Args:
            axis: From 0.
            for_s: Time since the quick stop began [s].
        """
        after_s, ramp_s = for_s - self._ramp_s[axis], self._ramp_s[axis]
        speed = self._speed(axis)
        if after_s > MOVES_AFTER_S and speed > MOVING_RAD_S:
            return (
                f"still moves at {speed:.2f} rad/s {for_s:.1f} s after a quick stop that takes "
                f"{ramp_s:.2g} s: it was taken the voltage from (controlword 00h)"
            )
        if after_s > OFF_AFTER_S:
            return (
                f"is still on {for_s:.1f} s after a quick stop: it was taken the voltage from "
                "(controlword 00h)"
            )
        return ""

    def look(self, inputs: Inputs) -> None:
        """Take the positions of this cycle."""
        self._seen.append(inputs.position.copy())

    def _speed(self, axis: int) -> float:
        """Over the last cycles [rad/s]; 0 until there were enough."""
        if len(self._seen) < (self._seen.maxlen or 0):
            return 0.0
        way = abs(wrapped(self._seen[-1][axis] - self._seen[0][axis]))
        return way * self._scale[axis] / self._over_s
