"""A motion streamed to the drives: a segment becomes a `Track`, the `Player` plays it row by row.

Everything a cycle needs is computed before the motion begins: `track_of` checks a segment and turns
it into the drives' integers, with the torque of a rigid-body model where it is sent along. If the
segment begins a little beside the held set-point, the track first goes there, in `REACHED_S` or
longer. In the cycle the player takes the next row, brakes on the rest of the way when it is
stopped, and holds where the motion ended. A stop slows time down along the path, so all joints stay
on it; of the torque, what moves the arm falls with the square of the pace, what holds it stays.

In CSP the drives close the position loop and get positions (with a torque offset, if wanted). In
CSV and CST the master closes it: `velocities` and `torques` compare what an axis shows now with the
set-point that it should show by now, `BEHIND` cycles old.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from hil.arms import ArmDescription
from hil.core import CommandRefused, FloatArray, IntArray
from hil.robot import Limits, Segment, Status
from hil_drivers.arm import SPEED_SLACK, refused, require_executable
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.bus import Inputs, Outputs
from hil_drivers.cia402.commissioning import Drive
from hil_drivers.cia402.mapping import LATENCY
from hil_drivers.cia402.profile import INT16, INT32, Scaling, wrapped
from hil_drivers.cia402.torque import TorqueModel


@dataclass(frozen=True, eq=False)
class Track:
    """A motion as the drives take it, one row per cycle.

    Attributes:
        segment: Index of the plan's step.
        position: (N, n) of 607Ah, N ≥ 1; begins where the drives hold.
        velocity: (N, n) of 60FFh.
        torque: (N, n) feed-forward, ‰ as 6071h and 60B2h.
        holding: (N, n) what would hold the arm still there, in the same unit.
    """

    segment: int
    position: IntArray
    velocity: IntArray
    torque: IntArray
    holding: IntArray

    @cached_property
    def rows(self) -> list[tuple[list[int], list[int], list[int], list[int]]]:
        """Position, velocity, torque and holding torque row by row, as plain integers."""
        columns = (self.position, self.velocity, self.torque, self.holding)
        return list(zip(*(column.tolist() for column in columns), strict=True))

    def between(self, at: float) -> tuple[list[int], list[int], list[int], list[int]]:
        """Return a row at a place between rows, counted from 0."""
        row = int(at)
        last = len(self.rows) - 1
        if row >= last:
            return self.rows[last]
        share, here, there = at - row, self.rows[row], self.rows[row + 1]
        position = [
            wrapped(p + round(share * wrapped(q - p)))
            for p, q in zip(here[0], there[0], strict=True)
        ]
        velocity, torque, holding = (
            [round(p + share * (q - p)) for p, q in zip(here[i], there[i], strict=True)]
            for i in (1, 2, 3)
        )
        return position, velocity, torque, holding

    def steps_at(self, at: float) -> list[int]:
        """Increments of position per row from a place on; zeros at the end."""
        row = int(at)
        if row >= len(self.rows) - 1:
            return [0] * len(self.rows[0][0])
        return [
            wrapped(q - p) for p, q in zip(self.rows[row][0], self.rows[row + 1][0], strict=True)
        ]


BEGINS_WITHIN_RAD = 1e-4
"""Drives follow set-points without smoothing them: a segment may begin this far from the held one.
"""

GIVEN_RAD = 2e-3
"""A brake may give when its axis is switched on, after the plan was made. Before the first motion
this much is corrected; between motions a correction would hide a mistake."""

LED_RAD = 0.05
"""Led by a spring (CST, CSV), an arm rests beside its set-point, where friction keeps it."""

REACHED_S = 0.4
"""Least time in which a track goes to the begin of its segment."""


def track_of(
    segment: Segment,
    limits: Limits,
    standing: FloatArray,
    rate_hz: float,
    scaling: Scaling,
    model: TorqueModel | None,
    *,
    led: bool = False,
    first: bool = False,
) -> Track:
    """A segment that can be executed, in the drives' integers.

    Args:
        segment: The next one.
        limits: Of the arm.
        standing: (n,) the set-point that is held [rad].
        rate_hz: Rows per second of device time.
        scaling: Of the drives.
        model: Says the feed-forward torque; none is sent without.
        led: The master closes the position loop; the segment may begin `LED_RAD` from there.
        first: Nothing has moved since the axes were switched on; a brake may have given.

    Raises:
        CommandRefused: It leaves the limits, jumps, begins elsewhere or moves at its ends.
    """
    moves = segment.kind != "hold"
    tolerance = LED_RAD if led else GIVEN_RAD if first and moves else BEGINS_WITHIN_RAD
    require_executable(segment, limits, standing, at_set_point_rad=tolerance)
    require_smooth(segment, limits, rate_hz)
    q, qd, qdd = segment.q, segment.qd, segment.qdd
    if np.abs(q[0] - standing).max() > BEGINS_WITHIN_RAD:
        approach = _approach(standing, q[0], limits, rate_hz)
        q, qd, qdd = (np.vstack(pair) for pair in zip(approach, (q, qd, qdd), strict=True))
    torque = holding = np.zeros_like(q)
    if model is not None:
        torque, holding = model.torque(q, qd, qdd), model.holding(q)
    return Track(
        segment=segment.index,
        position=scaling.raw_position(q),
        velocity=scaling.raw_velocity(qd),
        torque=scaling.raw_torque(torque),
        holding=scaling.raw_torque(holding),
    )


def _approach(
    start: FloatArray, end: FloatArray, limits: Limits, rate_hz: float
) -> tuple[FloatArray, ...]:
    """Return (N, n) positions, velocities, accelerations from rest to rest within the limits.

    The polynomial of degree 5 has its highest speed, 15/8 of the mean one, in the middle, and its
    highest acceleration, 10/√3 of way / time², at (3 ± √3) / 6 of the time.
    """
    way = end - start
    fast = (15 / 8 * np.abs(way) / limits.qd_max).max()
    sharp = np.sqrt((10 / math.sqrt(3) * np.abs(way) / limits.qdd_max).max())
    rows = math.ceil(max(REACHED_S, fast, sharp) * rate_hz)
    lasts_s, t = rows / rate_hz, np.arange(rows)[:, None] / rows
    q = start + way * (10 * t**3 - 15 * t**4 + 6 * t**5)
    qd = way * (30 * t**2 - 60 * t**3 + 30 * t**4) / lasts_s
    qdd = way * (60 * t - 180 * t**2 + 120 * t**3) / lasts_s**2
    return q, qd, qdd


ACCELERATION_SLACK = 1.10
"""Second differences of sampled polynomials and rounded positions may be that much more."""

ROUNDING_RAD = 1e-8
"""Rounding error of a position; second differences add up to four of it."""


def require_smooth(segment: Segment, limits: Limits, rate_hz: float) -> None:
    """Refuse positions between which drives would jump.

    Args:
        segment: The next one.
        limits: Of the arm.
        rate_hz: Rows per second of device time.

    Raises:
        CommandRefused: Positions are farther apart than the fastest speed, bend more than the
            highest acceleration, do not begin and end at rest; or a hold moves.
    """
    if segment.kind == "hold" and len(segment.q) != 1:
        raise refused(f"{_where(segment)} has {len(segment.q)} rows: a hold has one")
    speed = np.abs(np.diff(segment.q, axis=0)).max(axis=0, initial=0.0) * rate_hz
    if (too_fast := np.flatnonzero(speed > limits.qd_max * SPEED_SLACK)).size:
        joint = int(too_fast[0])
        raise refused(
            f"{_where(segment)} has set-points of joint {joint + 1} that are {speed[joint]:.3f} "
            f"rad/s apart, {limits.qd_max[joint]:.3f} are allowed"
        )
    # At rest before the first row and after the last one: a segment that sets out or ends at
    # speed bends there.
    at_rest = np.vstack((segment.q[:1], segment.q, segment.q[-1:]))
    bends = np.abs(np.diff(at_rest, 2, axis=0)) * rate_hz**2
    most = limits.qdd_max * ACCELERATION_SLACK + 4 * ROUNDING_RAD * rate_hz**2
    if (bends > most).any():
        raise _too_sharp(segment, bends, limits.qdd_max)


def _too_sharp(segment: Segment, bends: FloatArray, most: FloatArray) -> CommandRefused:
    row, joint = np.unravel_index(int((bends / most).argmax()), bends.shape)
    place = {0: "sets out", len(bends) - 1: "ends"}.get(int(row), f"bends at row {row}")
    return refused(
        f"{_where(segment)} {place} with {bends[row, joint]:.1f} rad/s² of joint {joint + 1} by "
        f"its positions, {most[joint]:.3f} are allowed"
    )


def _where(segment: Segment) -> str:
    return f"segment {segment.index} ({segment.kind})"


BEHIND = LATENCY + 1
"""Cycles from `step` to the answer that shows its set-point: one until it is sent, then `LATENCY`.
"""

LONGEST_STOP_S = 5.0
"""A gentler deceleration than this takes is not waited for: the arm brakes harder."""
MOVING, HOLDING = int(Status.MOVING), int(Status.HOLDING)


class Player:
    """The commanded motion of all axes; one `step` a cycle, by the cyclic thread.

    Args:
        period_s: Device time of a cycle [s].
        rad_per_increment: Per axis, of position; its sign does not matter.
        feed_forward: Send the track's torque as 60B2h in CSP.
        gains: For CST and CSV.

    Attributes:
        segment, status: Of the row commanded last: the plan's step and `Status` bits.
        position, velocity, torque: The same row, raw.
        scale: Per axis, radians per increment, above 0.
        mode: CSP, CSV or CST; 0 while the drives are not enabled.
    """

    def __init__(
        self,
        period_s: float,
        rad_per_increment: Sequence[float],
        *,
        feed_forward: bool = False,
        gains: Gains | None = None,
    ) -> None:
        self._period_s, self.scale = period_s, [abs(rad) for rad in rad_per_increment]
        self._feed_forward, self._gains = feed_forward, gains
        self._lock = threading.Lock()
        self._loaded: Track | None = None
        self._begin: Track | None = None
        self._track: Track | None = None
        self._at, self._pace, self._slower = 0.0, 1.0, 0.0
        self._fade = Fade(len(self.scale), period_s)
        self.mode = 0
        self._commanded: deque[tuple[list[int], list[int]]] = deque(maxlen=BEHIND + 1)
        self.segment, self.status = -1, 0
        self._at_rest([0] * len(self.scale), [0] * len(self.scale))

    @property
    def moving(self) -> bool:
        """Whether set-points of a motion are left, or it brakes."""
        return self._track is not None or self._begin is not None

    def load(self, track: Track) -> None:
        """Keep the next motion for `start`; from any thread.

        Raises:
            CommandRefused: It is for another number of axes.
        """
        first = track.rows[0][0]  # makes all rows, in the thread that has time for it
        if len(first) != len(self.scale):
            raise CommandRefused(
                f"segment {track.segment} has {len(first)} axes, the arm {len(self.scale)}"
            )
        self._loaded = track

    def start(self) -> None:
        """Begin with the next cycle; from any thread.

        Raises:
            CommandRefused: Nothing is loaded, it does not begin where the arm is held, the last
                motion goes on, or the drives are not enabled.
        """
        with self._lock:
            track = self._loaded
            if track is None:
                raise CommandRefused("start without a prepared segment", hint="prepare one first")
            self._refuse_now(track)
            self._loaded, self._begin = None, track

    def stop(self, deceleration_rad_s2: float) -> None:
        """Come to rest on the rest of the way, slower and slower, and hold there; from any thread.

        Idempotent. What is loaded or about to begin is forgotten.
        """
        with self._lock:
            self._loaded = self._begin = None
            track = self._track
            if track is None or self._slower:
                return
            fastest = max(self._fastest(track, self._at - 1.0), self._fastest(track, self._at))
            lasts_s = min(fastest / self._period_s / deceleration_rad_s2, LONGEST_STOP_S)
            self._slower = self._pace if lasts_s <= 0.0 else self._period_s / lasts_s

    def engage(self, mode: int, outputs: Outputs) -> None:
        """The drives are enabled in a mode, with these preloaded targets: hold them."""
        with self._lock:
            self._loaded = self._begin = self._track = None
            torque = outputs.torque_offset if mode == od.CSP else outputs.target_torque
            if not self.mode or mode == od.CSP:
                self._at_rest(outputs.target_position, torque)
            else:
                self._at_rest(self.position, torque)
            self.mode, self.status = mode, HOLDING

    def disengage(self) -> None:
        """The drives do not follow any more: there is no motion."""
        with self._lock:
            self._loaded = self._begin = self._track = None
            self.mode, self.segment, self.status = 0, -1, 0

    def step(self, inputs: Inputs, outputs: Outputs) -> None:
        """Write the targets of the next cycle."""
        with self._lock:
            if self._begin is not None:
                self._set_out(self._begin)
            if self._track is not None:
                self._advance(self._track)
        outputs.segment, outputs.status = self.segment, self.status
        self._commanded.append((self.position, self.velocity))
        if self.mode == od.CSP:
            outputs.target_position[:] = self.position
            if self._feed_forward:
                outputs.torque_offset[:] = self._fade.faded(self.torque)
        elif self.mode == od.CSV:
            outputs.target_velocity[:] = self._led(inputs)
        elif self.mode == od.CST:
            outputs.target_torque[:] = self._controlled(inputs)
        if self.mode == outputs.mode[0] != od.CSP:
            # Drives do not look at it in these modes, recordings do. Not while the mode is
            # switched: then what is preloaded is where the axes are.
            outputs.target_position[:] = self.position

    def _set_out(self, track: Track) -> None:
        self._begin, self._track = None, track
        self._at, self._pace, self._slower = 0.0, 1.0, 0.0
        self.segment = track.segment
        self._fade.begin(self._fade.faded(self.torque), track.rows[0][2])

    def _advance(self, track: Track) -> None:
        """One row further; slower and slower when it brakes."""
        rows = track.rows
        if not self._slower:
            at = int(self._at)
            self.position, self.velocity, self.torque, holding = rows[at]
            self._at = at + 1.0
        else:
            holding = self._brake(track)
        self.status = MOVING
        if self._at >= len(rows) or not self._pace:
            self._rest_here(holding)

    def _brake(self, track: Track) -> list[int]:
        # `_at` is the row to come; the one commanded last is a whole step behind it.
        before, self._pace = self._pace, max(self._pace - self._slower, 0.0)
        passed = self._at - 1.0 + 0.5 * (before + self._pace)
        self.position, velocity, torque, holding = track.between(passed)
        self.velocity = [round(v * self._pace) for v in velocity]
        share = self._pace**2
        self.torque = [h + round(share * (m - h)) for m, h in zip(torque, holding, strict=True)]
        self._at = passed + 1.0
        return holding

    def _fastest(self, track: Track, at: float) -> float:
        """Of all joints, per cycle [rad]."""
        steps = track.steps_at(at)
        return max(abs(step) * by for step, by in zip(steps, self.scale, strict=True))

    def _rest_here(self, holding: list[int]) -> None:
        self._track = None
        if holding != self.torque:  # it ends with an acceleration
            self._fade.begin(self._fade.faded(self.torque), holding)
            self.torque = holding
        self.velocity = [0] * len(self.scale)
        self.status = HOLDING if self.mode else 0

    def _at_rest(self, position: Sequence[int], torque: Sequence[int]) -> None:
        self.position, self.torque = list(position), list(torque)
        self.velocity = [0] * len(self.scale)
        self._commanded.clear()
        self._fade.end()

    def _led(self, inputs: Inputs) -> list[int]:
        assert self._gains is not None, "CSV needs gains"
        return velocities(self._gains, self.velocity, self._commanded[0][0], inputs)

    def _controlled(self, inputs: Inputs) -> list[int]:
        assert self._gains is not None, "CST needs gains"
        torque = self._fade.faded(self.torque)
        return torques(self._gains, torque, *self._commanded[0], inputs)

    def _refuse_now(self, track: Track) -> None:
        where = f"segment {track.segment}"
        if not self.mode:
            raise CommandRefused(f"{where}: the drives are not enabled", hint="connect again")
        if self.moving:
            raise CommandRefused(
                f"{where}: segment {self.segment} is still running",
                hint="read until the status says HOLDING, or stop()",
            )
        far, axis = farthest(track.rows[0][0], self.position, self.scale)
        if far > BEGINS_WITHIN_RAD:
            raise CommandRefused(
                f"{where} begins {far:.4f} rad from where axis {axis + 1} is held",
                hint="plan it from the present q_target",
            )


def farthest(a: Sequence[int], b: Sequence[int], scale: Sequence[float]) -> tuple[float, int]:
    """Return the largest distance between positions, each times its scale, and its axis."""
    return max(
        (abs(wrapped(p - q)) * by, axis)
        for axis, (p, q, by) in enumerate(zip(a, b, scale, strict=True))
    )


FADE_S = 0.5
"""A step in the feed-forward torque (a model that is off, a mode switch) goes over this time."""


class Fade:
    """Feed-forward torque, without steps where one model or mode follows the other.

    Args:
        n: Axes.
        period_s: Device time of a cycle [s].
    """

    def __init__(self, n: int, period_s: float) -> None:
        self._n, self._per_cycle = n, period_s / FADE_S
        self.end()

    def begin(self, present: Sequence[int], torque: Sequence[int]) -> None:
        """Begin to fade from the present torque to the first one of the next motion [‰]."""
        self._bias = [now - then for now, then in zip(present, torque, strict=True)]
        self._left = 1.0

    def end(self) -> None:
        """There is no step any more."""
        self._bias, self._left = [0] * self._n, 0.0

    def faded(self, torque: list[int]) -> list[int]:
        """Return a row's torque with the rest of the step, and advance by a cycle."""
        if self._left <= 0.0:
            return torque
        self._left -= self._per_cycle
        share = max(self._left, 0.0)
        return [
            _within(round(value + share * bias), _MOST_TORQUE)
            for value, bias in zip(torque, self._bias, strict=True)
        ]


