"""What a plan document (`plan.json`) must be, checked before anything is made of it.

A plan read back from a disk moves a robot: every value is looked at, and everything that is wrong
is told at once, with its place. Numbers stay as they were written, so that a plan's hash does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError
from pydantic_core import ErrorDetails

from hil.core import DataError, require_known_version, shown
from hil.excitation import LONGEST_S
from hil.planning.plan import PLAN_FORMAT, StepKind

MOST_STEPS = 5_000_000
"""100 000 poses from two sides, with the lines that lead there, have fewer."""

MOST_JOINTS = 64
LOWEST_RATE_HZ, HIGHEST_RATE_HZ = 1e-3, 20_000.0
MOST_PROBLEMS = 20
_PLAIN = (str, int, float, bool, type(None))

Finite = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[float, Strict(), Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Strict(), Field(ge=0, allow_inf_nan=False)]
Rate = Annotated[float, Strict(), Field(ge=LOWEST_RATE_HZ, le=HIGHEST_RATE_HZ)]
Limit = Annotated[float, Strict(), Field(ge=1e-6, le=1e6)]
"""Of a motion: what trajectory generation can be trusted with, far beyond any robot either way."""
Integer = Annotated[int, Strict()]
Joints = Annotated[tuple[Finite, ...], Field(min_length=1, max_length=MOST_JOINTS)]
Coefficients = Annotated[tuple[Finite, ...], Field(min_length=1, max_length=1000)]
Number = Annotated[Integer, Field(ge=-1, le=2**31 - 1)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _LinePart(_Part):
    kind: Literal["line"]
    start_rad: Joints
    goal_rad: Joints
    velocity_rad_s: Limit
    acceleration_rad_s2: Limit
    jerk_rad_s3: Limit
    rate_hz: Rate


class _FourierPart(_Part):
    kind: Literal["fourier"]
    q0_rad: Joints
    a_rad_s: tuple[Coefficients, ...]
    b_rad_s: tuple[Coefficients, ...]
    fundamental_hz: Positive
    periods: Annotated[Integer, Field(ge=1, le=1000)]


class _HoldPart(_Part):
    kind: Literal["hold"]
    q_rad: Joints


class _StepPart(_Part):
    index: Annotated[Integer, Field(ge=0)]
    kind: StepKind
    load: Annotated[Integer, Field(ge=0)]
    pose: Number = -1
    trajectory: Number = -1
    approach: Literal[-1, 0, 1] = 0
    checkpoint: Annotated[bool, Strict()] = False
    motion: Annotated[_LinePart | _FourierPart | _HoldPart | None, Field(discriminator="kind")] = (
        None
    )


class _LoadPart(_Part):
    mass_kg: NonNegative
    com_m: tuple[Finite, Finite, Finite]
    inertia_kgm2: tuple[Finite, Finite, Finite, Finite, Finite, Finite]
    prompt: str
    size_m: tuple[NonNegative, NonNegative] | None = None


class _DwellPart(_Part):
    dwell_s: Annotated[NonNegative, Field(le=86_400)]
    samples: Annotated[Integer, Field(ge=1, le=1_000_000)]
    settle_rad_s: Positive
    timeout_s: Positive


class _PlanPart(_Part):
    hil_plan: Integer
    name: str
    robot_model: str
    joint_names: Annotated[tuple[str, ...], Field(min_length=1, max_length=MOST_JOINTS)]
    rate_hz: Rate
    dwell: _DwellPart
    weigh_dwell: _DwellPart | None = None
    loads: Annotated[tuple[_LoadPart, ...], Field(min_length=1, max_length=100_000)]
    margins: dict[str, Finite | None]
    condition_number: Positive | None
    steps: Annotated[tuple[_StepPart, ...], Field(max_length=MOST_STEPS)]


def require_plan(document: Mapping[str, Any], where: str) -> None:
    """Refuse what is no plan.

    Args:
        document: As it comes out of JSON.
        where: Begins the message.

    Raises:
        DataError: With everything that is wrong (the first twenty of it), or because a newer hil
            wrote it.
    """
    require_known_version(Path(where), document, "hil_plan", PLAN_FORMAT)
    if problems := _problems_of(document):
        told = "".join(f"\n  {problem}" for problem in problems[:MOST_PROBLEMS])
        more = "\n  …" if len(problems) > MOST_PROBLEMS else ""
        raise DataError(
            f"{where} is no plan:{told}{more}",
            hint="take the original file from a copy, or make the plan again: hil plan SPEC",
        )


def _problems_of(document: Mapping[str, Any]) -> list[str]:
    try:
        plan = _PlanPart.model_validate(document)
    except ValidationError as error:
        return [_told(one) for one in error.errors(include_url=False, include_context=False)]
    return list(islice(_inconsistencies(plan), MOST_PROBLEMS + 1))


def _told(error: ErrorDetails) -> str:
    """`steps.12.motion.goal_rad.3: Input should be a valid number, not 'abc'`."""
    # The name of a union's branch in the path is no key of the document.
    kinds = ("line", "fourier", "hold")
    place = ".".join(str(part) for part in error["loc"] if part not in kinds)
    given, what = error["input"], error["msg"].removesuffix(".")
    if error["type"] in ("missing", "extra_forbidden") or not isinstance(given, _PLAIN):
        return f"{shown(place, 200)}: {what}"
    return f"{shown(place, 200)}: {what}, not {shown(repr(given))}"


def _inconsistencies(plan: _PlanPart) -> Iterator[str]:
    """What the single values do not show."""
    n = len(plan.joint_names)
    if len(set(plan.joint_names)) < n:
        yield "joint_names: two joints have the same name"
    for i, step in enumerate(plan.steps):
        at = f"steps.{i}"
        if step.index != i:
            yield f"{at}.index: must be {i}, its place in the plan, not {step.index}"
        if step.load >= len(plan.loads):
            yield f"{at}.load: there is no load {step.load}: `loads` has {len(plan.loads)}"
        if (step.motion is None) != (step.kind == "payload"):
            yield f"{at}.motion: every step but a change of load has one"
        elif step.motion is not None:
            yield from (f"{at}.motion.{problem}" for problem in _motion(step.motion, n))


def _motion(motion: _LinePart | _FourierPart | _HoldPart, n: int) -> Iterator[str]:
    for key, value in motion:
        if isinstance(value, tuple) and len(value) != n:
            yield f"{key}: has {len(value)} entries for {n} joints"
            return
    rows = (*motion.a_rad_s, *motion.b_rad_s) if isinstance(motion, _FourierPart) else ()
    if len({len(row) for row in rows}) > 1:
        yield "a_rad_s: the joints have different numbers of harmonics"
    if _shortest_s(motion) > LONGEST_S:
        yield f"kind: it would take longer than {LONGEST_S / 3600:.1f} h"


def _shortest_s(motion: _LinePart | _FourierPart | _HoldPart) -> float:
    """How long a motion takes at least [s]; each limit of a line alone, never the product."""
    if isinstance(motion, _FourierPart):
        return motion.periods / motion.fundamental_hz
    if isinstance(motion, _HoldPart):
        return 0.0
    way = max(abs(b - a) for a, b in zip(motion.start_rad, motion.goal_rad, strict=True))
    return max(
        way / motion.velocity_rad_s,
        2 * math.sqrt(way / motion.acceleration_rad_s2),
        math.cbrt(32 * (way / motion.jerk_rad_s3)),
    )
