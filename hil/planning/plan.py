"""The plan: what the robot will do, as frozen data with a stable hash.

Preview, estimates, preflight, execution and resume all consume this one object. Motions are kept
as their few parameters, not as samples: `Motion.sample(rate_hz)` gives the set-points, always the
same ones (decision record 0003).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any, Literal

from hil.arms import Payload
from hil.core import FloatArray, plugins
from hil.excitation import Motion, motion_from_dict
from hil.planning.extremes import Extremes, extremes_of

PLAN_FORMAT = 1

StepKind = Literal["payload", "weigh", "warmup", "move", "dwell", "trajectory", "reference"]

AT_REST: tuple[StepKind, ...] = ("weigh", "dwell", "reference")
"""Steps that stand still until the plan's dwell rule is met."""


@dataclass(frozen=True, slots=True)
class Step:
    """One thing the robot does.

    Attributes:
        index: Position in the plan; recorded with every sample.
        kind: `move` gets somewhere, `dwell` and `reference` stand still and measure,
            `trajectory` measures in motion, `warmup` moves without measuring, `payload` changes
            the load (with a prompt for the operator), `weigh` stands still to see whether it is
            the load declared.
        motion: The commanded motion; None for `payload`.
        pose, trajectory: Number of the pose (weighing poses count for themselves) or trajectory,
            −1 where there is none.
        approach: +1 when every joint arrived from below, −1 from above, 0 otherwise.
        load: Index into `Plan.loads`.
        checkpoint: True when the run can be paused or resumed before this step.
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
        """True for steps whose samples are fitted to or judged on."""
        return self.kind in ("dwell", "trajectory", "reference")

    def to_dict(self) -> dict[str, Any]:
        """JSON form, without keys that say nothing."""
        out: dict[str, Any] = {"index": self.index, "kind": self.kind, "load": self.load}
        out |= {k: v for k in ("pose", "trajectory") if (v := getattr(self, k)) >= 0}
        out |= {k: v for k in ("approach", "checkpoint") if (v := getattr(self, k))}
        return out | ({"motion": self.motion.to_dict()} if self.motion else {})

    @staticmethod
    def from_dict(raw: dict[str, Any]) -> Step:
        """Inverse of `to_dict`."""
        motion = motion_from_dict(raw["motion"]) if "motion" in raw else None
        return Step(**{**raw, "motion": motion})


@dataclass(frozen=True, slots=True)
class DwellRule:
    """When a dwell is over: `samples` settled ones, at least `dwell_s`, at most `timeout_s`."""

    dwell_s: float = 0.095
    samples: int = 10
    settle_rad_s: float = 0.002
    timeout_s: float = 3.0


@dataclass(frozen=True, slots=True)
class LoadStep:
    """A load of the plan.

    Attributes:
        payload: What is mounted.
        prompt: What the operator is told before it is.
        size_m: Length and radius of its body along the flange axis, None when not known.
    """

    payload: Payload
    prompt: str = ""
    size_m: tuple[float, float] | None = None


@dataclass(frozen=True)
class Plan:
    """An immutable program for one robot.

    Attributes:
        name: The experiment's name.
        robot_model: Built-in arm or URDF the plan was made for.
        joint_names: Length n.
        rate_hz: Rate at which motions are sampled and states recorded.
        steps: In order of execution; step i has index i.
        loads: What `Step.load` points into.
        dwell: When a dwell is over.
        weigh_dwell: When a weighing dwell is over; None in a plan without any.
        margins: Smallest distance to every limit (see `hil plan`), all ≥ 0.
        condition_number: Column-scaled condition number of the base regressor on the plan's
            measuring samples; infinite where they do not determine the parameters.
        whole: Poses or trajectories of the program that this plan is a commissioning run of; None
            for the program itself. Not stored.
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
        told = f"{len(self)} steps, {self.duration_s:.0f} s, {self.hash[:12]}"
        return f"<Plan {self.name} for {self.robot_model}: {told}>"

    def _repr_html_(self) -> str:
        """Return the card for a notebook, with the picture that `hil.report` draws."""
        drawn: str = plugins.load("hil.cards", "plan")(self)
        return drawn

    @property
    def waypoints(self) -> int:
        """Number of distinct poses that are dwelt at (reference visits not counted)."""
        return len({step.pose for step in self.steps if step.kind == "dwell"})

    @cached_property
    def duration_s(self) -> float:
        """Estimated duration: motions plus the shortest possible dwells [s]."""
        return sum(self.step_duration_s(step) for step in self.steps)

    @property
    def motions(self) -> list[Motion]:
        """The motions in order, steps without one left out."""
        return [step.motion for step in self.steps if step.motion is not None]

    @property
    def q_start(self) -> FloatArray:
        """(n,) where the robot must stand before the first motion [rad]."""
        return self.motions[0].q_start

    @cached_property
    def extremes(self) -> Extremes:
        """How far, fast and hard each joint goes."""
        return extremes_of(self.motions, self.rate_hz)

    def dwell_rule(self, step: Step) -> DwellRule:
        """When a step that stands still is over."""
        return (self.weigh_dwell if step.kind == "weigh" else None) or self.dwell

    def step_duration_s(self, step: Step) -> float:
        """Estimated duration of one step [s]; a dwell also needs a moment to settle."""
        if step.motion is None:
            return 0.0
        if step.kind in AT_REST:
            rule = self.dwell_rule(step)
            return max(rule.dwell_s, rule.samples / self.rate_hz) + SETTLING_S
        return step.motion.duration_s

    @cached_property
    def hash(self) -> str:
        """sha256 of the canonical JSON of everything that moves the robot."""
        raw = self.to_dict()
        core = {k: v for k, v in raw.items() if k not in ("margins", "condition_number", "hash")}
        text = json.dumps(core, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """JSON form; `from_dict` gives an equal plan back."""
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
        """Inverse of `to_dict`."""
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


SETTLING_S = 0.1
"""Typical time an arm needs to come to rest after the set-point did [s]; for estimates only."""


def number_or_none(value: float) -> float | None:
    """The value, or None where JSON has no word for it."""
    return value if math.isfinite(value) else None


def _or_infinite(value: float | None) -> float:
    return math.inf if value is None else value


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
