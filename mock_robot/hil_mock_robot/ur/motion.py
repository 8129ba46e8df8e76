"""Motions of the mock UR arm, which advance its set-point tick by tick.

`MovePath` follows a planned route; `ServoJ`, `SpeedJ` and `SpeedL` follow set-points streamed by a
client; `StopJoints` and `StopL` stop the arm. All implement `Motion`. `ToolFollower` computes joint
positions for a tool that moves on a line.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, exp, sin, sqrt
from typing import Protocol

import numpy as np
from scipy.linalg.lapack import dgesv

from hil.arms import ArmDescription
from hil.core import FloatArray
from hil_mock_robot.ur.kinematics import (
    Numbers,
    Posture,
    Triple,
    compose,
    frame_of,
    inverted,
    lengths_of,
    nearest,
    rotation_of,
    turned,
    twist_of,
)
from hil_mock_robot.ur.motion_limits import (
    SINGULARITY,
    MotionImpossible,
    out_of_range,
    require_finite,
    require_within,
)
from hil_mock_robot.ur.path_pieces import Moment, Piece, Size, joint_size
from hil_mock_robot.ur.routes import Leg, Site, blendable, joint_route, tool_route

Setpoint = FloatArray
"""Position [rad], velocity [rad/s] and acceleration [rad/s²] that the servo follows, (3, 6)."""

ROUNDING, BISECTIONS = 1 + 1e-9, 8

BRAKE_RAD_S2 = 8.0
"""Deceleration of an arm that still moves when a new move is commanded [rad/s²]; a move begins
at rest.
"""


class Motion(Protocol):
    """Active motion, which is called in each tick of the controller."""

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        """Return the next set-point, or None once the motion is over.

        Args:
            now: Present set-point, which was commanded for the previous tick.
            scale: Position of the speed slider, 0 to 1: share of a tick by which motion time
                advances.

        Returns:
            New array (3, 6). The last set-point of a motion that is over has zero speed.
        """


class MovePath:
    """Sequence of moves from rest to rest; implements `Motion`.

    Consecutive moves in the same space are blended if they have a blend radius. The tool leaves the
    straight segment at that distance from the waypoint, but not before the middle of the segment,
    and changes to the next segment on a parabola. The arm stops between moves in different spaces.

    Args:
        arm: Arm with its lengths and limits; None for joint moves without limits.
        tcp: Tool in the flange frame when the path is commanded, (6,).
        legs: Moves of the path.
        tick_s: Device time of a tick [s].

    Attributes:
        progress: Index of the present move; a blend belongs to the move that begins with it.
    """

    def __init__(
        self, arm: ArmDescription | None, tcp: Numbers | None, legs: Sequence[Leg], tick_s: float
    ) -> None:
        self._site = Site(arm, None if tcp is None else np.array(tcp, dtype=np.float64))
        self._legs, self._tick_s = list(legs), tick_s
        self._planned = 0
        self._pieces: list[Piece] = []
        self._follower: ToolFollower | None = None
        self._t = 0.0
        self._pace: float | None = None
        self.progress = 0

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        """Return the next set-point of the path; see `Motion.advance`.

        The speed slider scales the time of the motion; the path does not change.

        Raises:
            MotionImpossible: The code is 150 for a target beyond the joint limits, 154 for a path
                through a singularity or out of reach, and 0 for a target out of reach.
        """
        if not self._pieces:
            if now[1].any():
                return StopJoints(BRAKE_RAD_S2, self._tick_s).advance(now, 1.0)
            self._plan(now[0])
            if not self._pieces:
                return None
        pace, change = self._slide(scale)
        self._t += 0.5 * (2.0 * pace - change) * self._tick_s
        while len(self._pieces) > 1 and self._t >= self._pieces[0].duration:
            self._t -= self._pieces.pop(0).duration
        piece = self._pieces[0]
        self.progress = piece.leg
        if self._t >= piece.duration:
            self._pieces = []
            return self._rest(piece, now)
        return self._moving(piece, pace, change / self._tick_s, now)

    def _plan(self, q: FloatArray) -> None:
        """Plan the pieces of the next moves that can be blended together."""
        while not self._pieces and self._planned < len(self._legs):
            first = self._planned
            legs = self._legs[first : first + blendable(self._legs[first:])]
            self._planned += len(legs)
            self._t, self._follower = 0.0, None
            if legs[0].joint_space:
                self._pieces = joint_route(self._site, legs, first, q)
            else:
                self._pieces = tool_route(self._site, legs, first, q)
                self._follower = ToolFollower(*self._site.known, self._tick_s)

    def _slide(self, scale: float) -> tuple[float, float]:
        """Return the pace (motion time per device time) of this tick, and the change of the pace.

        The pace approaches the slider position as fast as the acceleration of the moves permits.
        """
        before = self._pace = scale if self._pace is None else self._pace
        if before != scale:
            self._pace += self._share(before, scale - before) * (scale - before)
        return self._pace, self._pace - before

    def _share(self, before: float, change: float) -> float:
        """Return the share of a pace change that is permitted in this tick, 0 to 1."""
        if self._permitted(before, change):
            return 1.0
        low, high = 0.0, 1.0
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (
                (middle, high) if self._permitted(before, middle * change) else (low, middle)
            )
        return low

    def _permitted(self, before: float, change: float) -> bool:
        """Return whether the accelerations permit the pace to change by `change` in this tick."""
        rate, t = change / self._tick_s, self._t
        paces = (before, before + change)  # the acceleration profile can change within the tick

        def fits(piece: Piece, at: float) -> bool:
            return max(piece.effort(at, pace, rate) for pace in paces) <= ROUNDING

        if not fits(self._pieces[0], t):
            return False
        t += (before + 0.5 * change) * self._tick_s
        for piece in self._pieces:
            if t < piece.duration or piece is self._pieces[-1]:
                return fits(piece, t)
            t -= piece.duration
        return True

    def _moving(self, piece: Piece, pace: float, change: float, now: Setpoint) -> Setpoint:
        moment = piece.at(self._t)
        if self._follower is not None:
            return self._follower.setpoint(moment, piece.anchor, pace, now)
        x, v, a = moment
        return np.array((x, pace * v, pace * pace * a + change * v))

    def _rest(self, piece: Piece, now: Setpoint) -> Setpoint:
        setpoint = self._moving(piece, 0.0, 0.0, now) if self._follower else None
        q = piece.at(piece.duration)[0] if setpoint is None else setpoint[0]
        return np.array((q, np.zeros(6), np.zeros(6)))


FASTEST_RAD_S = np.pi
"""Joint speed limit if no arm is specified [rad/s]."""

STEEPEST_RAD_S2 = 40.0
"""Maximum acceleration of `servoj` [rad/s²]; also the maximum that clients may request for a
move.
"""

LOOKAHEAD_S, GAIN = (0.03, 0.2), (100.0, 2000.0)
USUAL_GAIN = 300.0
ARRIVED_RAD, RESTING_RAD_S = 1e-7, 1e-6

LIMIT_BRAKE_RAD_S2 = 8.0
"""Deceleration of an arm near its joint limits, as commanded by `Machine` [rad/s²]."""


class ServoJ:
    """Motion of URScript `servoj`: the joints follow a target that a program moves tick by tick.

    Each joint has a critically damped second-order filter, which lags behind a steadily moving
    target by `lookahead · √(300 / gain)` and never overshoots a static target. The acceleration is
    at most 40 rad/s². The speed is limited to the joint speed limit times the speed slider, and the
    deceleration follows from the filter. The control law of the real controller is not published.

    Args:
        tick_s: Device time of a tick [s].
        arm: Arm whose limits apply; None for π rad/s and any position.
    """

    def __init__(self, tick_s: float, arm: ArmDescription | None = None) -> None:
        self._tick_s, self._arm = tick_s, arm
        self._fastest = np.full(6, FASTEST_RAD_S) if arm is None else arm.qd_max
        self._target: FloatArray | None = None
        self._ticks_left = 0.0
        self._rate = 0.0
        self._share: float | None = None

    def aim(self, q: Numbers, time_s: float, lookahead_s: float, gain: float) -> None:
        """Set the target to follow for `time_s`; afterwards the arm comes to rest at the target.

        Args:
            q: Target joint positions, (6,) [rad].
            time_s: Duration of the command [s].
            lookahead_s: Smoothing time, clipped to 0.03 to 0.2 [s].
            gain: Position gain, clipped to 100 to 2000.
        """
        self._target = np.array((*q, time_s, lookahead_s, gain), dtype=np.float64)
        self._ticks_left = max(1.0, time_s / self._tick_s)
        lookahead = min(max(LOOKAHEAD_S[0], lookahead_s), LOOKAHEAD_S[1])
        self._rate = 2.0 / lookahead * sqrt(min(max(GAIN[0], gain), GAIN[1]) / USUAL_GAIN)

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        """Return the next set-point; None if the last target is reached and no new target was set.

        Raises:
            MotionImpossible: The code is 150 for a target beyond the joint limits, and 204 for a
                target that is not finite.
        """
        if self._target is None:
            return StopJoints(LIMIT_BRAKE_RAD_S2, self._tick_s).advance(now, scale)
        require_finite(self._target)
        target, q, v = self._target[:6], now[0], now[1]
        if self._arm is not None:
            require_within(self._arm, target)
        self._ticks_left -= 1.0
        self._slide(scale)
        near = np.abs(q - target).max() < ARRIVED_RAD and np.abs(v).max() < RESTING_RAD_S
        if near and self._ticks_left < 0.0:
            return np.array((target, np.zeros(6), np.zeros(6))) if v.any() else None
        return self._filtered(q - target, q, v)

    def _slide(self, scale: float) -> None:
        """Adjust the speed limit to the slider, at most as fast as `LIMIT_BRAKE_RAD_S2`."""
        step = LIMIT_BRAKE_RAD_S2 * self._tick_s / float(self._fastest.max())
        before = scale if self._share is None else self._share
        self._share = min(max(scale, before - step), before + step)

    def _filtered(self, away: FloatArray, q: FloatArray, v: FloatArray) -> Setpoint:
        """Compute an exact step of x'' = -w²·x - 2w·x', with x clipped to limit the speed."""
        dt, w = self._tick_s, self._rate
        furthest = 2.0 * (self._share or 0.0) / w * self._fastest
        x = np.clip(away, -furthest, furthest)
        left, k = exp(-w * dt), v + w * x
        wanted = (v - w * k * dt) * left
        step = STEEPEST_RAD_S2 * dt
        after = np.clip(wanted, np.minimum(v, 0.0) - step, np.maximum(v, 0.0) + step)
        moved = np.where(after == wanted, (x + k * dt) * left - x, 0.5 * dt * (v + after))
        return np.array((q + moved, after, (after - v) / dt))