@dataclass(frozen=True, slots=True)
class Gains:
    """Position control by the master, per axis.

    In CST torque = feed-forward + kp·e + kd·ė, in CSV velocity = the motion's + kv·e.

    Attributes:
        kp: ‰ of rated torque per increment of position.
        kd: ‰ of rated torque per count of velocity.
        limit: Largest torque commanded [‰].
        kv: Counts of velocity per increment of position.
    """

    kp: tuple[float, ...]
    kd: tuple[float, ...]
    limit: tuple[float, ...]
    kv: tuple[float, ...]


LOOP_RAD_S = 2.0 * math.pi * 4.0
"""Natural frequency of a joint that is led by torque [rad/s].

What is commanded now acts two cycles later: at 250 Hz about 10 ms with the hold of the last one. A
loop of 4 Hz, critically damped, then keeps a phase margin of some 45°; harder ones ring."""

INERTIA_SHARE = 0.1
"""Smallest inertia assumed of a joint, rotor included, as a share of effort_max / qdd_max.
A heavier joint gets a softer loop, which rings a little; a lighter one would be unstable."""

KV_PER_S = 8.0
"""In CSV, velocity per error of position [1/s]."""


def gains_of(
    given: Sequence[Mapping[str, Any]], drives: Sequence[Drive], arm: ArmDescription
) -> Gains:
    """The gains of all axes.

    Args:
        given: What the station says of each axis: `stiffness_nm_rad`, `damping_nms_rad`.
        drives: Say what their numbers mean, and to what torque they limit themselves.
        arm: Says what the joints are like.
    """
    kp, kd, limit, kv = [], [], [], []
    for axis, drive in enumerate(drives):
        profile = drive.profile
        stiffness, damping = _spring_and_damper(given[axis], arm, axis)
        kp.append(stiffness * profile.rad_per_increment / profile.nm_per_count)
        kd.append(damping * profile.rad_s_per_count / profile.nm_per_count)
        kv.append(KV_PER_S * profile.rad_per_increment / profile.rad_s_per_count)
        most_nm = [float(arm.effort_max[axis]), drive.max_torque_nm]
        counts = min(each for each in most_nm if not math.isnan(each)) / abs(profile.nm_per_count)
        limit.append(min(counts, float(INT16[1])))
    return Gains(tuple(kp), tuple(kd), tuple(limit), tuple(kv))


