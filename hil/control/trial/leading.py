"""A hand that leads an arm joint by joint, then lets go: what that takes, and where the arm ends.

The hand is a spring and a damper at every joint, firm enough to carry the arm when the drives give
nothing. What it costs is the torque of that spring while its joint is led.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hil.control.trial.arm import RATE_HZ, Arm
from hil.control.trial.gains import Spring
from hil.control.trial.reference import SETTLE_S, Leading
from hil.core import FloatArray

Drives = Callable[[FloatArray, FloatArray], FloatArray]
"""Torque (n,) [N·m] from position and velocity."""

NOTHING, DATASHEET = "drives off", "datasheet gravity"
GRAVITY, FRICTION = "gravity", "gravity and friction"
OF_THE_MODEL = (GRAVITY, FRICTION)

HAND_FIRMNESS = 2.0
"""Times the bandwidth of the trial's controller."""

MOST_STRAY_RAD = 0.6
"""Further from the hand the arm is braked."""

ALONE_S = 3.0
"""It is watched after the hand has let go."""

AT_REST_RAD_S = 0.005


@dataclass(frozen=True, slots=True, eq=False)
class Led:
    """One run.

    Attributes:
        way: What the drives gave.
        turn_s: How long each joint was led, one after the other [s].
        t: (N,) time while it was led [s].
        effort: (N, n) torque of the hand [N·m].
        q: (N, n) where the arm was [rad].
        ran_on: (n,) how far joints went on after the hand had let go [rad].
        rest_s: When all joints were at rest, after that [s]; infinite when never.
        stopped: Why the arm was braked; empty when it was not.
    """

    way: str
    turn_s: float
    t: FloatArray
    effort: FloatArray
    q: FloatArray
    ran_on: FloatArray
    rest_s: float
    stopped: str = ""

    @property
    def rms(self) -> FloatArray:
        """(n,) effort of the hand at each joint while that is led [N·m]."""
        return self._own_turn(lambda rows: float(np.sqrt(np.mean(rows**2))))

    @property
    def peak(self) -> FloatArray:
        """(n,) largest effort of the hand at each joint while that is led [N·m]."""
        return self._own_turn(lambda rows: float(np.abs(rows).max()))

    @property
    def turn(self) -> FloatArray:
        """(N,) which joint was led, n and more for all."""
        return np.floor(self.t / self.turn_s)

    def _own_turn(self, figure: Callable[[FloatArray], float]) -> FloatArray:
        n = self.effort.shape[1]
        if self.stopped:
            return np.full(n, np.nan)
        return np.array([figure(self.effort[self.turn == j, j]) for j in range(n)])


def lead(arm: Arm, way: str, drives: Drives | None, leading: Leading, hand: Spring) -> Led:
    """Lead an arm along a way, and let it go while it moves.

    Args:
        arm: At rest at the beginning of the way.
        way: Name of what the drives give.
        drives: That; None for nothing, and brakes when the hand lets go.
        leading: The way.
        hand: How firm the hand is.
    """
    still = np.zeros_like(leading.start)
    give = drives or (lambda q, qd: still)
    efforts, places, stopped = [], [], ""
    t = np.arange(1 - round(SETTLE_S * RATE_HZ), round(leading.release_s * RATE_HZ)) / RATE_HZ
    for now in t:
        q, qd = leading.at(float(now))
        effort = hand.torque(q - arm.q, qd - arm.qd)
        going = arm.step(give(arm.q, arm.qd), effort)
        efforts.append(effort)
        places.append(arm.q)
        if not going or np.abs(q - arm.q).max() > MOST_STRAY_RAD:
            arm.brake()
            stopped = f"the arm strayed from the hand at {now:.2f} s"
            break
    led = t[: len(efforts)] >= 0
    pieces = (t[: len(efforts)][led], np.array(efforts)[led], np.array(places)[led])
    if stopped:
        return Led(way, leading.turn_s, *pieces, np.full_like(still, np.nan), float("inf"), stopped)
    return Led(way, leading.turn_s, *pieces, *_let_go(arm, drives))


def _let_go(arm: Arm, drives: Drives | None) -> tuple[FloatArray, float, str]:
    """(n,) how far the joints ran on, when they were at rest, and why the arm was braked."""
    released, rest_s, stopped = arm.q.copy(), float("inf"), ""
    if drives is None:
        arm.brake()
    for k in range(round(ALONE_S * RATE_HZ)):
        if drives is None or stopped:
            arm.wait()
        elif not arm.step(drives(arm.q, arm.qd)):
            stopped = "it ran away when the hand had let go"
        moving = np.abs(arm.qd).max() > AT_REST_RAD_S
        rest_s = float("inf") if moving else min(rest_s, k / RATE_HZ)
    return np.abs(arm.q - released), rest_s, stopped
