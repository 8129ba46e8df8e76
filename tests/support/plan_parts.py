"""Workspaces and specs for tests of excitation and plan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hil.core.typing import FloatArray
from hil.excitation.workspace import Workspace
from hil.planning.build import build_plan
from hil.planning.plan import Plan
from hil.spec.experiment import ExperimentSpec
from hil.spec.station import StationRobot, Surroundings

DEGREE = np.pi / 180


class JointSpace:
    """A collision model that is a function of the joint positions: walls drawn in joint space."""

    def __init__(self, distance: Callable[[FloatArray], FloatArray]) -> None:
        self.distance = distance
        self.asked = 0

    def clearance(self, q: FloatArray) -> FloatArray:
        self.asked += len(q)
        return np.asarray(self.distance(q), dtype=np.float64)

    def clearances(self, paths: Sequence[FloatArray], enough: float | None = None) -> FloatArray:
        every = [self.clearance(path) for path in paths]
        if enough is None:
            return np.array([each.min() for each in every])
        # As a real model may: any distance of a path that keeps it, any too small one otherwise.
        return np.array([next((d for d in each if d < enough), each[0]) for each in every])

    def closest(self, q: FloatArray) -> tuple[float, tuple[str, str]]:
        return float(self.clearance(q[None])[0]), ("arm", "drawing")


def always_clear(q: FloatArray) -> FloatArray:
    return np.ones(len(q))


def toy_workspace(
    distance: Callable[[FloatArray], FloatArray] = always_clear, n: int = 2, **changes: Any
) -> Workspace:
    """n joints of ±1.5 rad with ±2 rad limits; 1 rad/s, 2 rad/s², 20 rad/s³ at 100 Hz."""
    ones = np.ones(n)
    names = tuple(f"joint {i + 1}" for i in range(n))
    facts: dict[str, Any] = {
        "joint_names": names,
        "q_min": -2.0 * ones,
        "q_max": 2.0 * ones,
        "low": -1.5 * ones,
        "high": 1.5 * ones,
        "collision": JointSpace(distance),
        "clearance_m": 0.02,
        "velocity": 1.0,
        "acceleration": 2.0,
        "jerk": 20.0,
        "rate_hz": 100.0,
    }
    return Workspace(**(facts | changes))


def spec_of(**changes: Any) -> ExperimentSpec:
    """Six poses on a UR5 without warm-up and references, unless told otherwise."""
    facts: dict[str, Any] = {
        "hil": 1,
        "name": "test",
        "robot": "ur5",
        "excitation": {"kind": "dwell", "waypoints": 6},
        "warm_up": {"duration_s": 0},
        "reference": {"every": 0},
    }
    return ExperimentSpec.model_validate(facts | changes)


def ur5(model: str = "ur5", **surroundings: Any) -> StationRobot:
    """A UR5 on a table, with whatever else stands around."""
    return StationRobot(
        driver="mock", model=model, surroundings=Surroundings.model_validate(surroundings)
    )


def plan_of(station: StationRobot | None = None, **changes: Any) -> Plan:
    """The plan of `spec_of(**changes)`."""
    return build_plan(spec_of(**changes), station or ur5())


def samples_between(plan: Plan) -> list[tuple[FloatArray, FloatArray]]:
    """For each motion where it begins and all its set-points."""
    return [(m.q_start, m.sample(plan.rate_hz).q) for m in plan.motions]
