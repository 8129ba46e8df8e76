"""CiA 402 axis from the master's side: state machine, modes, and checks that the axis obeys.

The state machine (`State`, `Goal`, controlwords) consists of pure functions: the next controlword
follows from the newest statusword of the drive and from the goal. The module stores no copy of the
drive's state, so a stored state can never differ from the real state. All axes pass the states
together. The following table contains, for each state and goal, the controlword and the next state
of the drive:

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

For the goal quick stop, the controlword is 02h in every state. A fault is reset only on request, by
controlword 80h after 00h; the state after the reset is switch on disabled.

Two monitors compare the motion of an axis with its commands and return problems as text: `Tracking`
monitors an enabled axis, `BrakeWatch` an axis that stops. The monitors detect drives that are
scaled wrongly, do not follow their set-points, or do not brake. The `supervisor` decides how all
axes react to a problem.
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
    """CiA 402 state of a drive; the value of each member is the name of the state in messages."""

    NOT_READY = "not ready to switch on"
    DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "unknown CiA 402 state"


class Goal(Enum):
    """Target state to which the master brings a drive."""

    OFF = "switch on disabled"
    ENABLED = "operation enabled"
    QUICK_STOP = "quick stop"


POWERED = frozenset({State.ENABLED, State.QUICK_STOP, State.FAULT_REACTION})
"""Drive states in which the motor carries current, so that the axis can move."""

FAULTY = (State.FAULT, State.FAULT_REACTION)

DISABLE_VOLTAGE, QUICK_STOP, SHUTDOWN, SWITCH_ON, ENABLE = 0x00, 0x02, 0x06, 0x07, 0x0F
FAULT_RESET = 0x80
"""Values of the controlword (6040h); bit 2 is active-low, bit 7 acts on its rising edge."""

WARNING, REMOTE, INTERNAL_LIMIT = 0x0080, 0x0200, 0x0800
FOLLOWS_COMMAND, FOLLOWING_ERROR = 0x1000, 0x2000
"""Bits of the statusword (6041h); the names of bits 12 and 13 apply to CSP, CSV and CST."""

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
    """Return the drive state that a statusword encodes (CiA 402, masks 4Fh and 6Fh)."""
    return _BY_4F.get(statusword & 0x4F) or _BY_6F.get(statusword & 0x6F, State.UNKNOWN)


_TOWARDS_ENABLED = {
    State.DISABLED: SHUTDOWN,
    State.READY: SWITCH_ON,
    State.SWITCHED_ON: ENABLE,
    State.ENABLED: ENABLE,
    State.QUICK_STOP: QUICK_STOP,
    State.UNKNOWN: QUICK_STOP,
}
"""Controlword for each drive state if the goal is to enable the drive.

An axis in quick stop completes its braking, then the drive enters `DISABLED` by itself (605Ah = 2).
"""

_TOWARDS_OFF = {State.ENABLED: SWITCH_ON, State.SWITCHED_ON: SHUTDOWN}


def controlword_towards(state: State, goal: Goal) -> int:
    """Return the controlword for the next step from a state towards a goal.

    The function never resets a fault: in `FAULT` the controlword is disable voltage for both goals.

    Args:
        state: State of the drive according to its newest statusword.
        goal: Target state of the axis. For the goal `OFF` the axis must be at rest, because the
            axis is switched off one state at a time. An axis in quick stop loses its voltage
            immediately.
    """
    if goal is Goal.QUICK_STOP:
        return QUICK_STOP
    steps = _TOWARDS_ENABLED if goal is Goal.ENABLED else _TOWARDS_OFF
    return steps.get(state, DISABLE_VOLTAGE)


def controlword_resetting(state: State, last: int) -> int:
    """Return the controlword for a requested fault reset, which is one rising edge of bit 7.

    Args:
        state: State of the drive according to its newest statusword; in any state except `FAULT`,
            bit 7 is cleared.
        last: Controlword that was sent before; disable voltage for the first call.
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
    """Return the meaning of a statusword as text for messages."""
    texts = [text for bit, text in _SAID.items() if statusword & bit]
    if not statusword & REMOTE:
        texts.append("not controlled over the bus (remote, bit 9, is 0)")
    return f"{', '.join([state_of(statusword).value, *texts])} (statusword {statusword:04X}h)"


def mode_text(mode: int) -> str:
    """Return the name of a mode of operation for messages."""
    name = od.MODE_NAMES.get(mode)
    return f"{mode} ({name})" if name else str(mode)


IN_A_ROW = 3
"""Number of consecutive violations before an axis is reported; one violation can be an outlier."""

VELOCITY_OVER_S = 0.04

LEAST_RAD_S, MOST_TIMES = 0.5, 5.0
"""Limits from which two velocities contradict each other: difference [rad/s] and ratio.

Two velocities contradict each other if they differ by more than the first limit and, in addition,
their ratio exceeds the second limit or their signs differ. A wrong velocity unit causes a ratio of
17 or more.
"""


