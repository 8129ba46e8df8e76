"""What a station file may say about a mock robot, beside its name and model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray, SpecError
from hil_mock_robot.truth import Profile

UPRIGHT_DEG = {"ur": (0.0, -90.0, 0.0, -90.0, 0.0, 0.0)}
"""Safe starting pose by the first two letters of the arm; all zeros for others."""

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
    """What a station may say about a mock robot, beside its name and model.

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
        journal: File to which the robot appends what it was told and what it did.
        faults: What goes wrong, and when; see `hil_mock_robot.faults.Fault`.
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
    upright = UPRIGHT_DEG.get(arm.name[:2], (0.0,) * arm.n_joints)
    degrees = upright if options.start_q_deg is None else options.start_q_deg
    numbers = numbers_of(degrees, arm.n_joints)
    q = np.radians(np.array(numbers or [np.nan]))
    if not ((q >= arm.q_min) & (q <= arm.q_max)).all():
        raise SpecError(
            f"start_q_deg {degrees!r} is no pose of the {arm.name}",
            hint=f"give {arm.n_joints} angles inside its limits",
        )
    return np.asarray(q)


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


def wrong_option(name: str, value: object, hint: str) -> SpecError:
    """The error that says what one option was and what would be right."""
    return SpecError(f"mock option {name} is {value!r}", hint=hint)
