"""Checks of option values that several mocks have: speeds, addresses, poses, payloads.

The values come from a command line, a station file or a request of the side channel.
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
"""Safe starting pose by the first two letters of the arm [deg]; all zeros for other arms."""


def factor_of(speed: str) -> float | None:
    """Return the device seconds per second of wall time; None for `free` and `lock-step`.

    Raises:
        SpecError: The speed is invalid.
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
        f"--speed {speed!r} is not a valid speed",
        hint=f"give a number from {LEAST_FACTOR:g} to {MOST_FACTOR:g}, `free` or `lock-step`",
    )


def loopback_of(address: str) -> str:
    """Return the address if it is a loopback address, which only this computer can reach.

    Raises:
        SpecError: The address is not a loopback address; the mock has no access protection.
    """
    try:
        loopback = ipaddress.IPv4Address(address).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        raise SpecError(
            f"--address {address!r} is not a loopback address",
            hint="use 127.0.0.1, or 127.0.0.2 and so on for several controllers at once",
        )
    return address


def numbers_of(value: Any, n: int) -> tuple[float, ...] | None:
    """Return `value` as n finite numbers; None if the value is anything else."""
    if isinstance(value, str | Mapping) or not isinstance(value, Sequence | np.ndarray):
        return None
    if any(isinstance(v, bool) or not isinstance(v, int | float | np.number) for v in value):
        return None
    try:
        numbers = tuple(float(v) for v in value)
    except OverflowError:  # an integer beyond the range of a float
        return None
    return numbers if len(numbers) == n and np.isfinite(numbers).all() else None


def upright_deg(arm: ArmDescription) -> tuple[float, ...]:
    """Return a safe starting pose of the arm (n,) [deg]."""
    return UPRIGHT_DEG.get(arm.name[:2], (0.0,) * arm.n_joints)


def pose_of(degrees: Sequence[float], arm: ArmDescription) -> FloatArray:
    """Return the joint position at the start, (n,) [rad].

    Raises:
        SpecError: The number of angles is wrong, or an angle is outside the joint limits.
    """
    q: FloatArray = np.radians(np.asarray(degrees, dtype=float))
    if q.shape != arm.q_min.shape or not ((arm.q_min <= q) & (q <= arm.q_max)).all():
        low, high = np.degrees(arm.q_min).round(), np.degrees(arm.q_max).round()
        raise SpecError(
            f"--start-q-deg {list(degrees)} is not a pose of the {arm.name}",
            hint=f"give {arm.n_joints} angles within the joint limits: {low} to {high}",
        )
    return q


def mounted_of(given: Sequence[float] | None) -> Payload | None:
    """Return the payload of `--mounted-kg` on the flange; None for the declared payload.

    Raises:
        SpecError: The mass is negative, or a number is not finite.
    """
    if not given:
        return None
    mass, x, y, z = given
    if not (mass >= 0 and np.isfinite(given).all()):
        raise SpecError(
            f"--mounted-kg {list(given)} is not a payload", hint="give a mass ≥ 0 and a centre [m]"
        )
    return Payload(mass, (x, y, z))
