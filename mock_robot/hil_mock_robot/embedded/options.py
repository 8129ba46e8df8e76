"""Options of the embedded mock: what a station file may say about it, beside its name and model.

`Options` are the raw values; the functions below turn them into the individual robot (`truth_of`,
`wear_of`), where it stands (`start_of`), how it is mounted (`mount_of`) and what it carries
(`mounted_of`), and refuse what cannot be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray, SpecError
from hil_mock_robot.plant.records import MOUNTS
from hil_mock_robot.plant.truth import Profile, Truth, draw_truth
from hil_mock_robot.server.options import numbers_of, upright_deg

MOST_BLOCK_S = 1.0
"""Simulated time of a block at most: `stop` waits for the block that is being computed."""

MOST_SUBSTEP_HZ = 16_000.0
"""At which a block of one second still takes less than the 0.1 s that `stop` may."""

RANGES = {
    "substep_hz": (1000.0, MOST_SUBSTEP_HZ),
    "rate_hz": (1.0, 1000.0),
    "temperature_c": (-50.0, 100.0),
    "room_c": (-50.0, 60.0),
    "speed": (0.1, 20.0),
    "queue_s": (0.05, 60.0),
    "watchdog_s": (0.0, 60.0),
}
"""Least and most of the options that are numbers."""

WALL_ONLY = ("speed", "queue_s", "watchdog_s")
VIRTUAL_ONLY = ("block",)

WALL_BLOCK_S = 0.008
"""Simulated time that the wall clock computes at once at most, if that holds a sample."""

LEAST_WALL_SAMPLES_HZ = 10.0
"""Samples per second of wall time: `stop` acts with the next sample, and within 0.1 s."""


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a mock robot in a station, beside name and model.

    Attributes:
        seed, profile: Which robot is drawn; see `draw_truth`.
        substep_hz: Integration steps per second, a multiple of 1000, at most 16,000.
        rate_hz: Samples per second; the arm's own when None.
        block: Samples that one `read` computes at most; no more than a second's.
        truth_file: A truth written earlier, in place of `seed` and `profile`.
        start_q_deg: Pose in which the robot is switched on.
        temperature_c: Joint temperature at that moment; the room's when None.
        room_c: Mean temperature of the room; that of the robot's truth when None.
        day: Another day has other noise, and the room's slow drift stands elsewhere.
        wear: Factor on all friction of each joint, 1 for as good as new.
        mount: `table`, `wall`, `ceiling`, or gravity in the base frame [m/s²]; what the station
            says (`gravity_m_s2`) when None, and no other than that.
        mounted_payload: What really hangs at the flange (`mass_kg`, `com_m`, `inertia_kgm2`);
            what is declared when None.
        clock: `virtual` advances when it is read; `wall` advances by itself.
        speed: Simulated seconds per second of wall time.
        queue_s: Wall time of state rows that wait to be read; older ones are lost.
        watchdog_s: Wall time without a reader after which a moving arm is stopped; 0 for never.
        journal: File to which the robot appends commands and events.
        faults: What goes wrong, and when; see `hil_mock_robot.embedded.faults`.
    """

    seed: int = 0
    profile: Profile = "full"
    substep_hz: float = 1000.0
    rate_hz: float | None = None
    block: int = 16
    truth_file: str | None = None
    start_q_deg: Sequence[float] | None = None
    temperature_c: float | None = None
    room_c: float | None = None
    day: int = 0
    wear: Sequence[float] | None = None
    mount: str | Sequence[float] | None = None
    mounted_payload: Mapping[str, Any] | Payload | None = None
    clock: Literal["virtual", "wall"] = "virtual"
    speed: float = 1.0
    queue_s: float = 2.0
    watchdog_s: float = 1.0
    journal: str | None = None
    faults: Sequence[Mapping[str, Any]] = ()


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
    _require_numbers(options)
    for name in ("truth_file", "journal"):
        if not isinstance(getattr(options, name), str | None):
            raise wrong_option(name, getattr(options, name), "give the path of a file")
    _require_right_clock(options, given)
    return options


def _require_numbers(options: Options) -> None:
    for name, first in (("seed", 0), ("block", 1), ("day", 0)):
        value = getattr(options, name)
        if not isinstance(value, int) or isinstance(value, bool) or value < first:
            raise wrong_option(name, value, f"use a whole number from {first} up")
    for name, (least, most) in RANGES.items():
        value = getattr(options, name)
        if value is not None and not (numbers_of([value], 1) and least <= value <= most):
            raise wrong_option(name, value, f"use a number from {least:g} to {most:g}")


