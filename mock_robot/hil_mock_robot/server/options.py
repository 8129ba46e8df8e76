"""Values of options that several mocks take: numbers, loopback addresses, the speed of time."""

from __future__ import annotations

import argparse
import ipaddress
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from hil.core import HilError, SpecError

LEAST_FACTOR, MOST_FACTOR = 0.01, 1000.0


class WithDefaults(argparse.ArgumentDefaultsHelpFormatter):
    """Defaults behind the options that have one worth telling."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        default = action.default
        told = isinstance(default, str | int | float) and default is not False and default != ""
        return super()._get_help_string(action) if told else action.help


def exit_code_of(run: Callable[[], int]) -> int:
    """Run a mock; what is wrong is said in words on standard error."""
    try:
        return run()
    except HilError as error:
        hint = f"\n  next: {error.hint}" if error.hint else ""
        print(f"{type(error).__name__}: {error.message}{hint}", file=sys.stderr)  # noqa: T201
        return int(error.exit_code)


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
    """The address, if nobody outside this computer can reach it.

    Raises:
        SpecError: It is no loopback address: the mock obeys whoever connects.
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
