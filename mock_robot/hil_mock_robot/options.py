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

MOST_BLOCK_S = 1.0
"""Simulated time of a block at most: `stop` waits for the block that is being computed."""

MOST_SUBSTEP_HZ = 16_000.0
"""At which a block of one second still takes less than the 0.1 s that `stop` may."""

RANGES = {
    "substep_hz": (1000.0, MOST_SUBSTEP_HZ),
    "rate_hz": (1.0, 1000.0),
    "temperature_c": (-50.0, 100.0),
}
"""Least and most of the options that are numbers."""


@dataclass(frozen=True, slots=True)
class Options:
    """What a station may say about a mock robot, beside its name and model.

    Attributes:
        seed, profile: Which robot is drawn; see `draw_truth`.
        substep_hz: Integration steps per second, a multiple of 1000, at most 16,000.
        rate_hz: Samples per second; the arm's own when None.
        block: Samples that one `read` computes at most; no more than a second's.
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
    for name, first in (("seed", 0), ("block", 1)):
        value = getattr(options, name)
        if not isinstance(value, int) or isinstance(value, bool) or value < first:
            raise _wrong(name, value, f"use a whole number from {first} up")
    for name, (least, most) in RANGES.items():
        value = getattr(options, name)
        if value is not None and not (_numbers([value], 1) and least <= value <= most):
            raise _wrong(name, value, f"use a number from {least:g} to {most:g}")
    if not isinstance(options.truth_file, str | None):
        raise _wrong("truth_file", options.truth_file, "give the path of a file")
    return options


def require_short_block(options: Options, rate_hz: float) -> None:
    """Refuse blocks so long that `stop` would have to wait for one.

    Raises:
        SpecError: `block` is more than a second of samples.
    """
    most = max(1, int(MOST_BLOCK_S * rate_hz))
    if options.block > most:
        hint = f"use at most {most}, one second at {rate_hz:g} Hz: stop() waits for a block"
        raise _wrong("block", options.block, hint)


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
    numbers = _numbers(degrees, arm.n_joints)
    q = np.radians(np.array(numbers or [np.nan]))
    if not ((q >= arm.q_min) & (q <= arm.q_max)).all():
        raise SpecError(
            f"start_q_deg {degrees!r} is no pose of the {arm.name}",
            hint=f"give {arm.n_joints} angles inside its limits",
        )
    return np.asarray(q)


def gravity_of(mount: str | Sequence[float]) -> tuple[float, float, float]:
    """Gravity in the base frame [m/s²] for a name of `MOUNTS`, or as given.

    Raises:
        SpecError: There is no such mount.
    """
    if isinstance(mount, str) and mount in MOUNTS:
        return MOUNTS[mount]
    gravity = _numbers(mount, 3)
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
        raise _wrong("mounted_payload", given, hint)
    read: dict[str, Any] = {}
    for key, zero in parts.items():
        value = [given[key]] if key == "mass_kg" else given.get(key, zero)
        read[key] = _numbers(value, len(zero))
        if read[key] is None or (key == "mass_kg" and read[key][0] < 0):
            raise _wrong(f"mounted_payload.{key}", given[key], hint)
    return Payload(read["mass_kg"][0], read["com_m"], read["inertia_kgm2"])


def _numbers(value: Any, n: int) -> tuple[float, ...] | None:
    """`value` as n finite numbers, None when it is anything else."""
    if isinstance(value, str | Mapping) or not isinstance(value, Sequence | np.ndarray):
        return None
    if any(isinstance(v, bool) or not isinstance(v, int | float | np.number) for v in value):
        return None
    numbers = tuple(float(v) for v in value)
    return numbers if len(numbers) == n and np.isfinite(numbers).all() else None


def _wrong(name: str, value: object, hint: str) -> SpecError:
    return SpecError(f"mock option {name} is {value!r}", hint=hint)
