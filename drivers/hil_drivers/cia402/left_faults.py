"""Faults that drives are in when they are connected to, and which of them may be reset then.

Errors of monitoring (8xxxh: heartbeat or SYNC lost, a following error) say how one was commanded:
whoever connects commands it anew. All others say something of currents, voltages, temperatures or
hardware; they are reset by a person who has seen to them. The end of a connection is an error of
monitoring of its own: what a drive has noted since it was last reset counts as much as the last.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

from hil.core import RobotFault
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.aborts import Aborted
from hil_drivers.cia402.canopen_acyclic import CanopenAcyclic
from hil_drivers.cia402.emergencies import error_text
from hil_drivers.cia402.inspection import errors_of
from hil_drivers.cia402.states import DISABLE_VOLTAGE, FAULT_RESET, State, state_of

MONITORING = 0x8000
_CLASS = 0xF000

HINT = (
    "see to its cause, then reset it, by the drive's own tool or: "
    "python -m hil_drivers.cia402 reset STATION ROBOT (which also empties its list of errors)"
)


@dataclass(frozen=True, slots=True)
class LeftFault:
    """A drive in fault before anything was asked of it.

    Attributes:
        axis: From 0.
        name: For messages.
        codes: The present one, then older ones.
    """

    axis: int
    name: str
    codes: tuple[int, ...]

    @property
    def is_monitoring(self) -> bool:
        """Whether it may be reset by connecting."""
        return bool(self.codes) and all(code & _CLASS == MONITORING for code in self.codes)

    def __str__(self) -> str:
        said = [error_text(code) for code in self.codes[:1]] or ["no error code"]
        older = [f"{code:04X}h" for code in dict.fromkeys(self.codes[1:])]
        return f"{self.name} is in fault: {said[0]}" + (
            f", before {', '.join(older)}" * bool(older)
        )


def faults_left(acyclic: CanopenAcyclic) -> list[LeftFault]:
    """The axes that are in fault, with their errors; raises what SDO raises."""
    faulty = [axis for axis in range(len(acyclic.nodes)) if _is_faulty(acyclic, axis)]
    return [LeftFault(a, acyclic.name_of(a), tuple(errors_of(acyclic, a))) for a in faulty]


def reset(acyclic: CanopenAcyclic, fault: LeftFault) -> bool:
    """Reset a fault that a person has seen to, by SDO; whether it is gone.

    Its list of errors (1003h) is emptied then: what comes is judged without what was seen.

    Raises:
        CommandRefused, RobotTimeout: The drive does not take it.
    """
    for controlword in (DISABLE_VOLTAGE, FAULT_RESET, DISABLE_VOLTAGE):  # the rising edge counts
        acyclic.download(fault.axis, od.CONTROLWORD, controlword)
    if _is_faulty(acyclic, fault.axis):
        return False
    with contextlib.suppress(Aborted):  # not all drives have a list, or let it be emptied
        acyclic.download(fault.axis, od.ERROR_COUNT, 0)
    return True


def require_resettable(faults: list[LeftFault]) -> None:
    """Refuse faults that say something of the hardware.

    Raises:
        RobotFault: With all of them.
    """
    if grave := [str(fault) for fault in faults if not fault.is_monitoring]:
        raise RobotFault("; ".join(grave), hint=HINT)


def _is_faulty(acyclic: CanopenAcyclic, axis: int) -> bool:
    return state_of(acyclic.upload(axis, od.STATUSWORD)) in (State.FAULT, State.FAULT_REACTION)
