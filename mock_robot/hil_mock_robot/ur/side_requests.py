"""What requests of the side channel hold, and the truth about the arm."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from hil.errors import SpecError
from hil.payload import Payload
from hil.typing import FloatArray
from hil_mock_robot.options import numbers_of
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.options import LEAST_FACTOR, MOST_FACTOR

MOST_TICKS = 10_000_000
MOST_TORQUE_NM, MOST_KG, MOST_M = 10_000.0, 100.0, 2.0

Request = Mapping[str, Any]


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


def torque_in(request: Request) -> FloatArray:
    """(6,) external joint torque [N·m].

    Raises:
        SpecError: It is none.
    """
    torque = numbers_of(request.get("torque"), 6)
    if torque is None or max(map(abs, torque)) > MOST_TORQUE_NM:
        raise SpecError(
            f"push: torque is {request.get('torque')!r}",
            hint=f"give six numbers up to {MOST_TORQUE_NM:g} N·m; zeros end the push",
        )
    return np.array(torque)


def payload_in(request: Request) -> Payload | None:
    """What is to hang at the flange; None for whatever is declared.

    Raises:
        SpecError: It is no body.
    """
    if request.get("mass_kg", 0) is None:
        return None
    mass = numbers_of([request.get("mass_kg")], 1)
    com = numbers_of(request.get("com_m", [0.0, 0.0, 0.0]), 3)
    if mass is None or com is None or not 0 <= mass[0] <= MOST_KG or max(map(abs, com)) > MOST_M:
        raise SpecError(
            f"mount: {dict(request)}",
            hint=f"give mass_kg from 0 to {MOST_KG:g}, and com_m, three numbers up to {MOST_M:g} m",
        )
    return Payload(mass[0], (com[0], com[1], com[2]))


def truth_of(machine: Machine) -> dict[str, Any]:
    """Where the arm really is and what the controller does; None for what nobody knows."""
    seen, modes = machine.reading, machine.modes
    motion, program = machine.motion, machine.program
    return {
        "ticks": machine.ticks,
        "device_time": machine.now_s,
        "q": _listed(seen.true_q),
        "qd": _listed(seen.true_qd),
        "q_target": _listed(machine.setpoint[0]),
        "qd_target": _listed(machine.setpoint[1]),
        "celsius": _listed(seen.temperature),
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


def _listed(values: FloatArray) -> list[float | None]:
    return [float(value) if math.isfinite(value) else None for value in values]