class Tracking:
    """Monitor that compares the measured positions and velocities with the set-points.

    Args:
        period_s: Device time of a cycle [s].
        rad_per_increment: Position scale per axis, with its sign [rad per increment].
        bounds_deg: Mode of operation → largest deviation of an axis from its set-point [deg], and
            the name of the option that sets it.
        rad_s_per_count: Velocity scale per axis, with its sign [rad/s per count]; empty if velocity
            is not measured.
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
        self._sent: deque[list[int]] = deque(maxlen=LATENCY + 1)
        self._from: list[int] | None = None
        self._sum: list[int] = []
        self.restart()

    def restart(self) -> None:
        """Discard the data of earlier cycles at the beginning of a phase."""
        n = len(self._scale)
        self._sent.clear()
        self._away, self._contradicts = [0] * n, [0] * n
        self._begin_window(None)

    def judge(self, inputs: Inputs, targets: Sequence[int], mode: int) -> Iterator[tuple[int, str]]:
        """Yield the axes that do not follow their set-points, each with a text that describes why.

        Args:
            inputs: Answers of the drives in this cycle.
            targets: Target positions that were sent to the drives in this cycle [increments].
            mode: Present mode of operation of all axes (6060h).
        """
        self._sent.append(list(targets))
        if len(self._sent) > LATENCY and mode in self._bounds:
            yield from self._far_away(inputs, mode)
        if self._unit:
            yield from self._contradicting(inputs)

    def _far_away(self, inputs: Inputs, mode: int) -> Iterator[tuple[int, str]]:
        sent, bounds = self._sent[0], self._bounds[mode]
        for axis, position in enumerate(inputs.position):
            off = abs(wrapped(sent[axis] - position))
            if off <= bounds[axis] or not inputs.fresh[axis]:
                self._away[axis] = 0
                continue
            self._away[axis] += 1
            if self._away[axis] >= IN_A_ROW:
                most, option = self._bounds_deg[mode]
                degrees = math.degrees(off * abs(self._scale[axis]))
                yield (
                    axis,
                    f"is {degrees:.1f}° from its set-point, the limit is {most:.3g}° ({option})",
                )

    def _contradicting(self, inputs: Inputs) -> Iterator[tuple[int, str]]:
        """Compare the mean reported velocity of a time window with the distance travelled in it."""
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
                    f"reports a velocity of {reported:.3g} rad/s (606Ch), its positions give "
                    f"{actual:.3g} rad/s: axes.velocity_unit or polarity (607Eh) is wrong",
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
"""Maximum duration of a quick stop from the highest speed of a joint [s].

Drives whose quick stop takes longer than `LONGEST_RAMP_S` are rejected.
"""

MOVES_AFTER_S = 0.2
"""Time after the end of the quick-stop ramp; an axis that still moves then does not brake [s]."""

OFF_AFTER_S = 1.0
"""Time after the end of the quick-stop ramp; an axis that is still on then does not switch off [s].

The time includes the closing of the mechanical brakes by the drive.
"""

MOVING_RAD_S = 0.05
SPEED_OVER_S = 0.05


class BrakeWatch:
    """Detector of axes whose voltage must be disabled during a quick stop.

    Args:
        period_s: Device time of a cycle [s].
        rad_per_increment: Position scale per axis [rad per increment]; its sign has no effect.
        ramp_s: Duration of a quick stop from the maximum joint speed, for each axis [s].
    """

    def __init__(
        self, period_s: float, rad_per_increment: Sequence[float], ramp_s: Sequence[float]
    ) -> None:
        self._scale, self._ramp_s = [abs(each) for each in rad_per_increment], ramp_s
        cycles = max(1, round(SPEED_OVER_S / period_s))
        self._over_s = cycles * period_s
        self._seen: deque[list[int]] = deque(maxlen=cycles + 1)

    def begin(self) -> None:
        """Start the monitoring of a quick stop, without data of earlier cycles."""
        self._seen.clear()

    def complaint(self, axis: int, for_s: float) -> str:
        """Return why a powered axis must lose its voltage; an empty text if the axis brakes.

        Args:
            axis: Number of the axis, from 0.
            for_s: Time since the quick stop began [s].
        """
        after_s, ramp_s = for_s - self._ramp_s[axis], self._ramp_s[axis]
        speed = self._speed(axis)
        if after_s > MOVES_AFTER_S and speed > MOVING_RAD_S:
            return (
                f"still moves at {speed:.2f} rad/s {for_s:.1f} s after a quick stop that takes "
                f"{ramp_s:.2g} s: its voltage was disabled (controlword 00h)"
            )
        if after_s > OFF_AFTER_S:
            return (
                f"is still on {for_s:.1f} s after a quick stop: its voltage was disabled "
                "(controlword 00h)"
            )
        return ""

    def look(self, inputs: Inputs) -> None:
        """Store the positions that the drives reported in this cycle."""
        self._seen.append(inputs.position.copy())

    def _speed(self, axis: int) -> float:
        """Return the mean speed of an axis over the last cycles [rad/s]; 0 after too few cycles."""
        if len(self._seen) < (self._seen.maxlen or 0):
            return 0.0
        way = abs(wrapped(self._seen[-1][axis] - self._seen[0][axis]))
        return way * self._scale[axis] / self._over_s
