"""Values of options that several mocks take: speeds, addresses, poses, loads.

They come from a command line, from a station file or from a request of the side channel.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray, SpecError

LEAST_FACTOR, MOST_FACTOR = 0.01, 1000.0
MOST_TORQUE_NM, MOST_KG, MOST_M = 10_000.0, 100.0, 2.0

UPRIGHT_DEG = {"ur": (0.0, -90.0, 0.0, -90.0, 0.0, 0.0)}
"""Safe starting pose by the first two letters of the arm; all zeros for others."""


def factor_of(speed: str) -> float | None:
    """Device seconds per second of wall time; None for `free` and `lock-step`.

    Raises:
        SpecError: It is none of these.
    """
    if speed in ("free", "lock-step"):
        return None
    try:
        factor = float(speed.removeprefix("x").removeprefix("×"))
    except ValueError:
        factor = 0.0
    if LEAST_FACTOR <= factor <= MOST_FACTOR:
        return factor
    raise SpecError(
        f"--speed {speed!r} is no speed",
        hint=f"give a number from {LEAST_FACTOR:g} to {MOST_FACTOR:g}, `free` or `lock-step`",
    )


def loopback_of(address: str) -> str:
    """Return a loopback address, which only this computer can reach.

    Raises:
        SpecError: It is no loopback address: the mock has no protection against clients.
    """
    try:
        loopback = ipaddress.IPv4Address(address).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        raise SpecError(
            f"--address {address!r} is no loopback address",
            hint="use 127.0.0.1, or 127.0.0.2 and so on for several controllers at once",
        )
    return address


def numbers_of(value: Any, n: int) -> tuple[float, ...] | None:
    """`value` as n finite numbers, None when it is anything else."""
    if isinstance(value, str | Mapping) or not isinstance(value, Sequence | np.ndarray):
        return None
    if any(isinstance(v, bool) or not isinstance(v, int | float | np.number) for v in value):
        return None
    try:
        numbers = tuple(float(v) for v in value)
    except OverflowError:  # a whole number beyond what a float holds
        return None
    return numbers if len(numbers) == n and np.isfinite(numbers).all() else None


def upright_deg(arm: ArmDescription) -> tuple[float, ...]:
    """(n,) a safe starting pose of the arm."""
    return UPRIGHT_DEG.get(arm.name[:2], (0.0,) * arm.n_joints)


def pose_of(degrees: Sequence[float], arm: ArmDescription) -> FloatArray:
    """(n,) where the arm stands at first [rad].

    Raises:
        SpecError: It is no pose of the arm.
    """
    q: FloatArray = np.radians(np.asarray(degrees, dtype=float))
    if q.shape != arm.q_min.shape or not ((arm.q_min <= q) & (q <= arm.q_max)).all():
        low, high = np.degrees(arm.q_min).round(), np.degrees(arm.q_max).round()
        raise SpecError(
            f"--start-q-deg {list(degrees)} is no pose of the {arm.name}",
            hint=f"give {arm.n_joints} angles inside its limits: {low} to {high}",
        )
    return q


def mounted_of(given: Sequence[float] | None) -> Payload | None:
    """Return the load of `--mounted-kg` at the flange; None for the declared one.

    Raises:
        SpecError: It is no body.
    """
    if not given:
        return None
    mass, x, y, z = given
    if not (mass >= 0 and np.isfinite(given).all()):
        raise SpecError(f"--mounted-kg {list(given)}", hint="give a mass ≥ 0 and a centre [m]")
    return Payload(mass, (x, y, z))
