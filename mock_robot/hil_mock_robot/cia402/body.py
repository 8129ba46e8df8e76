"""Simulated arm moved by the mock drives, in steps of 1 ms.

The input of the simulation is a `Demand` for each axis; the output is a `Measured` for each axis.
`Body` is the simulated arm with its brakes. `PlainServoArm` is the simulation with the joint servos
of plain drives: each servo knows the inertia of its own rotor and has no model of the arm. A robot
controller, in contrast, feeds forward the torques of a model of the arm. A plain drive has only a
position and a velocity loop, an integrator, and the torque offset from the master (60B2h).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray
from hil_mock_robot.plant.records import MOUNTS, SETTLING_S, STATE, Joints
from hil_mock_robot.plant.sensors import Sensors
from hil_mock_robot.plant.simulation import Samples, Setting, Simulation
from hil_mock_robot.plant.step import FAULT_OVERLOAD, FAULT_RUNAWAY, OVERLOAD_S, TRACKING_LIMIT_RAD
from hil_mock_robot.plant.truth import Truth, published

STEP_S = 0.001
"""Period of the drives' position loop, and step of the whole simulation [s]."""

STILL_RAD_S = 1e-3
"""Speed below which an arm on closed brakes counts as at rest [rad/s]."""

GRIP_STEPS = 100
"""Number of steps on closed brakes after which an arm counts as at rest at any speed."""


class Demand(NamedTuple):
    """Demand of one drive on its motor during a block of steps.

    Attributes:
        setpoints: (N, 3) set-points of the joint: position [rad], velocity [rad/s] and acceleration
            [rad/s²].
        torque: Commanded joint torque [N·m]; NaN if the joint follows the set-points.
        braked: Whether the holding brake is closed, so that no current flows.
        offset: Joint torque [N·m] that the drive adds to the torque of its servo.
        limit: Largest joint torque of the drive [N·m].
    """

    setpoints: FloatArray
    torque: float
    braked: bool
    offset: float = 0.0
    limit: float = math.inf


class Measured(NamedTuple):
    """Measurements of one axis at the end of a block.

    Attributes:
        q: Position with sensor noise [rad].
        qd: Speed with sensor noise [rad/s].
        torque: Torque at the joint [N·m], computed by the drive from the motor current.
        current: Motor current [A].
        celsius: Motor temperature [°C].
        true_q: Position without noise [rad], for tests and the journal.
        true_qd: Speed without noise [rad/s], for tests and the journal.
        limited: Whether the drive is at its torque limit.
    """

    q: float
    qd: float
    torque: float
    current: float
    celsius: float
    true_q: float
    true_qd: float
    limited: bool = False


class Body:
    """Arm with random parameters, held by its brakes until the drives release the brakes.

    Args:
        truth: True parameters of the arm.
        q: (n,) joint positions when the arm is switched on [rad].
        gravity: Gravity in the base frame [m/s²].
        substep_hz: Rate of the integration steps [Hz].
        mounted: Payload at the flange; None for no payload.
        temperature_c: Temperature of all joints at the start [°C]; None for the room temperature.

    Attributes:
        arm: Published description of the arm, which differs from the true parameters.
        seen: Last measurements of all axes, available from the start.
        faults: EMCY codes of the last block of steps, by axis.
        mounted: Payload at the flange.
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
        """Move the arm according to the demands of all axes, and return the measurements.

        All demands must have the same number of steps.
        """
        self.faults = {}
        rows = self._rows(demands)
        steps = len(rows)
        samples = self._plant.stand(steps) if self._stands(steps) else self._run(rows)
        self.seen = self._measure(samples)
        return self.seen

    def mount(self, payload: Payload) -> None:
        """Mount a payload, which closed brakes hold and to which servos must adapt."""
        self.mounted = payload
        self._plant.set_payloads(payload, Payload())
        if self._standing:
            self._plant.carry()

    def push(self, torque: FloatArray) -> None:
        """Apply an external torque (n,) [N·m] to the joints until the next call of `push`."""
        self._plant.disturbances.push[:] = torque

    def heat(self, axis: int, celsius: float) -> None:
        """Set the temperature of one motor [°C]."""
        self._plant.joints.states["celsius"][axis] = celsius

    def _rows(self, demands: Sequence[Demand]) -> FloatArray:
        """Return (N, 3, n) set-points of the plant; also set brakes, torques and limits."""
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
                # The integrator already carries the whole load, including this torque offset.
                self._offsets[j] = demand.offset
            self._drive(j, demand)
            rows[:, :, j] = demand.setpoints
        return rows

    def _drive(self, j: int, demand: Demand) -> None:
        """Apply the torque, torque limit and torque offset of a drive that controls its axis."""
        plant = self._plant
        limit = min(demand.limit, self._efforts[j])
        if limit != self._limits[j]:
            self._limits[j] = limit
            plant.limit(j, limit)
        torque, before = demand.torque, self._torques[j]
        plant.disturbances.torque[j] = self._torques[j] = torque
        if not math.isnan(torque):
            return
        if not math.isnan(before):  # the integrator begins at the motor's last torque
            plant.load(j, before)
            self._offsets[j] = demand.offset
        elif demand.offset != self._offsets[j]:
            plant.preload(j, demand.offset - self._offsets[j])
            self._offsets[j] = demand.offset

    def _close(self, j: int) -> None:
        """Close the brake of an axis; the drive loses control."""
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
        """Return whether no joint moves until a brake opens."""
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
        """Return the measurements at the end of a block; closed brakes mean zero current."""
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


DECELERATIONS = 2.0
"""Deceleration of a brake as a multiple of the joint's maximum acceleration."""

