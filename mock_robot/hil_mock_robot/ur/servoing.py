"""Motions that a program aims anew in every tick: `servoj`, `speedj`, `speedl`."""

from __future__ import annotations

from math import exp, sqrt

import numpy as np

from hil.arms import ArmDescription
from hil.core import FloatArray
from hil_mock_robot.ur.blends import Size, joint_size
from hil_mock_robot.ur.contracts import Setpoint
from hil_mock_robot.ur.following import ToolFollower
from hil_mock_robot.ur.limits import out_of, require_finite, require_within
from hil_mock_robot.ur.poses import Numbers
from hil_mock_robot.ur.stopping import StopJoints, StopL

__all__ = ["ServoJ", "SpeedJ", "SpeedL", "StopL"]

FASTEST_RAD_S = np.pi
"""Of an arm that is not named."""
STEEPEST_RAD_S2 = 40.0
"""`servoj` speeds up no harder than this; it is what clients may ask of a move at most."""
LOOKAHEAD_S, GAIN = (0.03, 0.2), (100.0, 2000.0)
USUAL_GAIN = 300.0
ARRIVED_RAD, RESTING_RAD_S = 1e-7, 1e-6
BRAKE_RAD_S2 = 8.0
"""How hard an arm that comes near its joint limits will be stopped: see `Machine`."""


class ServoJ:
    """URScript `servoj`: the joints follow a target that a program moves tick by tick.

    A critically damped second-order filter for each joint, which lags behind a steady target by
    `lookahead · √(300 / gain)` and never swings beyond a target that stands still. It speeds up
    with at most 40 rad/s² and gets as fast as the arm can, times the speed slider; how hard it
    brakes follows from the filter. The real one's law is not published.

    Args:
        tick_s: Device time of a tick.
        arm: Whose limits hold; None for π rad/s and any position.
    """

    def __init__(self, tick_s: float, arm: ArmDescription | None = None) -> None:
        self._tick_s, self._arm = tick_s, arm
        self._fastest = np.full(6, FASTEST_RAD_S) if arm is None else arm.qd_max
        self._target: FloatArray | None = None
        self._ticks_left = 0.0
        self._rate = 0.0
        self._share: float | None = None

    def aim(self, q: Numbers, time_s: float, lookahead_s: float, gain: float) -> None:
        """Follow this target (6,) [rad] for `time_s`; after that it is where the arm comes to rest.

        Args:
            q: (6,) [rad].
            time_s: [s].
            lookahead_s: 0.03 to 0.2 [s]; what lies outside counts as the nearest of these.
            gain: 100 to 2000, likewise.
        """
        self._target = np.array((*q, time_s, lookahead_s, gain), dtype=np.float64)
        self._ticks_left = max(1.0, time_s / self._tick_s)
        lookahead = min(max(LOOKAHEAD_S[0], lookahead_s), LOOKAHEAD_S[1])
        self._rate = 2.0 / lookahead * sqrt(min(max(GAIN[0], gain), GAIN[1]) / USUAL_GAIN)

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        """See `Motion`; over when the aims have stopped and the last one is reached.

        Raises:
            MotionImpossible: With code 150 for a target beyond the joint limits, 204 for none.
        """
        if self._target is None:
            return StopJoints(BRAKE_RAD_S2, self._tick_s).advance(now, scale)
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
        """Let the speed limit follow the slider no harder than the arm brakes."""
        step = BRAKE_RAD_S2 * self._tick_s / float(self._fastest.max())
        before = scale if self._share is None else self._share
        self._share = min(max(scale, before - step), before + step)

    def _filtered(self, away: FloatArray, q: FloatArray, v: FloatArray) -> Setpoint:
        """One tick of x'' = -w²·x - 2w·x', exactly; errors too large for the speed are cut."""
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
    """URScript `speedj`: to a speed with an acceleration, then on and on.

    Args:
        tick_s: Device time of a tick.
        arm: Whose limits hold; None for any.
    """

    def __init__(self, tick_s: float, arm: ArmDescription | None = None) -> None:
        self._tick_s, self._arm = tick_s, arm
        self._speed, self._a = np.zeros(6), 1.0

    def aim(self, qd: Numbers, a: float) -> None:
        """Turn with `qd` (6,) [rad/s]; the joint that has most to change does it with `a`."""
        self._speed, self._a = np.array(qd, dtype=np.float64), abs(a) or 1.0
        if self._arm is not None:
            self._speed /= max(1.0, float((np.abs(self._speed) / self._arm.qd_max).max()))

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        """See `Motion`; the slider slows the speed that is aimed at. Never over by itself.

        Raises:
            MotionImpossible: With code 150 when a joint could hardly stop within its limits.
        """
        require_finite(self._speed, self._a)
        v = _towards(now[1], scale * self._speed, self._a * self._tick_s, joint_size)
        q = now[0] + 0.5 * self._tick_s * (now[1] + v)
        if self._arm is not None:
            require_stopping(self._arm, q, v)
        return np.array((q, v, (v - now[1]) / self._tick_s))


class SpeedL:
    """URScript `speedl`: the tool to a velocity with an acceleration, then on and on.

    Args:
        arm: A UR arm.
        tcp: (6,) tool in the flange frame.
        tick_s: Device time of a tick.
    """

    def __init__(self, arm: ArmDescription, tcp: Numbers, tick_s: float) -> None:
        self._arm, self._tick_s = arm, tick_s
        self._follower = ToolFollower(arm, tcp, tick_s)
        self._speed, self._a = np.zeros(6), 1.0
        self._twist: FloatArray | None = None

    def aim(self, xd: Numbers, a: float) -> None:
        """Move with `xd` (6,) [m/s, rad/s] in the base frame; speed up with `a` [m/s², rad/s²]."""
        self._speed, self._a = np.array(xd, dtype=np.float64), abs(a) or 1.0

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        """See `SpeedJ.advance`.

        Raises:
            MotionImpossible: With code 150 near joint limits, 154 near a singularity.
        """
        require_finite(self._speed, self._a)
        if self._twist is None:
            self._twist = np.array(self._follower.twist(now))
        goal, step = scale * self._speed, self._a * self._tick_s
        self._twist = _towards(self._twist, goal, step, _larger_part)
        setpoint = self._follower.drift(now, self._twist)
        require_stopping(self._arm, setpoint[0], setpoint[1])
        return setpoint


def require_stopping(arm: ArmDescription, q: FloatArray, v: FloatArray) -> None:
    """Refuse to go on where no joint may be unable to stop within its limits any more.

    Raises:
        MotionImpossible: With code 150.
    """
    rest = q + v * np.abs(v) / (2.0 * BRAKE_RAD_S2)
    beyond = ((rest > arm.q_max) & (v > 0)) | ((rest < arm.q_min) & (v < 0))
    if beyond.any():
        raise out_of(arm, int(beyond.argmax()))


def _towards(now: FloatArray, goal: FloatArray, most: float, size: Size) -> FloatArray:
    """All components change in proportion, by a change of at most this size."""
    change = goal - now
    whole = size(change)
    return goal if whole <= most else now + change * (most / whole)


def _larger_part(change: FloatArray) -> float:
    """Of a twist: `speedl` speeds up its turn with as many rad/s² as its way with m/s²."""
    return float(max(np.linalg.norm(change[:3]), np.linalg.norm(change[3:])))