class SpeedJ:
    """Motion of URScript `speedj`: the joints accelerate to a speed and keep this speed.

    Args:
        tick_s: Device time of a tick [s].
        arm: Arm whose limits apply; None for no limits.
    """

    def __init__(self, tick_s: float, arm: ArmDescription | None = None) -> None:
        self._tick_s, self._arm = tick_s, arm
        self._speed, self._a = np.zeros(6), 1.0

    def aim(self, qd: Numbers, a: float) -> None:
        """Set the joint speeds `qd` (6,) [rad/s]; the largest change has acceleration `a`."""
        self._speed, self._a = np.array(qd, dtype=np.float64), abs(a) or 1.0
        if self._arm is not None:
            self._speed /= max(1.0, float((np.abs(self._speed) / self._arm.qd_max).max()))

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        """Return the next set-point; the motion never ends by itself.

        The speed slider scales the commanded speed.

        Raises:
            MotionImpossible: The code is 150 if a joint could no longer stop within its limits.
        """
        require_finite(self._speed, self._a)
        v = _towards(now[1], scale * self._speed, self._a * self._tick_s, joint_size)
        q = now[0] + 0.5 * self._tick_s * (now[1] + v)
        if self._arm is not None:
            require_stopping(self._arm, q, v)
        return np.array((q, v, (v - now[1]) / self._tick_s))