def _require_right_clock(options: Options, given: Mapping[str, Any]) -> None:
    if options.clock not in ("virtual", "wall"):
        raise wrong_option("clock", options.clock, "use virtual or wall")
    wall = options.clock == "wall"
    for name in VIRTUAL_ONLY if wall else WALL_ONLY:
        if name in given:
            other = "virtual" if wall else "wall"
            raise SpecError(
                f"mock option {name} means nothing with clock: {options.clock}",
                hint=f"leave it out, or use clock: {other}",
            )


def require_short_block(options: Options, rate_hz: float) -> None:
    """Refuse blocks so long that `stop` would have to wait for one.

    Raises:
        SpecError: `block` is more than a second of samples.
    """
    most = max(1, int(MOST_BLOCK_S * rate_hz))
    if options.clock == "virtual" and options.block > most:
        hint = f"use at most {most}, one second at {rate_hz:g} Hz: stop() waits for a block"
        raise wrong_option("block", options.block, hint)


def wall_block_of(options: Options, rate_hz: float) -> int:
    """How many samples the wall clock computes at once.

    Raises:
        SpecError: Samples are so far apart that `stop` would act too late.
    """
    if rate_hz * options.speed < LEAST_WALL_SAMPLES_HZ:
        raise SpecError(
            f"mock option clock: wall makes {rate_hz * options.speed:g} samples per second of "
            f"wall time (rate_hz × speed), at least {LEAST_WALL_SAMPLES_HZ:g} are needed",
            hint="raise speed or rate_hz: stop() acts with the next sample",
        )
    return max(1, int(WALL_BLOCK_S * rate_hz + 1e-9))


def start_of(arm: ArmDescription, options: Options) -> FloatArray:
    """(n,) joint position in which the robot is switched on [rad].

    Raises:
        SpecError: It is not a pose of this arm.
    """
    degrees = upright_deg(arm) if options.start_q_deg is None else options.start_q_deg
    numbers = numbers_of(degrees, arm.n_joints)
    q = np.radians(np.array(numbers or [np.nan]))
    if not ((q >= arm.q_min) & (q <= arm.q_max)).all():
        raise SpecError(
            f"start_q_deg {degrees!r} is no pose of the {arm.name}",
            hint=f"give {arm.n_joints} angles inside its limits",
        )
    return np.asarray(q)


def wrong_option(name: str, value: object, hint: str) -> SpecError:
    """Return the error for a wrong option, with a hint."""
    return SpecError(f"mock option {name} is {value!r}", hint=hint)


def gravity_of(mount: str | Sequence[float]) -> tuple[float, float, float]:
    """Return gravity in the base frame [m/s²] for a name of `MOUNTS`, or as given.

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
    """Return gravity in the base frame [m/s²] where no station sets it.

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
    """Return the load that really hangs at the flange; None for the declared one.

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


WEAR = (0.1, 10.0)
"""Least and most of what friction becomes by wear."""

GOLDEN_RAD = 2.399963
"""Golden angle: the phases of days one after the other are never alike."""


def truth_of(model: str, options: Options) -> Truth:
    """The robot that the options name, in its room on that day.

    Raises:
        SpecError: There is no such arm or profile, or the file is another arm's.
        DataError: The file cannot be used.
    """
    truth = _robot_of(model, options)
    room = truth.ambient_c if options.room_c is None else options.room_c
    phase = truth.ambient_phase_rad + options.day * GOLDEN_RAD
    return replace(truth, ambient_c=room, ambient_phase_rad=phase)


def _robot_of(model: str, options: Options) -> Truth:
    """The robot itself.

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


def wear_of(options: Options, n: int) -> FloatArray:
    """(n,) factor on each joint's friction.

    Raises:
        SpecError: It is not n factors that can be.
    """
    if options.wear is None:
        return np.ones(n)
    factors = numbers_of(options.wear, n)
    least, most = WEAR
    if factors is None or not all(least <= factor <= most for factor in factors):
        hint = f"give {n} factors from {least:g} to {most:g}, 1 for as good as new"
        raise wrong_option("wear", options.wear, hint)
    return np.array(factors)
