"""Options of the embedded mock in a station file, in addition to its name and model.

`Options` contains the values as written in the station file. The functions of this module convert
options to the individual robot (`truth_of`, `wear_of`), its initial position (`start_of`), its
mounting (`mount_of`) and its payload (`mounted_of`), and reject invalid values.
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
"""Longest simulated time of a block [s], because `stop` waits for the current block."""

MOST_SUBSTEP_HZ = 16_000.0
"""Maximum integration rate [Hz]; at this rate, computing a block of one second takes less than
the 0.1 s allowed for `stop`."""

RANGES = {
    "substep_hz": (1000.0, MOST_SUBSTEP_HZ),
    "rate_hz": (1.0, 1000.0),
    "temperature_c": (-50.0, 100.0),
    "room_c": (-50.0, 60.0),
    "speed": (0.1, 20.0),
    "queue_s": (0.05, 60.0),
    "watchdog_s": (0.0, 60.0),
}
"""Smallest and largest permitted value of each numeric option."""

WALL_ONLY = ("speed", "queue_s", "watchdog_s")
VIRTUAL_ONLY = ("block",)

WALL_BLOCK_S = 0.008
"""Maximum simulated time per block of the wall clock [s]; a block has at least one sample."""

LEAST_WALL_SAMPLES_HZ = 10.0
"""Smallest number of samples per second of wall time, because `stop` acts with the next sample
and must act within 0.1 s."""


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a mock robot in a station, in addition to name and model.

    Attributes:
        seed, profile: Seed and profile of the drawn robot; see `draw_truth`.
        substep_hz: Integration steps per second, a multiple of 1000, at most 16,000.
        rate_hz: Samples per second; None for the rate of the arm.
        block: Maximum number of samples per `read`; at most one second of samples.
        truth_file: File with a truth, used instead of `seed` and `profile`.
        start_q_deg: Initial joint position [°].
        temperature_c: Initial joint temperature [°C]; None for the room temperature.
        room_c: Mean room temperature [°C]; None for the value in the robot's truth.
        day: Number of the simulated day. Each simulated day has different noise and a different
            phase of the room's temperature drift.
        wear: Factor on all friction of each joint, 1 for a new joint.
        mount: `table`, `wall`, `ceiling`, or gravity in the base frame [m/s²]. None selects the
            station's `gravity_m_s2`; any other mount must agree with the gravity of the station.
        mounted_payload: Payload that is mounted at the flange (`mass_kg`, `com_m`, `inertia_kgm2`);
            None for the declared payload.
        clock: `virtual` advances when the robot is read; `wall` advances automatically.
        speed: Simulated seconds per second of wall time.
        queue_s: Wall time of state rows that wait to be read [s]; older rows are lost.
        watchdog_s: Wall time without a reader after which a moving arm is stopped [s]; 0 for no
            watchdog.
        journal: File to which the robot appends commands and events.
        faults: Faults with their times; see `hil_mock_robot.embedded.faults`.
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
    """Return the options from a mapping in a station file.

    Raises:
        SpecError: An option is unknown or invalid.
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
            raise wrong_option(name, value, f"use a whole number of at least {first}")
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
                f"mock option {name} is not used with clock: {options.clock}",
                hint=f"remove it, or use clock: {other}",
            )


def require_short_block(options: Options, rate_hz: float) -> None:
    """Raise if blocks are so long that `stop` would have to wait too long for a block.

    Raises:
        SpecError: The option `block` is more than a second of samples.
    """
    most = max(1, int(MOST_BLOCK_S * rate_hz))
    if options.clock == "virtual" and options.block > most:
        hint = f"use at most {most}, one second at {rate_hz:g} Hz: stop() waits for a block"
        raise wrong_option("block", options.block, hint)


def wall_block_of(options: Options, rate_hz: float) -> int:
    """Return the number of samples per block of the wall clock.

    Raises:
        SpecError: The time between samples is so long that `stop` would act too late.
    """
    if rate_hz * options.speed < LEAST_WALL_SAMPLES_HZ:
        raise SpecError(
            f"mock option clock: wall yields {rate_hz * options.speed:g} samples per second of "
            f"wall time (rate_hz × speed), at least {LEAST_WALL_SAMPLES_HZ:g} are required",
            hint="raise speed or rate_hz: stop() acts with the next sample",
        )
    return max(1, int(WALL_BLOCK_S * rate_hz + 1e-9))