def _towards(now: FloatArray, goal: FloatArray, most: float, size: Size) -> FloatArray:
    """Return `now` moved towards `goal` by a size of at most `most`, components in proportion."""
    change = goal - now
    whole = size(change)
    return goal if whole <= most else now + change * (most / whole)


class SpeedL:
    """Motion of URScript `speedl`: the tool accelerates to a velocity and keeps this velocity.

    Args:
        arm: UR arm.
        tcp: Tool in the flange frame, (6,).
        tick_s: Device time of a tick [s].
    """

    def __init__(self, arm: ArmDescription, tcp: Numbers, tick_s: float) -> None:
        self._arm, self._tick_s = arm, tick_s
        self._follower = ToolFollower(arm, tcp, tick_s)
        self._speed, self._a = np.zeros(6), 1.0
        self._twist: FloatArray | None = None

    def aim(self, xd: Numbers, a: float) -> None:
        """Set the tool velocity in the base frame and its acceleration.

        Args:
            xd: Velocity, (6,) [m/s, rad/s].
            a: Acceleration [m/s², rad/s²].
        """
        self._speed, self._a = np.array(xd, dtype=np.float64), abs(a) or 1.0

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        """Return the next set-point; see `SpeedJ.advance`.

        Raises:
            MotionImpossible: The code is 150 near joint limits, and 154 near a singularity.
        """
        require_finite(self._speed, self._a)
        if self._twist is None:
            self._twist = np.array(self._follower.twist(now))
        goal, step = scale * self._speed, self._a * self._tick_s
        self._twist = _towards(self._twist, goal, step, _larger_part)
        setpoint = self._follower.drift(now, self._twist)
        require_stopping(self._arm, setpoint[0], setpoint[1])
        return setpoint