AT_REST_RAD_S = 0.01
"""Speed below which a brake closes without any further motion [rad/s]."""


class Brake:
    """Holding brake of a joint, with the motion of the joint while the brake is closed.

    Args:
        qdd_max: Maximum acceleration of the joint [rad/s²].

    Attributes:
        closed: Whether the brake is closed; True at the start.
    """

    def __init__(self, qdd_max: float) -> None:
        self._deceleration = DECELERATIONS * qdd_max
        self.closed = True
        self._q = self._qd = 0.0

    @property
    def rests(self) -> bool:
        """Whether the brake is closed and the joint is at rest."""
        return self.closed and self._qd == 0.0

    def close(self, held: float, q: float, qd: float) -> None:
        """Close the brake; a joint at rest stays at its set-point.

        Args:
            held: Set-point of the joint [rad].
            q: Position of the joint [rad].
            qd: Speed of the joint [rad/s].
        """
        self.closed = True
        slow = abs(qd) < AT_REST_RAD_S
        self._q, self._qd = (held, 0.0) if slow else (q, qd)

    def path(self, steps: int) -> FloatArray:
        """Return (N, 3) position, velocity and acceleration of the joint at the next N steps."""
        rows = np.zeros((steps, 3))
        if self._qd == 0.0:
            rows[:, 0] = self._q
            return rows
        for row in rows:
            before = self._qd
            least = max(0.0, abs(before) - self._deceleration * STEP_S)
            self._qd = least if before > 0.0 else -least
            self._q += 0.5 * (before + self._qd) * STEP_S
            row[:] = self._q, self._qd, (self._qd - before) / STEP_S
        return rows


INTEGRAL_S = 0.1

REST_INTEGRAL_S = 0.1
"""Reset times of the integrators in motion and at rest [s].

The control loop of a single drive is faster than the servo of a whole arm.
"""

OVERCURRENT, TOO_FAR_AWAY = 0x2310, 0x8611
"""EMCY codes of faults that the simulation detects: over-current, following error."""

NEARLY = 0.99
"""Share of the drive's own torque from which a torque limit (6072h) counts as no limit.

A drive's torque limit must be compared with a tolerance, because the rated torque is rounded.
"""


