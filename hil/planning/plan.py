"""Plan of an experiment: motions and measurements of a robot as frozen data with a stable hash.

Preview, estimates, preflight, execution and resumption all use the same plan object. The plan
contains the few parameters of each motion instead of samples; `Motion.sample(rate_hz)` always
returns the same set-points (decision record 0003).

A plan that `read_plan` reads from the disk will move a robot. Therefore, `read_plan` first checks
every value of the document, and reports all problems together with their places. The numbers of a
plan document are not converted, so that the hash of the plan does not change.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError
from pydantic_core import ErrorDetails

from hil.arms import Payload
from hil.core import DataError, FloatArray, plugins, read_json, require_known_version, shown
from hil.excitation import LONGEST_S, Motion, motion_from_dict

PLAN_FORMAT = 1
StepKind = Literal["payload", "weigh", "warmup", "move", "dwell", "trajectory", "reference"]

AT_REST: tuple[StepKind, ...] = ("weigh", "dwell", "reference")
"""Kinds of steps at standstill; such steps end when the dwell rule of the plan is satisfied."""


@dataclass(frozen=True, slots=True)
class Step:
    """Single step of a plan.

    Attributes:
        index: Position of the step in the plan; recorded with every sample.
        kind: Kind of the step. The kind `move` changes the pose, `dwell` and `reference` measure at
            standstill, `trajectory` measures in motion, `warmup` moves without measuring, `payload`
            changes the load (with a prompt for the operator), and `weigh` checks at standstill
            whether the mounted load is the declared load.
        motion: Commanded motion; None for a step of kind `payload`.
        pose, trajectory: Number of the pose or trajectory; −1 if the step has none. The poses of
            the payload check are numbered separately.
        approach: Approach direction: +1 if every joint arrived from below, −1 if from above, 0
            otherwise.
        load: Index of the mounted load in `Plan.loads`.
        checkpoint: Whether the run can be paused or resumed immediately before this step.
    """

    index: int
    kind: StepKind
    motion: Motion | None = None
    pose: int = -1
    trajectory: int = -1
    approach: int = 0
    load: int = 0
    checkpoint: bool = False

    @property
    def measures(self) -> bool:
        """Whether a fit or an evaluation uses the samples of the step."""
        return self.kind in ("dwell", "trajectory", "reference")

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form of the step; keys with default values are left out."""
        out: dict[str, Any] = {"index": self.index, "kind": self.kind, "load": self.load}
        out |= {k: v for k in ("pose", "trajectory") if (v := getattr(self, k)) >= 0}
        out |= {k: v for k in ("approach", "checkpoint") if (v := getattr(self, k))}
        return out | ({"motion": self.motion.to_dict()} if self.motion else {})

    @staticmethod
    def from_dict(raw: dict[str, Any]) -> Step:
        """Return the step from a dictionary created by `to_dict`."""
        motion = motion_from_dict(raw["motion"]) if "motion" in raw else None
        return Step(**{**raw, "motion": motion})


@dataclass(frozen=True, slots=True)
class DwellRule:
    """End condition of a dwell.

    A dwell ends when `samples` settled samples are recorded and at least `dwell_s` has passed, at
    the latest after `timeout_s`. A sample is settled if the speed of every joint is below
    `settle_rad_s`.
    """

    dwell_s: float = 0.095
    samples: int = 10
    settle_rad_s: float = 0.002
    timeout_s: float = 3.0


@dataclass(frozen=True, slots=True)
class LoadStep:
    """Load of a plan.

    Attributes:
        payload: Mounted payload.
        prompt: Text that is shown to the operator before the payload is mounted.
        size_m: Length and radius of the payload body along the flange axis [m]; None if unknown.
    """

    payload: Payload
    prompt: str = ""
    size_m: tuple[float, float] | None = None


SETTLING_S = 0.1
"""Typical settling time of an arm after the end of its set-point motion [s]; used only for
estimates."""


