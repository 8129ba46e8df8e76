"""What a station file may say about a mock robot, beside its name and model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.arms import ArmDescription
from hil.errors import SpecError
from hil.payload import Payload
from hil.typing import FloatArray
from hil_mock_robot.draw import draw_truth
from hil_mock_robot.truth import Profile, Truth

UPRIGHT_DEG = {"ur": (0.0, -90.0, 0.0, -90.0, 0.0, 0.0)}
"""Safe starting pose by the first two letters of the arm; all zeros for others."""

GRAVITY = 9.81
MOUNTS = {
    "table": (0.0, 0.0, -GRAVITY),
    "ceiling": (0.0, 0.0, GRAVITY),
    "wall": (-GRAVITY, 0.0, 0.0),
}
"""Gravity in the base frame [m/s²] by the name of the mount."""


@dataclass(frozen=True, slots=True)
class Options:
    """What a station may say about a mock robot, beside its name and model.

    Attributes:
        seed, profile: Which robot is drawn; see `draw_truth`.
        substep_hz: Integration steps per second, a multiple of 1000.
        rate_hz: Samples per second; the arm's own when None.
        block: Samples that one `read` computes at most.
        truth_file: A truth written earlier, in place of `seed` and `profile`.
        start_q_deg: Pose in which the robot is switched on.
        temperature_c: Joint temperature at that moment; the room's when None.
        mount: `table`, `wall`, `ceiling`, or gravity in the base frame [m/s²]; what the station
            says (`gravity_m_s2`) when None, and no other than that.
        mounted_payload: What really hangs at the flange (`mass_kg`, `com_m`, `inertia_kgm2`);
            what is declared when None.
    """

    seed: int = 0
    profile: Profile = "full"
    substep_hz: float = 1000.0
    rate_hz: float | None = None
    block: int = 16
    truth_file: str | None = None
    start_q_deg: Sequence[float] | None = None
    temperature_c: float | None = None
    mount: str | Sequence[float] | None = None
    mounted_payload: Mapping[str, Any] | Payload | None = None


def options_of(given: Mapping[str, Any]) -> Options:
    """The options of a station's mapping.

    Raises:
        SpecError: One is unknown or cannot be.
    """
    known = Options.__dataclass_fields__
    unknown = sorted(set(given) - set(known))
    if unknown:
        raise SpecError(
            f"the mock robot has no option {', '.join(unknown)}",
            hint=f"its options are {', '.join(known)}",
        )
    options = Options(**given)
    for name, least in (("seed", 0), ("block", 1)):
        value = getattr(options, name)
        if not isinstance(value, int) or value < least:
            raise SpecError(
                f"mock option {name} is {value!r}", hint=f"use a whole number from {least} up"
            )
    for name in ("substep_hz", "rate_hz", "temperature_c"):
        value = getattr(options, name)
        if value is not None and not isinstance(value, int | float):
            raise SpecError(f"mock option {name} is {value!r}", hint="use a number")
    return options


def truth_of(model: str, options: Options) -> Truth:
    """The robot that the options name.

    Raises:
        SpecError: There is no such arm or profile, or the file is another arm's.
        DataError: The file cannot be used.
    """
    if options.truth_file is None:
        return draw_truth(model, options.seed, options.profile)
    truth = Truth.from_json(options.truth_file)
    if truth.arm != model:
        raise SpecError(
            f"{options.truth_file} is the truth of a {truth.arm}, the station says {model}",
            hint=f"set model: {truth.arm}",
        )
    return truth


def start_of(arm: ArmDescription, options: Options) -> FloatArray:
    """(n,) joint position in which the robot is switched on [rad].

    Raises:
        SpecError: It is not a pose of this arm.
    """
    upright = UPRIGHT_DEG.get(arm.name[:2], (0.0,) * arm.n_joints)
    degrees = upright if options.start_q_deg is None else options.start_q_deg
    q = np.radians(np.asarray(degrees, dtype=np.float64))
    if q.shape != (arm.n_joints,) or (q < arm.q_min).any() or (q > arm.q_max).any():
        raise SpecError(
            f"start_q_deg {list(degrees)} is no pose of the {arm.name}",
            hint=f"give {arm.n_joints} angles inside its limits",
        )
    return q


def gravity_of(mount: str | Sequence[float]) -> tuple[float, float, float]:
    """Gravity in the base frame [m/s²] for a name of `MOUNTS`, or as given.

    Raises:
        SpecError: There is no such mount.
    """
    if isinstance(mount, str) and mount in MOUNTS:
        return MOUNTS[mount]
    if isinstance(mount, str) or len(mount) != 3:
        raise SpecError(
            f"mount {mount!r} is unknown",
            hint=f"use one of {', '.join(MOUNTS)}, or gravity in the base frame [m/s²]",
        )
    x, y, z = (float(value) for value in mount)
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
    unknown = set(given) - {"mass_kg", "com_m", "inertia_kgm2"}
    if unknown or "mass_kg" not in given:
        raise SpecError(
            f"mounted_payload {dict(given)} cannot be read",
            hint="give mass_kg, and com_m and inertia_kgm2 if they are not zero",
        )
    zero = Payload()
    return Payload(
        float(given["mass_kg"]),
        tuple(given.get("com_m", zero.com)),
        tuple(given.get("inertia_kgm2", zero.inertia)),
    )
