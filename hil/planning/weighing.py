"""Where loads are weighed: a few poses at which mass and centre of mass show best.

A load is weighed by the torques it adds to those of the first load at the same poses, approached
the same way: friction, and what is not known of the arm itself, cancel.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray, PlanError
from hil.dynamics import Balance, RobotModel, static_columns, static_parameters
from hil.excitation import Motion, Roadmap, Visit, draw_poses, pose_visit
from hil.planning.plan import DwellRule, Plan
from hil.robot import Capabilities
from hil.spec import ExperimentSpec

APPROACH_DEG = 3.0

DWELL_S = 1.0
"""Long enough for the controller and the friction to come to rest: dwells of 0.1 s leave twice the
error (on the mock: docs/explanation/weighing.md)."""

SETTLED_S = 0.2
"""The last part of the dwell, whose samples are averaged."""
SEED = 0

BLOCKS = 8
"""Blocks of poses that are drawn at most."""

ENOUGH = 200
"""Candidates among which the best poses differ little from the best of many more."""

FRICTION_SHARE = 0.003
"""Standard deviation of what is left of friction, per torque limit: all there is to go by before
the arm has moved. Measured on the mock; see docs/explanation/weighing.md."""

EFFORT_SHARE = 0.8
"""Of the torque limits, for holding the heaviest load still."""

PRIOR = np.diag([1e-2, 1.0, 1.0, 1.0])
"""Information there is without any pose: 10 kg, 1 kg·m. Makes single poses comparable."""


def why_not_weighed(masses: Sequence[float], poses: int) -> str:
    """Why a sweep over these masses [kg] is planned without weighing; empty when it is with."""
    if max(masses) == min(masses):
        return "there are no two loads of different mass"
    if masses[0] > min(masses):
        return "the first load, which the others are compared with, is not the lightest"
    return "" if poses else "the spec switches weighing off"


def is_sweep(plan: Plan) -> bool:
    """Whether loads differ in mass or centre of mass, so that one can be taken for another."""
    first = plan.loads[0].payload
    return not all(load.payload.agrees_with(first) for load in plan.loads)


def why_plan_not_weighed(plan: Plan, robot: Capabilities) -> str:
    """Why the loads of `plan` are not weighed on this robot; empty when they are."""
    planned = sum(step.kind == "weigh" for step in plan)
    if plan.whole is not None and not planned:
        return "this is a commissioning run"
    if reason := why_not_weighed([load.payload.mass for load in plan.loads], planned):
        return reason
    if robot.effort_kind == "current" and not len(robot.drive_gains):
        return "the robot's drive gains are not known, so its currents are no torques"
    return ""


def weigh_visits(
    spec: ExperimentSpec, arm: ArmDescription, gravity: Sequence[float], roadmap: Roadmap
) -> tuple[Visit, ...]:
    """The visits at which every load is weighed, best first; none when nothing is to be weighed.

    Raises:
        PlanError: No clear pose can be held and approached.
    """
    poses = spec.weigh.poses if spec.weigh else 0
    if why_not_weighed([load.mass_kg for load in spec.loads], poses):
        return ()
    candidates = _Candidates(arm, gravity, [load.payload() for load in spec.loads], roadmap)
    chosen: list[Visit] = []
    while len(chosen) < poses and (visit := candidates.take_best(len(chosen))):
        chosen.append(visit)
    if not chosen:
        raise PlanError(
            "payload-check poses: no pose can be held with every load, approached and reached"
            + (f"; last pose tried: {why}" if (why := candidates.why) else ""),
            hint=f"{roadmap.workspace.larger_space}widen excitation.range_deg, or set weigh: false",
        )
    return tuple(chosen)


def weigh_dwell(dwell: DwellRule, rate_hz: float) -> DwellRule:
    """When a weighing dwell is over, `dwell` being the rule of the program's own dwells."""
    samples = max(2, round(SETTLED_S * rate_hz))
    return DwellRule(DWELL_S, samples, dwell.settle_rad_s, DWELL_S + dwell.timeout_s)


class _Candidates:
    """Clear poses, taken one by one: each adds the most to what those before it tell (D-optimal).

    Args:
        arm: Its torque limits count.
        gravity: (3,) in the base frame [m/s²].
        loads: To be held at every pose.
        roadmap: Has to lead to every pose.
    """

    def __init__(
        self,
        arm: ArmDescription,
        gravity: Sequence[float],
        loads: Sequence[Payload],
        roadmap: Roadmap,
    ) -> None:
        model = RobotModel.from_arm(arm.name, gravity=gravity)
        self._roadmap = roadmap
        self._heaviest = max(loads, key=lambda load: load.mass)
        self._deviation = FRICTION_SHARE * arm.effort_max
        self._q = _drawn(roadmap)
        held = [np.abs(model.with_payload(load).gravity(self._q)) for load in loads]
        bearable = (np.max(held, axis=0) <= EFFORT_SHARE * arm.effort_max).all(axis=1)
        self._columns = static_columns(model, self._q)
        self._torque = self._columns @ static_parameters(self._heaviest)
        self._open = np.flatnonzero(bearable).tolist()
        self._chosen: list[int] = []
        self._refused: list[Motion] = []

    @property
    def why(self) -> str:
        """Return what was in the way at the last pose that could not be visited."""
        return self._roadmap.workspace.obstacle(self._refused) if self._refused else ""

    def take_best(self, number: int) -> Visit | None:
        """The visit to the best pose left that can be reached, as pose `number`."""
        for i in sorted(self._open, key=self._worth, reverse=True):
            self._open.remove(i)
            if visit := self._visit(self._q[i], number):
                self._chosen.append(i)
                return visit
        return None

    def _worth(self, i: int) -> float:
        rows = [*self._chosen, i]
        columns, torque = self._columns[rows], self._torque[rows]
        deviation = np.broadcast_to(self._deviation, torque.shape)
        balance = Balance(columns, torque, deviation, self._heaviest.com)
        return float(np.linalg.slogdet(PRIOR + balance.information)[1])

    def _visit(self, q: FloatArray, number: int) -> Visit | None:
        roadmap, delta = self._roadmap, float(np.radians(APPROACH_DEG))
        label = f"weighing pose {number + 1}"
        visit = pose_visit(
            roadmap.workspace, q, "both", delta, label=label, kind="weigh", pose=number
        )
        if not roadmap.workspace.are_clear(visit.motions):
            self._refused = visit.motions
            return None
        if roadmap.way(roadmap.home, visit.entry) is None:
            self._refused = [roadmap.workspace.line(roadmap.home, visit.entry)]
            return None
        return visit


def _drawn(roadmap: Roadmap) -> FloatArray:
    """(N, n) clear poses that look as if ways lead there."""
    drawn: list[FloatArray] = []
    blocks = draw_poses(roadmap.workspace, SEED, "payload-check poses")
    for block, _ in zip(blocks, range(BLOCKS), strict=False):
        drawn.append(block[roadmap.seem_connected(block)])
        if sum(map(len, drawn)) >= ENOUGH:
            break
    return np.concatenate(drawn)