@dataclass(frozen=True)
class Plan:
    """Immutable program of motions and measurements for one robot.

    Attributes:
        name: Name of the experiment.
        robot_model: Name of the built-in arm, or path of the URDF, for which the plan was computed.
        joint_names: Names of the n joints.
        rate_hz: Rate at which motions are sampled and states are recorded [Hz].
        steps: Steps in order of execution; the step at position i has the index i.
        loads: List of the payloads, indexed by `Step.load`.
        dwell: End condition of the dwells in which the plan measures.
        weigh_dwell: End condition of a payload-check dwell; None in a plan without such dwells.
        margins: Smallest distance to every limit (see `hil plan`), all ≥ 0.
        condition_number: Column-scaled condition number of the base regressor on the measuring
            samples; infinite if the samples do not determine the parameters.
        whole: Number of poses or trajectories of the whole program, if this plan is a commissioning
            run that executes a part of the program; None for a plan of the whole program. The value
            `whole` is not stored with the plan.
    """

    name: str
    robot_model: str
    joint_names: tuple[str, ...]
    rate_hz: float
    steps: tuple[Step, ...]
    loads: tuple[LoadStep, ...]
    dwell: DwellRule = DwellRule()
    weigh_dwell: DwellRule | None = None
    margins: dict[str, float] = field(default_factory=dict)
    condition_number: float = math.inf
    whole: int | None = field(default=None, compare=False)

    def __iter__(self) -> Iterator[Step]:
        return iter(self.steps)

    def __len__(self) -> int:
        return len(self.steps)

    def __repr__(self) -> str:
        facts = f"{len(self)} steps, {self.duration_s:.0f} s, {self.hash[:12]}"
        return f"<Plan {self.name} for {self.robot_model}: {facts}>"

    def _repr_html_(self) -> str:
        """Return the HTML card for a notebook, with a figure drawn by `hil.report`."""
        drawn: str = plugins.load("hil.cards", "plan")(self)
        return drawn

    @property
    def waypoints(self) -> int:
        """Number of distinct dwell poses; reference visits are not counted."""
        return len({step.pose for step in self.steps if step.kind == "dwell"})

    @cached_property
    def duration_s(self) -> float:
        """Estimated duration of the plan [s]: all motions plus the shortest possible dwells."""
        return sum(self.step_duration_s(step) for step in self.steps)

    @property
    def motions(self) -> list[Motion]:
        """Motions of the plan in order of execution; steps without a motion are left out."""
        return [step.motion for step in self.steps if step.motion is not None]

    @property
    def q_start(self) -> FloatArray:
        """Joint positions (n,) before the first motion of the plan [rad]."""
        return self.motions[0].q_start

    @cached_property
    def extremes(self) -> Extremes:
        """Extreme positions, speeds and accelerations of each joint during the plan."""
        return extremes_of(self.motions, self.rate_hz)

    def dwell_rule(self, step: Step) -> DwellRule:
        """Return the end condition of a dwell for a step at standstill."""
        return (self.weigh_dwell if step.kind == "weigh" else None) or self.dwell

    def step_duration_s(self, step: Step) -> float:
        """Return the estimated duration of one step [s]; a dwell includes its settling time."""
        if step.motion is None:
            return 0.0
        if step.kind in AT_REST:
            rule = self.dwell_rule(step)
            return max(rule.dwell_s, rule.samples / self.rate_hz) + SETTLING_S
        return step.motion.duration_s

    @cached_property
    def hash(self) -> str:
        """SHA-256 digest of the canonical JSON of all data that determine the motion."""
        raw = self.to_dict()
        core = {k: v for k, v in raw.items() if k not in ("margins", "condition_number", "hash")}
        text = json.dumps(core, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form of the plan; `from_dict` returns an equal plan."""
        weigh = {"weigh_dwell": asdict(self.weigh_dwell)} if self.weigh_dwell else {}
        return weigh | {
            "hil_plan": PLAN_FORMAT,
            "name": self.name,
            "robot_model": self.robot_model,
            "joint_names": list(self.joint_names),
            "rate_hz": self.rate_hz,
            "dwell": asdict(self.dwell),
            "loads": [_load_to_dict(load) for load in self.loads],
            "margins": {name: number_or_none(value) for name, value in self.margins.items()},
            "condition_number": number_or_none(self.condition_number),
            "steps": [step.to_dict() for step in self.steps],
        }

    @staticmethod
    def from_dict(raw: dict[str, Any]) -> Plan:
        """Return the plan from a dictionary created by `to_dict`."""
        return Plan(
            name=raw["name"],
            robot_model=raw["robot_model"],
            joint_names=tuple(raw["joint_names"]),
            rate_hz=raw["rate_hz"],
            steps=tuple(Step.from_dict(step) for step in raw["steps"]),
            loads=tuple(_load_from_dict(load) for load in raw["loads"]),
            dwell=DwellRule(**raw["dwell"]),
            weigh_dwell=DwellRule(**weigh) if (weigh := raw.get("weigh_dwell")) else None,
            margins={name: _or_infinite(value) for name, value in raw["margins"].items()},
            condition_number=_or_infinite(raw["condition_number"]),
        )


def _load_to_dict(load: LoadStep) -> dict[str, Any]:
    p = load.payload
    size = {} if load.size_m is None else {"size_m": list(load.size_m)}
    return size | {
        "mass_kg": p.mass,
        "com_m": list(p.com),
        "inertia_kgm2": list(p.inertia),
        "prompt": load.prompt,
    }


def _load_from_dict(raw: dict[str, Any]) -> LoadStep:
    payload = Payload(raw["mass_kg"], tuple(raw["com_m"]), tuple(raw["inertia_kgm2"]))
    size = raw.get("size_m")
    return LoadStep(payload, raw["prompt"], None if size is None else tuple(size))


def _or_infinite(value: float | None) -> float:
    return math.inf if value is None else value


def number_or_none(value: float) -> float | None:
    """Return the value; None if JSON cannot represent the value."""
    return value if math.isfinite(value) else None


@dataclass(frozen=True, slots=True, eq=False)
class Extremes:
    """Extreme values of n joints over all samples.

    `q_min` and `q_max` are positions [rad], `qd_max` is the speed [rad/s] and `qdd_max` the
    acceleration [rad/s²]. Each array of extreme values has the shape (n,).
    """

    q_min: FloatArray
    q_max: FloatArray
    qd_max: FloatArray
    qdd_max: FloatArray


def extremes_of(motions: Iterable[Motion], rate_hz: float) -> Extremes:
    """Return the extreme values of one or more motions at their set-points.

    A motion that occurs several times is evaluated only one time.
    """
    rows = [_extremes(motion, rate_hz) for motion in dict.fromkeys(motions)]
    least, most, speed, acceleration = (np.array(column) for column in zip(*rows, strict=True))
    return Extremes(
        least.min(axis=0), most.max(axis=0), speed.max(axis=0), acceleration.max(axis=0)
    )


def _extremes(motion: Motion, rate_hz: float) -> tuple[FloatArray, ...]:
    samples = motion.sample(rate_hz)
    return (
        np.minimum(motion.q_start, samples.q.min(axis=0)),
        np.maximum(motion.q_start, samples.q.max(axis=0)),
        np.abs(samples.qd).max(axis=0),
        np.abs(samples.qdd).max(axis=0),
    )


def read_plan(path: Path) -> Plan:
    """Return the plan in a JSON file; it equals the written plan, including its hash.

    `read_plan` does not check whether a run was begun with this plan; callers compare `Plan.hash`
    with `plan_hash` of the start document.

    Raises:
        DataError: The file is missing, is not JSON, is not a valid plan (the message lists the
            place of every problem), or was written by a newer version of hil.
    """
    document = read_json(path)
    require_plan(document, str(path))
    return Plan.from_dict(document)


MOST_STEPS = 5_000_000
"""Maximum number of steps in a plan, enough for 100 000 poses from two sides with connecting
lines."""

MOST_JOINTS = 64
LOWEST_RATE_HZ, HIGHEST_RATE_HZ = 1e-3, 20_000.0
MOST_PROBLEMS = 20
Finite = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[float, Strict(), Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Strict(), Field(ge=0, allow_inf_nan=False)]
Rate = Annotated[float, Strict(), Field(ge=LOWEST_RATE_HZ, le=HIGHEST_RATE_HZ)]

Limit = Annotated[float, Strict(), Field(ge=1e-6, le=1e6)]
"""Limit of a motion; the allowed range contains every robot and is safe for trajectory
generation."""

Integer = Annotated[int, Strict()]
Joints = Annotated[tuple[Finite, ...], Field(min_length=1, max_length=MOST_JOINTS)]
Coefficients = Annotated[tuple[Finite, ...], Field(min_length=1, max_length=1000)]
Number = Annotated[Integer, Field(ge=-1, le=2**31 - 1)]


def require_plan(document: Mapping[str, Any], where: str) -> None:
    """Raise if a document is not a valid plan.

    Args:
        document: Parsed JSON document of the plan.
        where: Name of the document's file, which begins the error message.

    Raises:
        DataError: The document has problems, of which the message lists the first twenty, or was
            written by a newer version of hil.
    """
    require_known_version(Path(where), document, "hil_plan", PLAN_FORMAT)
    if problems := _problems_of(document):
        lines = "".join(f"\n  {problem}" for problem in problems[:MOST_PROBLEMS])
        more = "\n  …" if len(problems) > MOST_PROBLEMS else ""
        raise DataError(
            f"{where} is not a valid plan:{lines}{more}",
            hint="restore the original file from a copy, or compute the plan again: hil plan SPEC",
        )


def _problems_of(document: Mapping[str, Any]) -> list[str]:
    try:
        plan = _PlanPart.model_validate(document)
    except ValidationError as error:
        return [_told(one) for one in error.errors(include_url=False, include_context=False)]
    return list(islice(_inconsistencies(plan), MOST_PROBLEMS + 1))


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _DwellPart(_Part):
    dwell_s: Annotated[NonNegative, Field(le=86_400)]
    samples: Annotated[Integer, Field(ge=1, le=1_000_000)]
    settle_rad_s: Positive
    timeout_s: Positive


class _LoadPart(_Part):
    mass_kg: NonNegative
    com_m: tuple[Finite, Finite, Finite]
    inertia_kgm2: tuple[Finite, Finite, Finite, Finite, Finite, Finite]
    prompt: str
    size_m: tuple[NonNegative, NonNegative] | None = None


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


_PLAIN = (str, int, float, bool, type(None))


def _told(error: ErrorDetails) -> str:
    """Return the place, the problem and the value of a validation error as text.

    The text has, for example, the form `steps.12.motion.goal_rad.3: Input should be a valid number,
    not 'abc'`.
    """
    # The path from pydantic contains union tags, which are not keys of the document.
    kinds = ("line", "fourier", "hold")
    place = ".".join(str(part) for part in error["loc"] if part not in kinds)
    given, what = error["input"], error["msg"].removesuffix(".")
    if error["type"] in ("missing", "extra_forbidden") or not isinstance(given, _PLAIN):
        return f"{shown(place, 200)}: {what}"
    return f"{shown(place, 200)}: {what}, not {shown(repr(given))}"


def _inconsistencies(plan: _PlanPart) -> Iterator[str]:
    """Yield a message for each inconsistency between values that are valid individually."""
    n = len(plan.joint_names)
    if len(set(plan.joint_names)) < n:
        yield "joint_names: two joints have the same name"
    for i, step in enumerate(plan.steps):
        at = f"steps.{i}"
        if step.index != i:
            yield f"{at}.index: must be {i}, its position in the plan, not {step.index}"
        if step.load >= len(plan.loads):
            yield f"{at}.load: there is no load {step.load}: `loads` has {len(plan.loads)}"
        if (step.motion is None) != (step.kind == "payload"):
            yield f"{at}.motion: every step except a change of load has a motion"
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
        yield f"kind: the motion would take longer than {LONGEST_S / 3600:.1f} h"


def _shortest_s(motion: _LinePart | _FourierPart | _HoldPart) -> float:
    """Return a lower bound for the duration of a motion [s].

    For a straight line, the bound is evaluated for each limit separately.
    """
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