def start_of(arm: ArmDescription, options: Options) -> FloatArray:
    """Return the initial joint position of the robot (n,) [rad].

    Raises:
        SpecError: The option is not a valid pose of this arm.
    """
    degrees = upright_deg(arm) if options.start_q_deg is None else options.start_q_deg
    numbers = numbers_of(degrees, arm.n_joints)
    q = np.radians(np.array(numbers or [np.nan]))
    if not ((q >= arm.q_min) & (q <= arm.q_max)).all():
        raise SpecError(
            f"start_q_deg {degrees!r} is not a pose of the {arm.name}",
            hint=f"give {arm.n_joints} angles within its joint limits",
        )
    return np.asarray(q)


def wrong_option(name: str, value: object, hint: str) -> SpecError:
    """Return the error for an invalid option, with a hint."""
    return SpecError(f"mock option {name} is {value!r}", hint=hint)


def gravity_of(mount: str | Sequence[float]) -> tuple[float, float, float]:
    """Return gravity in the base frame [m/s²] for a name in `MOUNTS` or for three numbers.

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
    """Return gravity in the base frame [m/s²] for a robot without a station.

    Raises:
        SpecError: There is no such mount.
    """
    return MOUNTS["table"] if options.mount is None else gravity_of(options.mount)


def require_same_mount(options: Options, station: Sequence[float]) -> None:
    """Raise if the option `mount` contradicts the station's gravity (3,) [m/s²].

    Raises:
        SpecError: Mount and station have different gravity, so that the identification would assume
            a different gravity than the simulation.
    """
    if options.mount is None:
        return
    own = gravity_of(options.mount)
    if not np.allclose(own, station):
        raise SpecError(
            f"the mock robot's option mount: {options.mount} means gravity {list(own)} m/s², but "
            f"the station's gravity_m_s2 for this robot is {list(station)}",
            hint=f"remove the option and set gravity_m_s2: {list(own)} beside driver and model",
        )


def mounted_of(options: Options) -> Payload | None:
    """Return the payload that is mounted at the flange; None for the declared payload.

    Raises:
        SpecError: The mapping is not a valid payload.
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
"""Smallest and largest factor of wear on friction."""

GOLDEN_RAD = 2.399963
"""Golden angle [rad], used as the phase step per day so that the phases of consecutive days
differ."""


def truth_of(model: str, options: Options) -> Truth:
    """Return the robot that the options select, with the room temperature of the day.

    Raises:
        SpecError: There is no such arm or profile, or the file belongs to a different arm.
        DataError: The file cannot be read.
    """
    truth = _robot_of(model, options)
    room = truth.ambient_c if options.room_c is None else options.room_c
    phase = truth.ambient_phase_rad + options.day * GOLDEN_RAD
    return replace(truth, ambient_c=room, ambient_phase_rad=phase)


def _robot_of(model: str, options: Options) -> Truth:
    """Return the robot that the options select, without the options of the room temperature.

    Raises:
        SpecError: There is no such arm or profile, or the file belongs to a different arm.
        DataError: The file cannot be read.
    """
    if options.truth_file is None:
        return draw_truth(model, options.seed, options.profile)
    truth = Truth.from_json(options.truth_file)
    if truth.arm != model:
        raise SpecError(
            f"{options.truth_file} is the truth of a {truth.arm}, but the station names {model}",
            hint=f"set model: {truth.arm}",
        )
    return truth


def wear_of(options: Options, n: int) -> FloatArray:
    """Return the factor on the friction of each joint, (n,).

    Raises:
        SpecError: The option does not consist of n valid factors.
    """
    if options.wear is None:
        return np.ones(n)
    factors = numbers_of(options.wear, n)
    least, most = WEAR
    if factors is None or not all(least <= factor <= most for factor in factors):
        hint = f"give {n} factors from {least:g} to {most:g}; 1 is the friction of a new joint"
        raise wrong_option("wear", options.wear, hint)
    return np.array(factors)