def _larger_part(change: FloatArray) -> float:
    """Return the larger norm of translation and rotation of a twist change.

    `speedl` applies the same number as rotational [rad/s²] and translational [m/s²] acceleration.
    """
    return float(max(np.linalg.norm(change[:3]), np.linalg.norm(change[3:])))


def require_stopping(arm: ArmDescription, q: FloatArray, v: FloatArray) -> None:
    """Raise if a joint could no longer stop within its limits.

    Raises:
        MotionImpossible: A joint would stop beyond its limit; the code is 150.
    """
    rest = q + v * np.abs(v) / (2.0 * LIMIT_BRAKE_RAD_S2)
    beyond = ((rest > arm.q_max) & (v > 0)) | ((rest < arm.q_min) & (v < 0))
    if beyond.any():
        raise out_of_range(arm, int(beyond.argmax()))


JOINTS_INSTEAD_RAD_S2 = 8.0
"""Joint deceleration if the tool cannot be stopped on a straight line [rad/s²]."""


class StopJoints:
    """Motion of URScript `stopj(a)`: the fastest joint decelerates with `a`, all in proportion.

    Args:
        deceleration: Deceleration of the fastest joint [rad/s²].
        tick_s: Device time of a tick [s].
    """

    def __init__(self, deceleration: float, tick_s: float) -> None:
        self._a, self._tick_s = deceleration, tick_s

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        """Return the next set-point; the speed slider does not delay a stop."""
        speed = float(np.abs(now[1]).max())
        if speed == 0.0:
            return None
        left = max(0.0, 1.0 - self._a * self._tick_s / speed)
        v = now[1] * left
        q = now[0] + 0.5 * (now[1] + v) * self._tick_s
        return np.stack((q, v, (v - now[1]) / self._tick_s))


class StopL:
    """Motion of URScript `stopl(a)`: the tool decelerates on its present line of motion.

    If the tool mainly rotates, the same number is its rotational deceleration [rad/s²]. Near a
    singularity the joints decelerate together instead, so a stop never fails.

    Args:
        arm: UR arm.
        tcp: Tool in the flange frame, (6,).
        deceleration: Tool deceleration [m/s²].
        tick_s: Device time of a tick [s].
    """

    def __init__(
        self, arm: ArmDescription, tcp: Numbers, deceleration: float, tick_s: float
    ) -> None:
        self._follower = ToolFollower(arm, tcp, tick_s)
        self._a, self._tick_s = deceleration, tick_s
        self._joints = StopJoints(JOINTS_INSTEAD_RAD_S2, tick_s)
        self._straight = True
        self._most = 0.0

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        """Return the next set-point; the speed slider does not delay a stop."""
        if self._straight:
            try:
                return self._on_the_line(now)
            except MotionImpossible:
                self._straight = False
        return self._joints.advance(now, scale)

    def _on_the_line(self, now: Setpoint) -> Setpoint | None:
        """Return the next set-point on the line.

        Raises:
            MotionImpossible: A joint would become faster than at the start of the stop.
        """
        fastest = float(np.abs(now[1]).max())
        if fastest == 0.0:
            return None
        self._most = self._most or fastest
        twist = np.array(self._follower.twist(now))
        speed = float(max(np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])))
        left = 1.0 - self._a * self._tick_s / speed if speed > 0.0 else 0.0
        if not left > 0.0:
            v = np.zeros(6)
            return np.array((now[0] + 0.5 * self._tick_s * now[1], v, -now[1] / self._tick_s))
        after = self._follower.drift(now, left * twist)
        if np.abs(after[1]).max() > self._most:
            raise MotionImpossible("the joints would get faster while the tool stops")
        return after


TOO_FAST = 1.001
"""Factor on a joint's speed limit that allows for rounding errors and the time step."""

