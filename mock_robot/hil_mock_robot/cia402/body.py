"""The arm under the drives: demands of its axes in, what they measure out, at steps of 1 ms."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray
from hil_mock_robot.arm import SETTLING_S
from hil_mock_robot.cia402.brake import Brake
from hil_mock_robot.cia402.contracts import STEP_S, Demand, Measured
from hil_mock_robot.cia402.plain_servo import PlainServoArm
from hil_mock_robot.draw import published
from hil_mock_robot.mounting import MOUNTS
from hil_mock_robot.sensors import Sensors
from hil_mock_robot.simulation import Samples, Setting
from hil_mock_robot.truth import Truth

STILL_RAD_S = 1e-3
"""On closed brakes an arm slower than this does not move any more."""

GRIP_STEPS = 100
"""Nor does it when the brakes have had so long."""


class Body:
    """One drawn arm on its brakes, until drives say otherwise.

    Args:
        truth: What it is really like.
        q: (n,) where it stands when it is switched on [rad].
        gravity: In the base frame [m/s²].
        substep_hz: Integration steps per second.
        mounted: What hangs at the flange; nothing when None.
        temperature_c: Of the joints at the start; the room's when None.

    Attributes:
        arm: What is published about it.
        seen: What the axes measured last, from the start on.
        faults: By axis, the EMCY codes that the last block of steps has brought.
        mounted: What hangs at the flange.
    """

    def __init__(
        self,
        truth: Truth,
        q: FloatArray,
        *,
        gravity: tuple[float, float, float] = MOUNTS["table"],
        substep_hz: float = 1000.0,
        mounted: Payload | None = None,
        temperature_c: float | None = None,
    ) -> None:
        self.arm: ArmDescription = published(truth.arm)
        self.faults: dict[int, int] = {}
        self.mounted = mounted or Payload()
        self._sensors = Sensors(truth)
        setting = Setting(1.0 / STEP_S, substep_hz, gravity, temperature_c)
        self._plant = PlainServoArm(truth, setting, np.asarray(q, dtype=float))
        self._plant.set_payloads(self.mounted, Payload())
        self._plant.settle(SETTLING_S)
        n = self.arm.n_joints
        self._brakes = [Brake(float(limit)) for limit in self.arm.qdd_max]
        self._gains: list[float] = self.arm.drive_gains.tolist()
        self._efforts: list[float] = self.arm.effort_max.tolist()
        self._offsets, self._limits, self._torques = [0.0] * n, self._efforts[:], [math.nan] * n
        self._standing, self._rested = False, 0
        self._close_all()
        self.seen: list[Measured] = self._measure(self._plant.stand(1))

    @property
    def fastest(self) -> float:
        """Largest true joint speed [rad/s]."""
        return 0.0 if self._standing else float(np.abs(self._plant.speed).max())

    @property
    def position(self) -> FloatArray:
        """(n,) true joint position [rad]."""
        return self._plant.position

    def advance(self, demands: Sequence[Demand]) -> list[Measured]:
        """Let the arm do what its axes demand, each for the same number of steps."""
        self.faults = {}
        rows = self._rows(demands)
        steps = len(rows)
        samples = self._plant.stand(steps) if self._stands(steps) else self._run(rows)
        self.seen = self._measure(samples)
        return self.seen

    def mount(self, payload: Payload) -> None:
        """Hang something to the flange; closed brakes carry it, servos have to find its weight."""
        self.mounted = payload
        self._plant.set_payloads(payload, Payload())
        if self._standing:
            self._plant.carry()

    def push(self, torque: FloatArray) -> None:
        """Let an external joint torque (n,) [N·m] act from now on; zeros end it."""
        self._plant.disturbances.push[:] = torque

    def heat(self, axis: int, celsius: float) -> None:
        """Set the temperature of one motor [°C]."""
        self._plant.joints.states["celsius"][axis] = celsius

    def _rows(self, demands: Sequence[Demand]) -> FloatArray:
        """(N, 3, n) what the plant follows; brakes, torques and limits are set on the way."""
        steps = len(demands[0].setpoints)
        rows = np.empty((steps, 3, len(demands)))
        for j, demand in enumerate(demands):
            brake = self._brakes[j]
            if demand.braked:
                if not brake.closed:
                    self._close(j)
                rows[:, :, j] = brake.path(steps)
                continue
            if brake.closed:
                brake.closed = self._standing = False
                # The integrator has the whole load; of that, what is added from now on is a part.
                self._offsets[j] = demand.offset
            self._drive(j, demand)
            rows[:, :, j] = demand.setpoints
        return rows

    def _drive(self, j: int, demand: Demand) -> None:
        """Let a drive have its axis."""
        plant = self._plant
        limit = min(demand.limit, self._efforts[j])
        if limit != self._limits[j]:
            self._limits[j] = limit
            plant.limit(j, limit)
        torque, before = demand.torque, self._torques[j]
        plant.disturbances.torque[j] = self._torques[j] = torque
        if not math.isnan(torque):
            return
        if not math.isnan(before):  # what the motor gave is where the integrator begins
            plant.load(j, before)
            self._offsets[j] = demand.offset
        elif demand.offset != self._offsets[j]:
            plant.preload(j, demand.offset - self._offsets[j])
            self._offsets[j] = demand.offset

    def _close(self, j: int) -> None:
        """The brake takes an axis from its drive."""
        plant, followed = self._plant, math.isnan(self._torques[j])
        if not followed:
            plant.load(j, plant.bias(j))
        held = float(plant.setpoint[0, j])
        self._brakes[j].close(held, float(plant.position[j]), float(plant.speed[j]))
        plant.disturbances.torque[j] = self._torques[j] = math.nan
        self._offsets[j], self._limits[j] = 0.0, math.inf
        plant.limit(j, math.inf)

    def _close_all(self) -> None:
        for j, brake in enumerate(self._brakes):
            self._close(j)
            brake.close(float(self._plant.position[j]), 0.0, 0.0)

    def _stands(self, steps: int) -> bool:
        """Whether nothing moves any more, or ever, until a brake opens."""
        if self._standing:
            return True
        if not all(brake.rests for brake in self._brakes):
            self._rested = 0
            return False
        self._rested += steps
        if self._rested > GRIP_STEPS or self.fastest < STILL_RAD_S:
            self._plant.engage_brakes()
            self._close_all()
            self._standing = True
        return self._standing

    def _run(self, rows: FloatArray) -> Samples:
        samples = self._plant.follow(rows)
        self.faults = self._plant.faults
        if len(samples):
            return samples
        self._close_all()
        return self._plant.stand(1)

    def _measure(self, samples: Samples) -> list[Measured]:
        """What the axes report at the end of a block; brakes need no current."""
        last = samples.values[-1:]
        q, qd, current, celsius = (last[:, channel] for channel in range(4))
        seen = self._sensors.measure(q, qd, current, celsius)
        columns = [each[0].tolist() for each in (*seen, q, qd)]
        measured = []
        for row in zip(self._brakes, self._gains, *columns, self._plant.at_limit, strict=True):
            brake, gain, at, speed, amperes, warmth, true_q, true_qd, limited = row
            if brake.closed:
                amperes, limited = 0.0, False
            measured.append(
                Measured(at, speed, amperes * gain, amperes, warmth, true_q, true_qd, limited)
            )
        return measured
