"""One axis: controlword and set-points in, demands on its motor and what it measures out.

A drive lives on its registers (`contracts.Registers`) and has no bus. The loop's order within one
SYNC is: RPDOs into the registers and TPDOs out of them (the node), then `Drive.advance` of all
drives, one `Body.advance`, then `Drive.measured` of all drives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hil.arms import ArmDescription
from hil_mock_robot.cia402.contracts import Demand, Measured, Registers
from hil_mock_robot.cia402.states import State

Emergency = Callable[[int, int], None]
"""Told an EMCY code (0: no error any more) and the error register (1001h)."""


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


class Drive:
    """One axis of the arm; times are device time, counted by the steps of `advance`.

    Args:
        registers: Its live objects; it reads what the master writes and writes what it measures
            (1001h, 603Fh, 6041h, 6061h, 6062h, 6064h, 606Ch, 6074h, 6077h, 6078h, 6079h, 60F4h,
            2110h).
        joint: See `joints_of`.
        emergency: Called when a fault comes and when it is reset; 1001h and 603Fh are set already.

    Attributes:
        state: Of the power state machine.
        refused_modes: Modes (6060h) that 6061h does not follow though 6502h has them (injected).
        deaf: It ignores its set-points, and says so by bit 12 (injected).
    """

    def __init__(self, registers: Registers, joint: Joint, emergency: Emergency) -> None:
        self.state = State.NOT_READY_TO_SWITCH_ON
        self.refused_modes: set[int] = set()
        self.deaf = False

    def written(self, where: int) -> None:
        """An object (`key`) was written by SDO; controlword and scaling act at once.

        What RPDOs write is seen by the next `advance`.
        """
        raise NotImplementedError

    def advance(self, steps: int, *, synced: bool = True) -> Demand:
        """What the axis asks of its motor for the next steps of `STEP_S`.

        Args:
            steps: At least 1.
            synced: A SYNC begins them; False when the drives' own timer makes them.
        """
        raise NotImplementedError

    def measured(self, measured: Measured, steps: int = 0) -> None:
        """Take what was measured after those steps (0: when it is switched on) to the registers."""
        raise NotImplementedError

    def fault(self, code: int) -> None:
        """Something is wrong (an EMCY code): fault reaction by 605Eh, then fault.

        Without effect while there is a fault already.
        """
        raise NotImplementedError

    def connection_lost(self, code: int = 0x8130) -> None:
        """The master's heartbeat is overdue, or the bus is off: reaction by 6007h."""
        raise NotImplementedError

    def reset(self) -> None:
        """Switched off and on: the brake closes, faults are forgotten; NMT reset node."""
        raise NotImplementedError
