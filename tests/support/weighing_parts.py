"""Sweeps over loads, and a mock on which somebody mounts something else than they say."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hil.arms.payload import Payload
from hil.core.typing import FloatArray, StructArray
from hil.dynamics import RobotModel
from hil.engine import Engine, RunResult
from hil.planning.plan import Plan, Step
from hil.robot import Capabilities, state_dtype
from hil.spec.experiment import Weigh
from hil.workflow.payload_check import PayloadCheck, Readings, gains_of, reading_of
from hil_mock_robot.embedded.robot import MockRobot
from tests.support.engine_parts import ListSink
from tests.support.plan_parts import spec_of, ur5
from tests.support.plans_once import planned_once

UPRIGHT = (0.0, 0.0, -9.81)
CYLINDER = {"mass_kg": 3, "com_m": [0, 0, 0.05], "inertia_kgm2": [4e-3, 4e-3, 2e-3, 0, 0, 0]}
OFF_AXIS = {"mass_kg": 3, "com_m": [0.03, 0, 0.05], "inertia_kgm2": [7e-3, 7e-3, 5e-3, 0, 0, 0]}

Mounted = Callable[[Payload], Payload]
"""What really hangs at the flange when a load is declared."""


def sweep(*loads: dict[str, Any], arm: str = "ur5", **changes: Any) -> Plan:
    """Weighing and next to nothing else: one pose per load, not warmed up."""
    facts: dict[str, Any] = {"excitation": {"kind": "dwell", "waypoints": 1}}
    spec = spec_of(loads=list(loads), **(facts | changes))
    return planned_once(spec, ur5(arm))


def bodies(*masses: float) -> list[dict[str, Any]]:
    """Loads of these masses, 5 cm in front of the flange."""
    return [
        {"mass_kg": m, "com_m": [0, 0, 0.05], "inertia_kgm2": [1e-3 * m] * 3 + [0] * 3} if m else {}
        for m in masses
    ]


class MountedRobot(MockRobot):
    """Declares the load to its controller and hangs another one on the flange."""

    mounted: Mounted = staticmethod(lambda declared: declared)

    def set_payload(self, payload: Payload) -> Payload:
        back = super().set_payload(payload)
        self._arm.on.set_payloads(self.mounted(payload), payload)
        return back


@dataclass
class Weighed:
    """What came of it."""

    result: RunResult
    events: list[dict[str, Any]] = field(default_factory=list)

    @property
    def message(self) -> str:
        return self.result.error.message if self.result.error else ""


def weigh(
    plan: Plan,
    mounted: Mounted = lambda declared: declared,
    *,
    tolerance: Weigh | None = None,
    waived: bool = False,
    **options: Any,
) -> Weighed:
    """Run a plan on a mock of its own."""
    start = np.degrees(plan.q_start).tolist()
    robot = MountedRobot("weighed", plan.robot_model, start_q_deg=start, **options)
    robot.mounted = mounted
    robot.connect()
    sink = ListSink()
    weighing = PayloadCheck(
        plan,
        UPRIGHT,
        robot.capabilities,
        tolerance or Weigh(),
        event=sink.event,
        waived=waived,
    )
    result = Engine(plan, robot, sink, measured=weighing.measured).run()
    return Weighed(result, [event for event in sink.events if event["kind"] == "weighing"])


@dataclass
class Scales:
    """Hands made-up dwells to a weighing: torques of the rigid body, friction by the approach."""

    plan: Plan
    mounted: Mounted = lambda declared: declared
    friction_nm: float = 2.0
    effort_kind: Any = "torque"
    gains: Sequence[float] = ()
    waived: bool = False
    events: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        plan = self.plan
        can = Capabilities(plan.joint_names, plan.rate_hz, self.effort_kind, tuple(self.gains))
        self.can = can
        self.model = RobotModel.from_arm(plan.robot_model)
        self.weighing = PayloadCheck(
            plan, UPRIGHT, can, Weigh(), event=self._event, waived=self.waived
        )

    def _event(self, kind: str, **details: Any) -> None:
        self.events.append({"kind": kind, **details})

    def steps(self, load: int) -> list[Step]:
        return [step for step in self.plan if step.kind == "weigh" and step.load == load]

    def rows(self, step: Step) -> StructArray:
        """What a robot would record of a dwell, and a bit of the way there."""
        assert step.motion is not None
        model = self.model.with_payload(self.mounted(self.plan.loads[step.load].payload))
        torque: FloatArray = model.gravity(step.motion.q_end[None])[0]
        rows = np.zeros(self.plan.dwell_rule(step).samples + 30, dtype=state_dtype(model.n))
        rows["effort"] = torque + step.approach * self.friction_nm
        rows["effort"] /= np.array(self.gains) if len(self.gains) else 1.0
        rows["effort"][:30] += 50.0
        rows["q"] = rows["q_target"] = step.motion.q_end
        rows["segment"] = step.index
        return rows

    def settled(self, step: Step) -> StructArray:
        return self.rows(step)[30:]

    def earlier(self) -> Readings:
        """What the first load weighed here, for the weighing of a later attempt."""
        gains = gains_of(self.can)
        return {s.index: reading_of(self.settled(s), gains, 0.002) for s in self.steps(0)}

    def weigh(self, *loads: int) -> None:
        for load in loads or range(len(self.plan.loads)):
            for step in self.steps(load):
                self.weighing.measured(step, self.settled(step))
