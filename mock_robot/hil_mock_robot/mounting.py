"""How the mock is mounted and what hangs at its flange, as the options say it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import SpecError
from hil_mock_robot.options import Options, numbers_of, wrong_option

GRAVITY = 9.81
MOUNTS = {
    "table": (0.0, 0.0, -GRAVITY),
    "ceiling": (0.0, 0.0, GRAVITY),
    "wall": (-GRAVITY, 0.0, 0.0),
}
"""Gravity in the base frame [m/s²] by the name of the mount."""


def gravity_of(mount: str | Sequence[float]) -> tuple[float, float, float]:
    """Gravity in the base frame [m/s²] for a name of `MOUNTS`, or as given.

    Raises:
        SpecError: There is no such mount.
    """
    if isinstance(mount, str) and mount in MOUNTS:
        return MOUNTS[mount]
    gravity = numbers_of(mount, 3)
    if gravity is None:
        raise SpecError(
            f"mount {mount!r} is unknown",
            hint=f"use one of {', '.join(MOUNTS)}, or gravity in the base frame [m/s²]",
        )
    x, y, z = gravity
    return x, y, z


def mount_of(options: Options) -> tuple[float, float, float]:
    """Gravity in the base frame [m/s²] as long as no station says anything.

    Raises:
        SpecError: There is no such mount.
    """
    return MOUNTS["table"] if options.mount is None else gravity_of(options.mount)


def require_same_mount(options: Options, station: Sequence[float]) -> None:
    """Refuse an option `mount` that contradicts the station's gravity (3,) [m/s²].

    Raises:
        SpecError: They differ: the identification would believe the station, the arm the option.
    """
    if options.mount is None:
        return
    own = gravity_of(options.mount)
    if not np.allclose(own, station):
        raise SpecError(
            f"the mock robot's option mount: {options.mount} means gravity {list(own)} m/s², but "
            f"the station's gravity_m_s2 for this robot is {list(station)}",
            hint=f"leave the option out and set gravity_m_s2: {list(own)} beside driver and model",
        )


def mounted_of(options: Options) -> Payload | None:
    """What really hangs at the flange, None when it is whatever is declared.

    Raises:
        SpecError: The mapping is not a payload.
    """
    given = options.mounted_payload
    if given is None or isinstance(given, Payload):
        return given
    parts = {"mass_kg": [0.0], "com_m": Payload().com, "inertia_kgm2": Payload().inertia}
    hint = "give mass_kg ≥ 0, and com_m (3) and inertia_kgm2 (6) if they are not zero"
    if not isinstance(given, Mapping) or "mass_kg" not in given or set(given) - set(parts):
        raise wrong_option("mounted_payload", given, hint)
    read: dict[str, Any] = {}
    for key, zero in parts.items():
        value = [given[key]] if key == "mass_kg" else given.get(key, zero)
        read[key] = numbers_of(value, len(zero))
        if read[key] is None or (key == "mass_kg" and read[key][0] < 0):
            raise wrong_option(f"mounted_payload.{key}", given[key], hint)
    return Payload(read["mass_kg"][0], read["com_m"], read["inertia_kgm2"])
