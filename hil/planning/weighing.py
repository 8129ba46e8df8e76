"""Poses of the payload check: the few poses that best determine mass and centre of mass of a load.

The load is identified from the difference between its torques and the torques of the first load at
the same poses with the same approach directions, so that friction and model errors of the arm
cancel.
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
"""Dwell time of the payload check [s], after which controller and friction are settled.

Dwells of only 0.1 s double the error of the payload check (measured on the mock:
docs/explanation/weighing.md).
"""

SETTLED_S = 0.2
"""Duration of the last part of the dwell, over which samples are averaged [s]."""
SEED = 0

BLOCKS = 8
"""Maximum number of blocks of random poses that are drawn."""

ENOUGH = 200
"""Number of candidate poses; with many more candidates, the best poses would differ only
slightly."""

FRICTION_SHARE = 0.003
"""Assumed standard deviation of the remaining friction, as a share of the torque limit.

Before the arm has moved, no better estimate of the remaining friction exists. The friction share
was measured on the mock; see docs/explanation/weighing.md.
"""

EFFORT_SHARE = 0.8
"""Share of the torque limits that the arm may use to hold the heaviest load."""

PRIOR = np.diag([1e-2, 1.0, 1.0, 1.0])
"""Prior information matrix, without any pose: standard deviations of 10 kg and 1 kg·m.

With the prior information, single poses can be compared with each other.
"""


def why_not_weighed(masses: Sequence[float], poses: int) -> str:
    """Return why loads with these masses [kg] have no payload check; empty if they have one."""
    if max(masses) == min(masses):
        return "all loads have the same mass"
    if masses[0] > min(masses):
        return "the first load, which the others are compared with, is not the lightest"
    return "" if poses else "the spec disables the payload check"


def is_sweep(plan: Plan) -> bool:
    """Return whether the loads differ in mass or centre of mass, so that they can be confused."""
    first = plan.loads[0].payload
    return not all(load.payload.agrees_with(first) for load in plan.loads)


def why_plan_not_weighed(plan: Plan, robot: Capabilities) -> str:
    """Return why the loads of a plan are not checked on this robot; empty if they are checked."""
    planned = sum(step.kind == "weigh" for step in plan)
    if plan.whole is not None and not planned:
        return "this is a commissioning run"
    if reason := why_not_weighed([load.payload.mass for load in plan.loads], planned):
        return reason
    if robot.effort_kind == "current" and not len(robot.drive_gains):
        return "the robot's drive gains are unknown, so its currents cannot be converted to torques"
    return ""


def weigh_visits(
    spec: ExperimentSpec, arm: ArmDescription, gravity: Sequence[float], roadmap: Roadmap
) -> tuple[Visit, ...]:
    """Return the visits of the payload check, best pose first; empty if no load is checked.

    Raises:
        PlanError: No collision-free pose can be approached and held with every load.
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
    """Return the end condition of a payload-check dwell.

    Args:
        dwell: End condition of the other dwells of the program.
        rate_hz: Sample rate of the recording [Hz].
    """
    samples = max(2, round(SETTLED_S * rate_hz))
    return DwellRule(DWELL_S, samples, dwell.settle_rad_s, DWELL_S + dwell.timeout_s)


class _Candidates:
    """Collision-free candidate poses, selected one by one to maximise the information (D-optimal).

    Args:
        arm: Description of the arm, including its torque limits.
        gravity: (3,) gravity vector in the base frame [m/s²].
        loads: Loads that the arm has to hold at every pose.
        roadmap: Roadmap from which every pose has to be reachable.
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
        """Obstacle at the last pose that could not be visited; empty if every pose was visited."""
        return self._roadmap.workspace.obstacle(self._refused) if self._refused else ""

    def take_best(self, number: int) -> Visit | None:
        """Remove the best remaining reachable pose; return the visit to it as pose `number`."""
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
        label = f"payload-check pose {number + 1}"
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
    """Return (N, n) collision-free poses that are probably connected to the roadmap."""
    drawn: list[FloatArray] = []
    blocks = draw_poses(roadmap.workspace, SEED, "payload-check poses")
    for block, _ in zip(blocks, range(BLOCKS), strict=False):
        drawn.append(block[roadmap.seem_connected(block)])
        if sum(map(len, drawn)) >= ENOUGH:
            break
    return np.concatenate(drawn)
