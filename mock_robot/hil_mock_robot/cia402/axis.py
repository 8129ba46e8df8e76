"""One axis: what all parts of a drive work on.

`Axis` holds the live registers, their scale at the joint, what was measured last and where the
set-point is. `Ramp`, `Trapezoid` and `Between` are the ways a set-point goes, step by step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hil.arms import ArmDescription
from hil.core import FloatArray
from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.body import STEP_S, Measured
from hil_mock_robot.cia402.keys import Registers

TURN = 2.0 * math.pi
PER_MILLE = 1000.0

POSITION_BIT, VELOCITY_BIT, TORQUE_BIT = 0x80, 0x40, 0x20
"""607Eh: counts against the motor. CiA 402 leaves bit 5 to vendors; ours is of this kind."""

INT16, INT32 = (-(1 << 15), (1 << 15) - 1), (-(1 << 31), (1 << 31) - 1)

SCALING = frozenset(
    {
        keys.POLARITY, keys.ENCODER_INCREMENTS, keys.ENCODER_REVOLUTIONS, keys.GEAR_MOTOR,
        keys.GEAR_SHAFT, keys.RATED_CURRENT, keys.RATED_TORQUE,
    }
)  # fmt: skip
"""Objects that `Axis.rescale` reads."""


@dataclass(frozen=True, slots=True)
class Joint:
    """Properties of the joint of a drive, beside its objects.

    Attributes:
        name: For messages.
        qd_max: Highest speed [rad/s]; a good deal more is a fault.
        qdd_max: Strongest deceleration, where an option code asks for it [rad/s²].
        effort_max: Most torque the drive can give, at the joint [N·m].
    """

    name: str
    qd_max: float
    qdd_max: float
    effort_max: float


def joints_of(arm: ArmDescription) -> tuple[Joint, ...]:
    """The joints of an arm."""
    columns = arm.joint_names, arm.qd_max, arm.qdd_max, arm.effort_max
    return tuple(
        Joint(name, float(v), float(a), float(e)) for name, v, a, e in zip(*columns, strict=True)
    )


POWERS = {exponent: 10.0**exponent for exponent in range(-6, 1)}
"""Of ten, by the index in 60C2h:2."""

LONGEST_PERIOD_S = 1.0
MOST_STEPS = round(LONGEST_PERIOD_S / STEP_S)


class Axis:
    """One axis as its modes see it.

    Attributes:
        registers, joint: As given.
        counts: Increments per radian of the joint, with the sign of position.
        speed_counts: Increments/s per rad/s, with the sign of velocity.
        torque_counts: ‰ of rated torque per N·m at the joint, with the sign of torque.
        current_counts: ‰ of rated current per ampere, with the sign of torque.
        shift: Increments that homing has added to the position.
        q, qd: Measured last [rad], [rad/s].
        demand_q, demand_qd: Where the set-point is at the end of the last block [rad], [rad/s].
        slipped: Increments that the set-point has jumped away from the joint (injected).
        limited: A set-point was cut to what is allowed, in the last block.
        missed: SYNCs since the last RPDO with a set-point, where RPDOs bring them.
        rhythm_set: Whether a client has written 60C2h since the last reset.
    """

    __slots__ = (
        "counts", "current_counts", "demand_q", "demand_qd", "joint", "limited", "missed",
        "q", "qd", "registers", "rhythm_set", "shift", "slipped", "speed_counts", "torque_counts",
    )  # fmt: skip

    def __init__(self, registers: Registers, joint: Joint) -> None:
        self.registers, self.joint = registers, joint
        self.q = self.qd = self.demand_q = self.demand_qd = 0.0
        self.shift = self.slipped = 0
        self.missed = 0
        self.limited = self.rhythm_set = False
        self.rescale()

    def rescale(self) -> None:
        """Update from the scaling objects."""
        objects = self.registers
        polarity = objects.get(keys.POLARITY, 0)
        encoder = objects[keys.ENCODER_INCREMENTS] / objects[keys.ENCODER_REVOLUTIONS]
        gear = objects[keys.GEAR_MOTOR] / objects[keys.GEAR_SHAFT]
        counts = encoder * gear / TURN
        per_nm = PER_MILLE / (objects[keys.RATED_TORQUE] * 1e-3 * gear)
        per_a = PER_MILLE / (objects[keys.RATED_CURRENT] * 1e-3)
        self.counts = _signed(counts, polarity & POSITION_BIT)
        self.speed_counts = _signed(counts, polarity & VELOCITY_BIT)
        self.torque_counts = _signed(per_nm, polarity & TORQUE_BIT)
        self.current_counts = _signed(per_a, polarity & TORQUE_BIT)

    def stay(self) -> None:
        """Make where the joint is the set-point, at rest."""
        self.demand_q, self.demand_qd = self.q, 0.0

    def raw_position(self, q: float) -> int:
        """Increments of a joint angle [rad], wrapped to 32 bits."""
        raw = round(q * self.counts) + self.shift
        return raw if -0x8000_0000 <= raw <= 0x7FFF_FFFF else wrapped(raw)

    def target(self, raw: int) -> float:
        """Joint angle [rad] of a target in increments, cut to the position limits (607Dh)."""
        objects = self.registers
        low, high = objects[keys.POSITION_LIMIT_MIN], objects[keys.POSITION_LIMIT_MAX]
        if low < high and not low <= raw <= high:
            self.limited = True
            raw = low if raw < low else high
        return (raw - self.shift) / self.counts

    def inside(self, q: float) -> float:
        """A joint angle [rad], cut to the position limits (607Dh)."""
        return self.target(round(q * self.counts) + self.shift)

    @property
    def torque_limit_counts(self) -> int:
        """‰ of rated torque that the drive may give; of 6072h, 60E0h and 60E1h the least."""
        objects = self.registers
        return min(
            objects[keys.MAX_TORQUE],
            objects[keys.POSITIVE_TORQUE_LIMIT],
            objects[keys.NEGATIVE_TORQUE_LIMIT],
        )

    @property
    def torque_limit(self) -> float:
        """The same at the joint [N·m]."""
        return abs(self.torque_limit_counts / self.torque_counts)

    def deceleration(self, option: int) -> float:
        """How hard an option code (605Ah, 605Ch to 605Eh) wants it to brake [rad/s²].

        1 and 5: 6084h; 2 and 6: 6085h; else all that the joint can.
        """
        by_option = {1: keys.PROFILE_DECELERATION, 2: keys.QUICK_STOP_DECELERATION}
        where = by_option.get(option % 4)
        raw = self.registers[where] if where is not None else 0
        return raw / abs(self.counts) if raw else self.joint.qdd_max

    @property
    def period_steps(self) -> int:
        """Steps from SYNC to SYNC, over which set-points are interpolated.

        By 60C2h as it was written; by 1006h where it never was, or else by 60C2h's default.
        """
        objects = self.registers
        micros = objects[keys.CYCLE_PERIOD]
        if micros and not self.rhythm_set:
            seconds = micros * 1e-6
        else:
            power = POWERS.get(objects[keys.INTERPOLATION_INDEX], 0.0)
            seconds = objects[keys.INTERPOLATION_VALUE] * power
        return min(MOST_STEPS, max(1, round(seconds / STEP_S)))


def _signed(value: float, against: int) -> float:
    return -value if against else value


def wrapped(raw: int) -> int:
    """An integer as it comes out of 32 bits with sign."""
    return (raw + 0x8000_0000) % 0x1_0000_0000 - 0x8000_0000


def within(value: int, ends: tuple[int, int]) -> int:
    """`value`, not beyond either end."""
    least, most = ends
    return least if value < least else most if value > most else value


DC_LINK_MV = 325_000

SAG_MV_PER_W = 10.0
"""What the DC link loses (or gains) by the power that one axis takes (or gives back)."""


def write_readings(axis: Axis, measured: Measured) -> int:
    """Write 6062h, 6064h, 606Bh, 606Ch, 6074h, 6077h to 6079h, 60F4h and 2110h.

    6077h is the current times the drive's own torque constant, as in most drives: not measured.

    Returns:
        The following error (60F4h) [increments].
    """
    objects = axis.registers
    torque = within(round(measured.torque * axis.torque_counts), INT16)
    position = axis.raw_position(measured.q)
    demand = wrapped(axis.raw_position(axis.demand_q) + axis.slipped)
    error = wrapped(demand - position)
    objects[keys.POSITION], objects[keys.POSITION_DEMAND] = position, demand
    objects[keys.FOLLOWING_ERROR] = error
    objects[keys.VELOCITY] = within(round(measured.qd * axis.speed_counts), INT32)
    objects[keys.VELOCITY_DEMAND] = within(round(axis.demand_qd * axis.speed_counts), INT32)
    objects[keys.TORQUE] = objects[keys.TORQUE_DEMAND] = torque
    objects[keys.CURRENT] = within(round(measured.current * axis.current_counts), INT16)
    objects[keys.DC_LINK_VOLTAGE] = DC_LINK_MV - round(SAG_MV_PER_W * measured.torque * measured.qd)
    objects[keys.MOTOR_TEMPERATURE] = round(10.0 * measured.celsius)
    return error


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


def rows_at_rest(q: float, steps: int) -> FloatArray:
    """Return (N, 3) set-points at rest at `q` [rad]."""
    rows = np.zeros((steps, 3))
    rows[:, 0] = q
    return rows