class PlainServoArm(Simulation):
    """`Simulation` in which each joint has a separate torque, torque limit and fault.

    Attributes:
        faults: EMCY codes of the last rows, by joint.
    """

    faults: dict[int, int]

    def preload(self, joint: int, torque: float) -> None:
        """Add a torque [N·m] to the integrator of a joint."""
        self.joints.states["integral"][joint] += torque

    def load(self, joint: int, torque: float) -> None:
        """Set the torque [N·m] of the integrator of a joint."""
        self.joints.states["integral"][joint] = torque

    def limit(self, joint: int, torque: float) -> None:
        """Set the torque limit of a drive [N·m]."""
        self.joints.servos["limit"][joint] = torque

    def take(self, joint: int) -> None:
        """Set the set-point of one joint to the joint's present state."""
        data = self.plant.data
        self._setpoint[:, joint] = data.qpos[joint], data.qvel[joint], 0.0

    def bias(self, joint: int) -> float:
        """Return the torque [N·m] of gravity and motion on a joint."""
        return float(self.plant.data.qfrc_bias[joint])

    def carry(self) -> None:
        """Set the integrator of each joint to the gravity torque of the joint."""
        mujoco.mj_forward(self.plant.model, self.plant.data)
        self.joints.states["integral"] = self.plant.data.qfrc_bias

    @property
    def at_limit(self) -> list[bool]:
        """(n,) whether the servo requests more torque than its limit."""
        wanted: list[bool] = (self.joints.states["overload_s"] > 0.0).tolist()
        return wanted

    def follow(self, rows: FloatArray) -> Samples:
        """Follow the set-points (N, 3, n) to their end, even if faults occur.

        If the simulation diverges, the function returns no samples, and the arm is back at the
        position before the first set-point.
        """
        self.faults = {}
        before = self.position
        done, samples = 0, self.advance(rows)
        while samples.fault and samples.fault != FAULT_RUNAWAY:
            done += len(samples)
            self._blame(samples.fault, rows[done - 1, 0])
            if done >= len(rows):
                break
            samples = self.advance(rows[done:])
        if samples.fault == FAULT_RUNAWAY:
            self._put_back(before)
            return Samples(samples.values[:0], samples.fault)
        for joint, torque in enumerate(self.disturbances.torque.tolist()):
            if torque == torque:
                self.take(joint)
        return samples

    def engage_brakes(self) -> None:
        """Close the brakes (see `Simulation`), without changing the torques of the integrators."""
        given = self.joints.states["integral"].copy()
        super().engage_brakes()
        self.joints.states["integral"] = given

    def _blame(self, fault: int, followed: FloatArray) -> None:
        """Record the joints that caused a fault; `followed` (n,) are the set-points [rad]."""
        if fault == FAULT_OVERLOAD:
            overload, limits = self.joints.states["overload_s"], self.joints.servos["limit"]
            for j in np.flatnonzero(overload > OVERLOAD_S):
                overload[j] = 0.0
                if limits[j] > NEARLY * self.arm.effort_max[j]:
                    self.faults[int(j)] = OVERCURRENT
            return
        away = np.abs(self.position - followed)
        away[~np.isnan(self.disturbances.torque)] = 0.0
        self.faults |= {int(j): TOO_FAR_AWAY for j in np.flatnonzero(away > TRACKING_LIMIT_RAD)}

    def _put_back(self, q: FloatArray) -> None:
        """Reset a diverged simulation: the arm stands still at `q` (n,) [rad]."""
        data, states = self.plant.data, self.joints.states
        speed = np.nan_to_num(np.abs(data.qvel), nan=math.inf)
        self.faults[int(speed.argmax())] = TOO_FAR_AWAY
        mujoco.mj_resetData(self.plant.model, data)
        data.qpos[:] = q
        for name in (name for name in STATE.names or () if name != "celsius"):
            states[name] = 0.0
        self.joints.forces[:] = 0.0
        self.engage_brakes()

    def _build_joints(self) -> Joints:
        joints = super()._build_joints()
        servos = joints.servos
        servos["integral"] = servos["stiffness"] / INTEGRAL_S
        servos["rest_integral"] = servos["stiffness"] / REST_INTEGRAL_S
        servos["windup"] = self.arm.effort_max
        for unknown in ("coulomb", "load_share", "viscous"):
            servos[unknown] = 0.0
        return joints

    def _attach(self) -> None:
        """Return the model that the drives use: rotors without an arm and without gravity."""
        believed = self._nominal.model
        believed.opt.gravity[:] = 0.0
        believed.body_mass[:] = 0.0
        believed.body_inertia[:] = 0.0
        super()._attach()
