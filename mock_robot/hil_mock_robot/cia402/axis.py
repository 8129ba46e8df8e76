"""Data of one mock axis, shared by all parts of its drive, and set-point generators.

`Axis` contains the live registers, their scaling at the joint, the last measurements and the
present set-point. `Ramp`, `Trapezoid` and `Between` generate the set-points of an axis step by
step.
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
"""Polarity bits (607Eh) that reverse the sign of position, velocity and torque.

CiA 402 leaves the meaning of bit 5 to the manufacturers; the mock drives use it for torque.
"""

INT16, INT32 = (-(1 << 15), (1 << 15) - 1), (-(1 << 31), (1 << 31) - 1)

SCALING = frozenset(
    {
        keys.POLARITY, keys.ENCODER_INCREMENTS, keys.ENCODER_REVOLUTIONS, keys.GEAR_MOTOR,
        keys.GEAR_SHAFT, keys.RATED_CURRENT, keys.RATED_TORQUE,
    }
)  # fmt: skip
"""Keys of the objects from which `Axis.rescale` computes the scales."""


@dataclass(frozen=True, slots=True)
class Joint:
    """Properties of a drive's joint that are not objects of the drive.

    Attributes:
        name: Name of the joint, used in messages.
        qd_max: Maximum speed [rad/s]; a speed far above `qd_max` is a fault.
        qdd_max: Maximum deceleration [rad/s²], used if an option code requires it.
        effort_max: Maximum torque of the drive at the joint [N·m].
    """

    name: str
    qd_max: float
    qdd_max: float
    effort_max: float


def joints_of(arm: ArmDescription) -> tuple[Joint, ...]:
    """Return the properties of all joints of an arm."""
    columns = arm.joint_names, arm.qd_max, arm.qdd_max, arm.effort_max
    return tuple(
        Joint(name, float(v), float(a), float(e)) for name, v, a, e in zip(*columns, strict=True)
    )


POWERS = {exponent: 10.0**exponent for exponent in range(-6, 1)}
"""Powers of ten for the exponents that 60C2h:2 can contain."""

LONGEST_PERIOD_S = 1.0
MOST_STEPS = round(LONGEST_PERIOD_S / STEP_S)


class Axis:
    """State of one axis, which its modes of operation read and change.

    Attributes:
        registers: Live objects of the drive.
        joint: Properties of the joint.
        counts: Position scale, with its sign [increments/rad].
        speed_counts: Velocity scale, with its sign [increments/s per rad/s].
        torque_counts: Torque scale at the joint, with its sign [‰ of rated torque per N·m].
        current_counts: Current scale, with the sign of torque [‰ of rated current per A].
        shift: Increments added to the position by homing.
        q: Position of the joint at the last measurement [rad].
        qd: Speed of the joint at the last measurement [rad/s].
        demand_q: Set-point of the position at the end of the last block [rad].
        demand_qd: Set-point of the speed at the end of the last block [rad/s].
        slipped: Jump of the set-point away from the joint [increments], injected by a fault.
        limited: Whether a set-point of the last block was limited.
        missed: Number of SYNCs since the last RPDO with a set-point; counted only if RPDOs contain
            set-points.
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
        """Compute the scales from the scaling objects of the drive."""
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
        """Set the set-point to the measured position with speed 0."""
        self.demand_q, self.demand_qd = self.q, 0.0

    def raw_position(self, q: float) -> int:
        """Return the increments of a joint angle [rad], wrapped to 32 bits."""
        raw = round(q * self.counts) + self.shift
        return raw if -0x8000_0000 <= raw <= 0x7FFF_FFFF else wrapped(raw)

    def target(self, raw: int) -> float:
        """Return the joint angle [rad] of a target in increments, limited to 607Dh."""
        objects = self.registers
        low, high = objects[keys.POSITION_LIMIT_MIN], objects[keys.POSITION_LIMIT_MAX]
        if low < high and not low <= raw <= high:
            self.limited = True
            raw = low if raw < low else high
        return (raw - self.shift) / self.counts

    def inside(self, q: float) -> float:
        """Return a joint angle [rad], limited to the position limits (607Dh)."""
        return self.target(round(q * self.counts) + self.shift)

    @property
    def torque_limit_counts(self) -> int:
        """Torque limit of the drive [‰ of rated torque]: minimum of 6072h, 60E0h and 60E1h."""
        objects = self.registers
        return min(
            objects[keys.MAX_TORQUE],
            objects[keys.POSITIVE_TORQUE_LIMIT],
            objects[keys.NEGATIVE_TORQUE_LIMIT],
        )

    @property
    def torque_limit(self) -> float:
        """Torque limit of the drive at the joint [N·m]."""
        return abs(self.torque_limit_counts / self.torque_counts)

    def deceleration(self, option: int) -> float:
        """Return the deceleration [rad/s²] that an option code selects (605Ah, 605Ch to 605Eh).

        Option codes 1 and 5 select 6084h, option codes 2 and 6 select 6085h. All other codes select
        the maximum deceleration of the joint.
        """
        by_option = {1: keys.PROFILE_DECELERATION, 2: keys.QUICK_STOP_DECELERATION}
        where = by_option.get(option % 4)
        raw = self.registers[where] if where is not None else 0
        return raw / abs(self.counts) if raw else self.joint.qdd_max

    @property
    def period_steps(self) -> int:
        """Number of steps from SYNC to SYNC, over which set-points are interpolated.

        If a client has written 60C2h, the period is 60C2h. If no client has written 60C2h, the
        period is 1006h if it is not 0, else the default of 60C2h.
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
    """Return an integer wrapped to a signed 32-bit integer."""
    return (raw + 0x8000_0000) % 0x1_0000_0000 - 0x8000_0000


def within(value: int, ends: tuple[int, int]) -> int:
    """Return `value`, limited to the range between the two `ends`."""
    least, most = ends
    return least if value < least else most if value > most else value


DC_LINK_MV = 325_000

SAG_MV_PER_W = 10.0
"""Voltage drop of the DC link per motor power [mV/W]; a braking motor raises the voltage."""


def write_readings(axis: Axis, measured: Measured) -> int:
    """Write measurements to 6062h, 6064h, 606Bh, 606Ch, 6074h, 6077h to 6079h, 60F4h, 2110h.

    As in most drives, the torque (6077h) is not measured but computed: motor current times torque
    constant of the drive.

    Returns:
        Following error (60F4h) [increments].
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
    """Set-point generator that decelerates to rest at a constant rate.

    Args:
        q: Initial position [rad].
        qd: Initial speed [rad/s].
        deceleration: Deceleration [rad/s²].

    Attributes:
        q: Present position [rad].
        qd: Present speed [rad/s].
    """

    def __init__(self, q: float, qd: float, deceleration: float) -> None:
        self.q, self.qd, self._deceleration = q, qd, deceleration

    @property
    def done(self) -> bool:
        """Whether the set-point has reached speed 0."""
        return self.qd == 0.0

    def advance(self, steps: int) -> FloatArray:
        """Return (N, 3) position, speed, acceleration of the set-point at the end of each step."""
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
    """Set-point generator that moves to rest at a target, with trapezoidal speed.

    Args:
        q: Initial position [rad].
        qd: Initial speed [rad/s].
        target: Target position [rad].
        limits: Maximum speed [rad/s], acceleration and deceleration [rad/s²].

    Attributes:
        q: Present position [rad].
        qd: Present speed [rad/s].
        target: Target position [rad], which can be changed during the motion.
        limits: Maximum speed [rad/s], acceleration and deceleration [rad/s²], which can be changed
            during the motion.
    """

    def __init__(
        self, q: float, qd: float, target: float, limits: tuple[float, float, float]
    ) -> None:
        self.q, self.qd, self.target, self.limits = q, qd, target, limits

    @property
    def done(self) -> bool:
        """Whether the set-point is at rest at the target."""
        return self.q == self.target and self.qd == 0.0

    def advance(self, steps: int) -> FloatArray:
        """Return (N, 3) position, speed, acceleration of the set-point at the end of each step."""
        rows = np.empty((steps, 3))
        for row in rows:
            before = self.qd
            self._step()
            row[:] = self.q, self.qd, (self.qd - before) / STEP_S
        return rows

    def _step(self) -> None:
        top, up, down = self.limits
        way = self.target - self.q
        # Highest speed from which the axis can stop on the distance left after this step.
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
    """Set-point generator that interpolates between the targets of two SYNCs by a cubic.

    The speed at a target is the speed of the parabola through this target and the two targets
    before. With this rule, the speed of the set-point depends only on past targets, and straight
    lines between targets with their torque ripple are avoided. If no further target arrives, the
    set-point decelerates to rest.

    Args:
        q: Initial position [rad].
        qd: Initial speed [rad/s].

    Attributes:
        q: Present position [rad].
        qd: Present speed [rad/s].
    """

    def __init__(self, q: float, qd: float) -> None:
        self.q, self.qd = q, qd
        self._way = 0.0
        self._path: FloatArray | None = None
        self._at = 0

    def go_on(self, steps: int, within: Callable[[float], float]) -> None:
        """Continue at the present speed for a number of steps, because no target has arrived.

        Args:
            steps: Number of steps of `STEP_S`.
            within: Function that limits a position [rad] to the permitted range.
        """
        self._way = self.qd * steps * STEP_S
        self.aim(within(self.q + self._way), steps)

    def aim(self, target: float, steps: int) -> None:
        """Plan the path that reaches `target` [rad] after `steps` steps."""
        before, self._way = self._way, target - self.q
        period = steps * STEP_S
        after = 0.5 * (3.0 * self._way - before) / period if self._way else 0.0
        path = (hermite(steps) @ (self.qd, self._way, after)).reshape(steps, 3)
        path[:, 0] += self.q
        self._path, self._at = path, 0

    def advance(self, steps: int, deceleration: float) -> FloatArray:
        """Return (N, 3) position, speed, acceleration of the set-point at the end of each step."""
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
    """Return the (3N, 3) matrix of position, velocity, acceleration at N steps of a cubic.

    The columns of the matrix are the coefficients of the initial speed, the distance and the final
    speed.
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
    """Return N set-points (N, 3) with position `q` [rad] and speed 0."""
    rows = np.zeros((steps, 3))
    rows[:, 0] = q
    return rows
