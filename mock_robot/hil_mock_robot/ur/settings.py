"""Settings that any robot program may change, with the controller's own checks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hil.arms import Payload
from hil.core import CommandRefused
from hil_mock_robot.ur.machine import Machine, Watchdog

HEAVIEST = 2.0
"""Largest payload that is taken, as a share of the rated one."""
FARTHEST_M = 4.0
LEAST_KG = 1e-6
LEAST_INERTIA, LARGEST_INERTIA = 1e-9, 133.0
"""[kg·m²]; the largest is the URScript manual's."""
ACTIONS = ("ignore", "pause", "stop")
LEAST_PER_TICK = 1e-9
"""Of a watchdog, which does not bite in anybody's lifetime then."""


def set_payload(
    machine: Machine,
    mass: float,
    com: Sequence[float] | None = None,
    inertia: Sequence[float] | None = None,
) -> None:
    """Declare a load.

    Args:
        machine: To whom.
        mass: [kg].
        com: (3,) centre of mass in the flange frame [m]; the present one when None.
        inertia: (6,) about it [kg·m²]; zero when None.

    Raises:
        CommandRefused: It cannot be.
    """
    if not 0 <= mass <= HEAVIEST * machine.body.arm.payload_max_kg:
        raise CommandRefused(f"set_payload: mass {mass:g} kg is out of range")
    x, y, z = machine.body.declared.com if com is None else com
    if not max(abs(x), abs(y), abs(z)) <= FARTHEST_M:
        raise CommandRefused(f"set_payload: centre of gravity ({x:g}, {y:g}, {z:g}) m out of range")
    payload = Payload(mass if mass >= LEAST_KG else 0.0, (x, y, z), _inertia(inertia or [0.0] * 6))
    if payload != machine.body.declared:
        machine.body.declare(payload)


def set_tcp(machine: Machine, pose: Sequence[float]) -> None:
    """Say where the tool centre point is, (6,) in the flange frame.

    Raises:
        CommandRefused: It cannot be there.
    """
    if len(pose) != 6 or not all(map(math.isfinite, pose)):
        raise CommandRefused("set_tcp: a pose of six numbers is needed")
    machine.tcp = np.array(pose, dtype=float)


def set_watchdog(machine: Machine, variable: str, least_hz: float, action: str) -> None:
    """URScript `rtde_set_watchdog`, which counts from now on; a frequency of zero ends it.

    Args:
        machine: Whose program is watched.
        variable: The input that has to be written.
        least_hz: How often at least [Hz].
        action: One of `ACTIONS`, in small or capital letters: UR's own example writes capitals.

    Raises:
        CommandRefused: There is no such input, no such action, or that is no frequency.
    """
    action = action.lower()
    if variable not in machine.inputs or action not in ACTIONS:
        raise CommandRefused(f"rtde_set_watchdog: no input {variable!r}, or no action {action!r}")
    if not math.isfinite(least_hz):
        raise CommandRefused(f"rtde_set_watchdog: {least_hz} is no frequency")
    if least_hz <= 0 or action == "ignore":
        machine.watchdog = None
        return
    ticks = math.ceil(1.0 / max(least_hz * machine.tick_s, LEAST_PER_TICK) - 1e-9)
    machine.written[variable] = machine.ticks
    machine.watchdog = Watchdog(variable, max(1, ticks), action)


def _inertia(values: Sequence[float]) -> tuple[float, float, float, float, float, float]:
    """What a rigid body can have: no axis turns harder than the two others together."""
    xx, yy, zz, xy, xz, yz = values
    small, middle, large = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if small < -LEAST_INERTIA or large > small + middle + LEAST_INERTIA or large > LARGEST_INERTIA:
        raise CommandRefused("set_target_payload: no rigid body has such moments of inertia")
    return xx, yy, zz, xy, xz, yz
