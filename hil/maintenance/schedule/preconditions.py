"""Is the robot free and safe to use? Asked before every occasion; nothing moves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hil.core import HilError
from hil.engine import REST_RAD_S, own_checks
from hil.planning import Experiment, held
from hil.robot import Status
from hil.workflow import check_driver

if TYPE_CHECKING:
    from hil.robot import Robot


@dataclass(frozen=True, slots=True)
class RobotReady:
    """Why a robot cannot be used now, as a text; empty when it can.

    A robot is connected to, leased meanwhile, and asked what the preflight asks of it: whether it
    is at rest, without a fault, and what it finds about itself, such as remote control or
    a protective stop. A robot on a virtual clock is this process's own, and always ready.

    Attributes:
        experiment: Says which robot of which station.
        wait_s: How long a robot that somebody else holds is waited for [s].
        tell: Is told once who is waited for.
    """

    experiment: Experiment
    wait_s: float = 0.0
    tell: Callable[[str], object] = lambda text: None

    def __call__(self) -> str:
        """Ask."""
        try:
            if check_driver(self.experiment).clock == "virtual":
                return ""
            with held(self.experiment, wait_s=self.wait_s, report=self.tell) as (robot, _):
                return _trouble(robot)
        except HilError as error:
            return error.message
        except Exception as error:  # a driver may fail in any way it likes
            return f"the robot cannot be asked: {error!r}"


def _trouble(robot: Robot) -> str:
    """What keeps a connected robot from being moved."""
    state = robot.read()[-1]
    told = []
    if int(state["status"]) & Status.FAULT or int(state["fault_code"]):
        told.append(f"the controller reports fault code {int(state['fault_code'])}")
    if (speed := float(np.abs(state["qd"]).max())) > REST_RAD_S:
        told.append(f"its fastest joint moves at {speed:.4f} rad/s")
    told += [result.message for result in own_checks(robot) if not result.passed]
    return "; ".join(told)