FEW_RAD = 1e-3
"""Angle below which the exponential map is computed by its series [rad]."""


class ToolFollower:
    """Computation of the joint motion that moves the tool along a path.

    Args:
        arm: Arm with its lengths and speed limits.
        tcp: Tool in the flange frame, (6,).
        tick_s: Device time of a tick [s].
    """

    def __init__(self, arm: ArmDescription, tcp: Numbers, tick_s: float) -> None:
        self._arm, self._lengths = arm, lengths_of(arm)
        self._tool = frame_of(tcp)
        self._back = inverted(self._tool)
        self._tick_s = tick_s

    def setpoint(self, moment: Moment, anchor: FloatArray, pace: float, now: Setpoint) -> Setpoint:
        """Return the next set-point on a tool path.

        Args:
            moment: Position, velocity and acceleration on the path, in tool coordinates.
            anchor: Rotation vector of the frame in which the path rotation is defined, (3,).
            pace: Motion time per unit of device time.
            now: Present set-point.

        Raises:
            MotionImpossible: The path leads out of reach, or a joint would exceed its speed limit;
                the code is 154.
        """
        x, y, z, *turn = moment[0].tolist()
        held = frame_of((x, y, z, *anchor.tolist()))
        frame = compose(held, (*rotation_of(*turn), 0.0, 0.0, 0.0))
        q = nearest(self._arm, compose(frame, self._back), now[0])
        if q is None:
            raise MotionImpossible("the path of the tool leads out of reach", SINGULARITY)
        vx, vy, vz, *rates = (pace * moment[1]).tolist()
        spin = turned(held, *_spin(turn, rates))
        qd = self.joint_speeds(q, (vx, vy, vz, *spin))
        if (np.abs(q - now[0]) > TOO_FAST * self._arm.qd_max * self._tick_s).any():
            raise MotionImpossible("the joints would have to jump", SINGULARITY)
        return np.array((q, qd, (qd - now[1]) / self._tick_s))

    def joint_speeds(self, q: Numbers, twist: Numbers) -> FloatArray:
        """Return the joint speeds (6,) [rad/s] that move the tool with a twist (6,).

        Raises:
            MotionImpossible: No joint speeds give this twist, or a joint would exceed its speed
                limit; the code is 154.
        """
        J = np.array(self._jacobian(q)).reshape(6, 6)
        qd: FloatArray
        _, _, qd, singular = dgesv(J, np.array(twist))  # takes a third of numpy's time
        if singular:
            raise MotionImpossible("the tool cannot move in that direction", SINGULARITY)
        beyond = np.abs(qd) > TOO_FAST * self._arm.qd_max
        if beyond.any():
            joint = int(beyond.argmax())
            raise MotionImpossible(f"joint {joint + 1} cannot follow the tool", SINGULARITY)
        return qd

    def drift(self, now: Setpoint, twist: FloatArray) -> Setpoint:
        """Return the set-point after a tick at whose end the tool moves with a twist (6,).

        Raises:
            MotionImpossible: No permitted joint speeds give this twist; see `joint_speeds`.
        """
        ahead = now[0] + self._tick_s * now[1]
        qd = self.joint_speeds(ahead, twist)
        q = now[0] + 0.5 * self._tick_s * (now[1] + qd)
        return np.array((q, qd, (qd - now[1]) / self._tick_s))

    def twist(self, now: Setpoint) -> list[float]:
        """Return the velocity (6,) of the tool at a set-point, [m/s] and [rad/s]."""
        return twist_of(self._jacobian(now[0]), now[1])

    def _jacobian(self, q: Numbers) -> list[float]:
        posture = Posture(self._lengths, q)
        tool = compose(posture.flange, self._tool)
        return posture.jacobian((tool[9], tool[10], tool[11]))


def _spin(turn: list[float], rates: list[float]) -> Triple:
    """Return the angular velocity of a changing rotation vector (left Jacobian of SO(3))."""
    x, y, z = turn
    u, v, w = rates
    cx, cy, cz = y * w - z * v, z * u - x * w, x * v - y * u
    square = x * x + y * y + z * z
    if square < FEW_RAD**2:
        b, c = 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    else:
        angle = square**0.5
        b, c = (1.0 - cos(angle)) / square, (angle - sin(angle)) / (square * angle)
    return (
        u + b * cx + c * (y * cz - z * cy),
        v + b * cy + c * (z * cx - x * cz),
        w + b * cz + c * (x * cy - y * cx),
    )
