"""What requests of the side channel hold, and the truth about the arm."""

from __future__ import annotations

from typing import Any

from hil.core import SpecError
from hil_mock_robot.server.options import LEAST_FACTOR, MOST_FACTOR, numbers_of
from hil_mock_robot.server.side_channel import Request, listed
from hil_mock_robot.ur.machine import Machine

MOST_TICKS = 10_000_000


def ticks_in(request: Request) -> int:
    """How many ticks to make.

    Raises:
        SpecError: That is no number of ticks.
    """
    ticks = request.get("ticks", 1)
    if not isinstance(ticks, int) or isinstance(ticks, bool) or not 1 <= ticks <= MOST_TICKS:
        raise SpecError(f"step: ticks is {ticks!r}", hint=f"use 1 to {MOST_TICKS}")
    return ticks


def factor_in(request: Request) -> float:
    """Device seconds per second of wall time.

    Raises:
        SpecError: That is no speed.
    """
    number = numbers_of([request.get("factor")], 1)
    if number is None or not LEAST_FACTOR <= number[0] <= MOST_FACTOR:
        hint = f"use a number from {LEAST_FACTOR:g} to {MOST_FACTOR:g}"
        raise SpecError(f"speed: factor is {request.get('factor')!r}", hint=hint)
    return number[0]


def truth_of(machine: Machine) -> dict[str, Any]:
    """Where the arm really is and what the controller does; None for what nobody knows."""
    seen, modes = machine.reading, machine.modes
    motion, program = machine.motion, machine.program
    return {
        "ticks": machine.ticks,
        "device_time": machine.now_s,
        "q": listed(seen.true_q),
        "qd": listed(seen.true_qd),
        "q_target": listed(machine.setpoint[0]),
        "qd_target": listed(machine.setpoint[1]),
        "celsius": listed(seen.temperature),
        "robot_mode": modes.robot.name,
        "safety_mode": modes.safety.name,
        "runtime": machine.runtime.name,
        "remote": modes.remote,
        "stop_code": modes.stop_code,
        "braked": machine.body.braked,
        "program": None if program is None else program.name,
        "motion": None if motion is None else type(motion).__name__,
        "declared_kg": machine.body.declared.mass,
        "mounted_kg": machine.body.mounted.mass,
        "speed_fraction": machine.speed_fraction,
    }
