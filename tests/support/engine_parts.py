"""A small plan, a sink that keeps everything, and an engine on them."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.arms.payload import Payload
from hil.core.typing import StructArray
from hil.engine import Engine
from hil.excitation.motion import Hold, Line
from hil.planning.plan import DwellRule, LoadStep, Plan, Step
from tests.support.kinematic_robot import KinematicRobot


class ListSink:
    """Keeps what it is given."""

    def __init__(self) -> None:
        self.blocks: list[StructArray] = []
        self.events: list[dict[str, Any]] = []
        self.extra: list[tuple[str, StructArray]] = []

    def put(self, rows: StructArray) -> None:
        self.blocks.append(rows.copy())

    def put_topic(self, topic: str, rows: StructArray) -> None:
        self.extra.append((topic, rows.copy()))

    def event(self, kind: str, **details: Any) -> None:
        self.events.append({"kind": kind, **details})

    @property
    def rows(self) -> StructArray:
        return np.concatenate(self.blocks)


def line(a: float, b: float) -> Line:
    return Line((a,) * 6, (b,) * 6, velocity=1.0, acceleration=1.4, jerk=14.0, rate_hz=125.0)


def small_plan(prompt: str = "") -> Plan:
    steps = (
        Step(0, "payload"),
        Step(1, "move", line(0.0, 0.3), checkpoint=True),
        Step(2, "dwell", Hold((0.3,) * 6), pose=0, approach=1),
        Step(3, "move", line(0.3, -0.2), checkpoint=True),
        Step(4, "dwell", Hold((-0.2,) * 6), pose=1, approach=-1),
    )
    names = tuple(f"j{i + 1}" for i in range(6))
    loads = (LoadStep(Payload(1.0), prompt),)
    return Plan("small", "ur5", names, 125.0, steps, loads, DwellRule(samples=10))


def engine(robot: KinematicRobot, sink: ListSink, **options: Any) -> Engine:
    robot.connect()
    return Engine(options.pop("plan", small_plan()), robot, sink, **options)
