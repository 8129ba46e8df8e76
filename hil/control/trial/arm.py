"""A simulated arm under torque control: opened afresh for every run, in the pose it begins in."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray, PluginError, RobotFault, SpecError, plugins
from hil.planning import connected
from hil.robot import Robot, TorqueControlled, is_simulated
from hil.spec import StationRobot

RATE_HZ = 1000.0
"""Of the controller."""

REFUSED = "torque is commanded to simulated arms alone"


@dataclass(frozen=True, slots=True)
class Bench:
    """Which simulated arm, and what it carries.

    Attributes:
        name: Of the robot in its station.
        robot: Its entry there.
        payload: What is mounted, and declared.
    """

    name: str
    robot: StationRobot
    payload: Payload

    @contextlib.contextmanager
    def arm(self, q_start: FloatArray) -> Iterator[Arm]:
        """The arm at rest in a pose (n,) [rad], its brakes released by the first torque.

        Raises:
            SpecError: The robot is not a simulated one that can be driven by torque.
            RobotError: It does not come up.
        """
        options: dict[str, Any] = {
            **self.robot.options,
            "start_q_deg": np.degrees(q_start).tolist(),
            "rate_hz": RATE_HZ,
            "block": 1,
        }
        # A process of its own would put a pipe between every two samples.
        ours = self.robot.model_copy(update={"options": options, "own_process": False})
        with connected(self.name, ours) as robot:
            if not self.payload.is_empty:
                robot.set_payload(self.payload)
            yield Arm(robot)


def require_simulated(name: str, robot: StationRobot) -> None:
    """Refuse a robot that is not a simulated one on a virtual clock, before it is opened.

    Raises:
        SpecError: It is not.
        PluginError: Its driver is missing.
    """
    try:
        driver = plugins.load("hil.drivers", robot.driver)
    except PluginError as error:
        raise PluginError(f"{name}: {error.message}", hint=error.hint) from error
    if not is_simulated(driver):
        raise SpecError(
            f"{name} has the driver {robot.driver}, which does not declare itself a simulated arm "
            f"under torque control: {REFUSED}",
            hint="choose a station whose robot has driver: mock (experiments/stations/mock.yaml)",
        )
    if robot.options.get("clock", "virtual") != "virtual":
        raise SpecError(
            f"{name} runs on wall time, but a trial steps its arm sample by sample",
            hint="take clock: wall (and speed, queue_s, watchdog_s) out of the robot's options",
        )


class Arm:
    """One robot, a sample at a time.

    Attributes:
        q, qd: (n,) as measured last [rad, rad/s].
        limit: (n,) torque limits [N·m].
        gains: (n,) torque per current that its controller assumes [N·m/A].
    """

    def __init__(self, robot: Robot) -> None:
        if not (is_simulated(robot) and isinstance(robot, TorqueControlled)):
            raise SpecError(
                f"{robot.identity.model} is no simulated arm under torque control: {REFUSED}"
            )
        self._robot = robot
        limits, can = robot.limits, robot.capabilities
        self.serial = robot.identity.serial
        self.limit, self.speed_limit = limits.effort_max, limits.qd_max
        self.gains = np.array(can.drive_gains)
        self._still = np.zeros(len(can.joint_names))
        self.q = self.qd = self._still
        self._read()

    def step(self, torque: FloatArray, push: FloatArray | None = None) -> bool:
        """Drive by a torque (n,) [N·m] within the limits, pushed by another, for one sample.

        Returns:
            Whether the arm can go on: False when it is too fast or has a fault, or when the
            torque is no number. It is braked then.
        """
        if not np.isfinite(torque).all():
            self.brake()
            return False
        try:
            self._robot.command_torque(np.clip(torque, -self.limit, self.limit))
            self._robot.push(self._still if push is None else push)
            self._read()
        except RobotFault:
            return False
        if np.all(np.abs(self.qd) <= self.speed_limit):
            return True
        self.brake()
        return False

    def brake(self) -> None:
        """Let the brakes bring the arm to rest, nobody pushing."""
        with contextlib.suppress(RobotFault):
            self._robot.push(self._still)
            self._robot.command_torque(None)

    def wait(self) -> bool:
        """Let one sample pass with things as they are; False when the arm has a fault."""
        try:
            self._read()
        except RobotFault:
            return False
        return True

    def _read(self) -> None:
        row = self._robot.read()[-1]
        self.q, self.qd = np.array(row["q"]), np.array(row["qd"])