def _spring_and_damper(
    given: Mapping[str, Any], arm: ArmDescription, axis: int
) -> tuple[float, float]:
    """Return spring [N·m/rad] and damper [N·m·s/rad]; a given spring determines the damper."""
    inertia = INERTIA_SHARE * float(arm.effort_max[axis] / arm.qdd_max[axis])
    stiffness = float(given.get("stiffness_nm_rad", inertia * LOOP_RAD_S**2))
    damping = float(given.get("damping_nms_rad", 2.0 * math.sqrt(stiffness * inertia)))
    return stiffness, damping


def velocities(
    gains: Gains, velocity: Sequence[int], due: Sequence[int], inputs: Inputs
) -> list[int]:
    """Return velocities in CSV: the motion's, corrected towards the positions due by now."""
    return [
        _within(ahead + round(kv * wrapped(wanted - is_at)), _MOST_VELOCITY)
        for ahead, kv, wanted, is_at in zip(velocity, gains.kv, due, inputs.position, strict=True)
    ]


def torques(
    gains: Gains,
    torque: Sequence[int],
    position: Sequence[int],
    velocity: Sequence[int],
    inputs: Inputs,
) -> list[int]:
    """Return torques in CST: feed-forward, with spring and damper to the set-point due by now."""
    return [
        _within(
            round(
                torque[i]
                + gains.kp[i] * wrapped(position[i] - inputs.position[i])
                + gains.kd[i] * (velocity[i] - inputs.velocity[i])
            ),
            gains.limit[i],
        )
        for i in range(len(torque))
    ]


_MOST_TORQUE, _MOST_VELOCITY = INT16[1], INT32[1]


def _within(value: int, limit: float) -> int:
    most = int(limit)
    return most if value > most else -most if value < -most else value
