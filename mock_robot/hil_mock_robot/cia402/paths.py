"""Where a set-point goes, step by step of `STEP_S`: between targets, to rest, to a position."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from hil.core import FloatArray
from hil_mock_robot.cia402.contracts import STEP_S


class Ramp:
    """To rest, with a constant deceleration.

    Args:
        q, qd: Where it begins [rad], [rad/s].
        deceleration: [rad/s²].

    Attributes:
        q, qd: Where it is.
    """

    def __init__(self, q: float, qd: float, deceleration: float) -> None:
        self.q, self.qd, self._deceleration = q, qd, deceleration

    @property
    def done(self) -> bool:
        """Whether it is at rest."""
        return self.qd == 0.0

    def advance(self, steps: int) -> FloatArray:
        """(N, 3) position, velocity, acceleration at the end of each step."""
        rows = np.zeros((steps, 3))
        rows[:, 0] = self.q
        for row in rows:
            before = self.qd
            if before == 0.0:
                row[0] = self.q
                continue
            speed = max(0.0, abs(before) - self._deceleration * STEP_S)
            self.qd = math.copysign(speed, before) if speed else 0.0
            self.q += 0.5 * (before + self.qd) * STEP_S
            row[:] = self.q, self.qd, (self.qd - before) / STEP_S
        return rows


class Trapezoid:
    """To a position and to rest there, with limits of speed, acceleration and deceleration.

    Args:
        q, qd: Where it begins [rad], [rad/s].
        target: [rad].
        limits: Speed [rad/s], acceleration and deceleration [rad/s²].

    Attributes:
        q, qd: Where it is.
        target, limits: As given; they can be changed on the way.
    """

    def __init__(
        self, q: float, qd: float, target: float, limits: tuple[float, float, float]
    ) -> None:
        self.q, self.qd, self.target, self.limits = q, qd, target, limits

    @property
    def done(self) -> bool:
        """Whether it is at the target, at rest."""
        return self.q == self.target and self.qd == 0.0

    def advance(self, steps: int) -> FloatArray:
        """(N, 3) position, velocity, acceleration at the end of each step."""
        rows = np.empty((steps, 3))
        for row in rows:
            before = self.qd
            self._step()
            row[:] = self.q, self.qd, (self.qd - before) / STEP_S
        return rows

    def _step(self) -> None:
        top, up, down = self.limits
        way = self.target - self.q
        # From this speed it comes to rest on the way that is left after this step.
        most = min(
            top, down * STEP_S * 0.5 * (math.sqrt(1 + 8 * abs(way) / (down * STEP_S**2)) - 1)
        )
        wanted = math.copysign(most, way)
        rate = down if abs(wanted) < abs(self.qd) or wanted * self.qd < 0.0 else up
        change = wanted - self.qd
        self.qd += math.copysign(min(abs(change), rate * STEP_S), change)
        moved = self.qd * STEP_S
        if abs(way - moved) < 1e-9 or abs(way) <= 0.5 * down * STEP_S**2:
            self.q, self.qd = self.target, 0.0
        else:
            self.q += moved


class Between:
    """From target to target, one per SYNC: a cubic that arrives with the next.

    The speed at a target is that of the parabola through it and the two before: causal, and
    without the ripple that straight lines between targets put on the torque. When no target
    comes any more, the set-point is brought to rest.

    Args:
        q, qd: Where it begins [rad], [rad/s].

    Attributes:
        q, qd: Where it is.
    """

    def __init__(self, q: float, qd: float) -> None:
        self.q, self.qd = q, qd
        self._way = 0.0
        self._path: FloatArray | None = None
        self._at = 0

    def go_on(self, steps: int, within: Callable[[float], float]) -> None:
        """No target has come: go on at the present speed for that many steps.

        Args:
            steps: Of `STEP_S`.
            within: Cuts a position [rad] to what is allowed.
        """
        self._way = self.qd * steps * STEP_S
        self.aim(within(self.q + self._way), steps)

    def aim(self, target: float, steps: int) -> None:
        """Be at `target` [rad] after that many steps."""
        before, self._way = self._way, target - self.q
        period = steps * STEP_S
        after = 0.5 * (3.0 * self._way - before) / period if self._way else 0.0
        path = (hermite(steps) @ (self.qd, self._way, after)).reshape(steps, 3)
        path[:, 0] += self.q
        self._path, self._at = path, 0

    def advance(self, steps: int, deceleration: float) -> FloatArray:
        """(N, 3) position, velocity, acceleration at the end of each step."""
        path = self._path
        if path is None:
            return self._to_rest(steps, deceleration)
        end = self._at + steps
        rows = path[self._at : end]
        self._at = end
        left = len(path) - end
        self.q, self.qd = rows[-1, :2].tolist()
        if left <= 0:
            self._path = None
        if left < 0:
            rows = np.concatenate((rows, self._to_rest(-left, deceleration)))
        return rows

    def _to_rest(self, steps: int, deceleration: float) -> FloatArray:
        self._way = 0.0
        ramp = Ramp(self.q, self.qd, deceleration)
        rows = ramp.advance(steps)
        self.q, self.qd = ramp.q, ramp.qd
        return rows


@lru_cache(maxsize=16)
def hermite(steps: int) -> FloatArray:
    """(3N, 3): position, velocity, acceleration at each of N steps, of a cubic.

    Columns: speed at its beginning, way, speed at its end.
    """
    period = steps * STEP_S
    s = np.arange(1, steps + 1) / steps
    basis = np.empty((steps, 3, 3))
    basis[:, 0] = np.stack(
        ((s - 2 * s**2 + s**3) * period, 3 * s**2 - 2 * s**3, (s**3 - s**2) * period), axis=1
    )
    basis[:, 1] = np.stack((1 - 4 * s + 3 * s**2, (6 * s - 6 * s**2) / period, 3 * s**2 - 2 * s), 1)
    basis[:, 2] = np.stack(
        ((6 * s - 4) / period, (6 - 12 * s) / period**2, (6 * s - 2) / period), axis=1
    )
    return basis.reshape(3 * steps, 3)


def held(q: float, steps: int) -> FloatArray:
    """(N, 3) at rest at `q` [rad]."""
    rows = np.zeros((steps, 3))
    rows[:, 0] = q
    return rows
