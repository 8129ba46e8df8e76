"""The motions of a trial: a trajectory of its own, and a way a hand leads an arm along.

Both keep the limits of the arm and its distance from what stands around it, the load included.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.arms import Payload
from hil.control.trial.arm import RATE_HZ, Bench
from hil.control.trial.settings import SEEDS_APART
from hil.core import FloatArray, PlanError
from hil.excitation import Workspace
from hil.planning import build_plan, plannable_arm, roadmap_of, workspace_of
from hil.spec import ExperimentSpec

SETTLE_S = 1.0
"""At rest before the motion begins; not counted."""

LEAD_S = 4.0
"""A hand takes this long to lead a joint forth and back."""

SWINGS_DEG = (20.0, -20.0, 10.0, -10.0, 5.0, -5.0)
"""How far a joint is led: the first of these that is clear."""


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """What the joints are to do, at `RATE_HZ`; the first second is at rest.

    Attributes:
        t: (N,) time from the beginning of the motion [s], negative before it.
        q, qd, qdd: (N, n) [rad, rad/s, rad/s²].
    """

    t: FloatArray
    q: FloatArray
    qd: FloatArray
    qdd: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Leading:
    """A way for a hand: every joint in turn, then all together.

    Attributes:
        start: (n,) pose [rad].
        swing: (n,) how far each joint is led [rad].
        turn_s: How long a joint is led forth and back [s].
    """

    start: FloatArray
    swing: FloatArray
    turn_s: float = LEAD_S

    @property
    def turns_s(self) -> float:
        """When every joint has had its turn [s]."""
        return self.turn_s * len(self.start)

    @property
    def release_s(self) -> float:
        """When the hand lets go: on the way of all joints together, at its fastest [s]."""
        return self.turns_s + self.turn_s / 4

    def at(self, t: float) -> tuple[FloatArray, FloatArray]:
        """Position and velocity (n,) of the hand [rad, rad/s]; at rest before 0."""
        share, rate = np.zeros_like(self.swing), np.zeros_like(self.swing)
        if t >= 0.0:
            now = slice(None) if t >= self.turns_s else int(t // self.turn_s)
            omega = np.pi / self.turn_s
            phase = omega * (t % self.turn_s)
            share[now], rate[now] = np.sin(phase) ** 2, omega * np.sin(2 * phase)
        return self.start + self.swing * share, self.swing * rate


def spec_of(name: str, payload: Payload, seed: int) -> ExperimentSpec:
    """A Fourier trajectory of ten seconds with a load mounted."""
    load = {"mass_kg": payload.mass, "com_m": payload.com, "inertia_kgm2": payload.inertia}
    return ExperimentSpec.model_validate(
        {
            "hil": 1,
            "name": "try-out",
            "robot": name,
            "excitation": {
                "kind": "fourier",
                "trajectories": 1,
                "seed": SEEDS_APART + seed,
                "max_velocity_deg_s": 80,
                "max_acceleration_deg_s2": 200,
            },
            "loads": [{"mass_kg": 0.0} if payload.is_empty else load],
            "reference": {"every": 0},
        }
    )


def trajectory_for(bench: Bench, seed: int) -> Reference:
    """A trajectory from rest to rest, of a seed that experiments do not have by themselves.

    Raises:
        PlanError: There is no clear one.
        SpecError: The load is more than the arm can carry.
    """
    spec = spec_of(bench.name, bench.payload, seed)
    plan = build_plan(spec, bench.robot, rate_hz=RATE_HZ)
    motion = next(step.motion for step in plan.steps if step.kind == "trajectory")
    assert motion is not None
    samples = motion.sample(RATE_HZ)
    rest = round(SETTLE_S * RATE_HZ)
    still = np.zeros((rest, len(motion.q_start)))
    return Reference(
        np.arange(1 - rest, len(samples) + 1) / RATE_HZ,
        np.concatenate((still + motion.q_start, samples.q)),
        np.concatenate((still, samples.qd)),
        np.concatenate((still, samples.qdd)),
    )


def leading_for(bench: Bench) -> Leading:
    """A way for a hand about the roomiest pose of the arm.

    Raises:
        PlanError: A joint cannot be led by even 5°.
    """
    arm = plannable_arm(bench.robot)
    workspace = workspace_of(spec_of(bench.name, bench.payload, 0), bench.robot, arm, RATE_HZ)
    start = roadmap_of(workspace).home
    swing = [_swing(workspace, start, j) for j in range(len(start))]
    together = Leading(start, np.array(swing))
    # All together may touch what no joint alone does.
    while not workspace.is_clear(_along(together.start, together.swing)).all():
        together = Leading(start, together.swing / 2)
        if np.abs(together.swing).max() < np.radians(1.0):
            raise PlanError(
                "no clear path leads all joints of the arm together",
                hint="make the range smaller, or give the obstacles of the station more room",
            )
    return together


def _swing(workspace: Workspace, start: FloatArray, joint: int) -> float:
    for degrees in SWINGS_DEG:
        way = np.zeros_like(start)
        way[joint] = np.radians(degrees)
        if workspace.is_clear(_along(start, way)).all():
            return float(way[joint])
    raise PlanError(
        f"{workspace.joint_names[joint]} cannot be led by {abs(SWINGS_DEG[-1]):g}° about the "
        "roomiest pose of the arm",
        hint="describe the station's surroundings as they are",
    )


def _along(start: FloatArray, way: FloatArray) -> FloatArray:
    return start + np.linspace(0.0, 1.0, 21)[:, None] * way
