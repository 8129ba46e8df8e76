"""What all of a drive works on: its registers, their meaning at the joint, what was measured."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hil.arms import ArmDescription
from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.contracts import STEP_S, Registers

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
    """What a drive knows of the joint it turns, beside its objects.

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
        rhythm_told: A client has written 60C2h since the last reset.
    """

    __slots__ = (
        "counts", "current_counts", "demand_q", "demand_qd", "joint", "limited", "missed",
        "q", "qd", "registers", "rhythm_told", "shift", "slipped", "speed_counts", "torque_counts",
    )  # fmt: skip

    def __init__(self, registers: Registers, joint: Joint) -> None:
        self.registers, self.joint = registers, joint
        self.q = self.qd = self.demand_q = self.demand_qd = 0.0
        self.shift = self.slipped = 0
        self.missed = 0
        self.limited = self.rhythm_told = False
        self.rescale()

    def rescale(self) -> None:
        """Take over what the scaling objects say."""
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
        if micros and not self.rhythm_told:
            seconds = micros * 1e-6
        else:
            power = POWERS.get(objects[keys.INTERPOLATION_INDEX], 0.0)
            seconds = objects[keys.INTERPOLATION_VALUE] * power
        return min(MOST_STEPS, max(1, round(seconds / STEP_S)))


LONGEST_PERIOD_S = 1.0
MOST_STEPS = round(LONGEST_PERIOD_S / STEP_S)
POWERS = {exponent: 10.0**exponent for exponent in range(-6, 1)}
"""Of ten, by the index in 60C2h:2."""


def wrapped(raw: int) -> int:
    """An integer as it comes out of 32 bits with sign."""
    return (raw + 0x8000_0000) % 0x1_0000_0000 - 0x8000_0000


def within(value: int, ends: tuple[int, int]) -> int:
    """`value`, not beyond either end."""
    least, most = ends
    return least if value < least else most if value > most else value


def _signed(value: float, against: int) -> float:
    return -value if against else value
