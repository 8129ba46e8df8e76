"""The arm with the joint servos of plain drives: each knows its own rotor, and nothing of the arm.

A robot's own controller feeds forward what a model of the whole arm needs; a drive on a bus has
position and velocity, an integrator, and what its master adds by the torque offset (60B2h).
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from hil.core import FloatArray
from hil_mock_robot.records import STATE, Joints
from hil_mock_robot.simulation import Samples, Simulation
from hil_mock_robot.step import FAULT_OVERLOAD, FAULT_RUNAWAY, OVERLOAD_S, TRACKING_LIMIT_RAD

INTEGRAL_S = 0.1
REST_INTEGRAL_S = 0.1
"""Reset times of the integrators: a drive's loop is quicker than the servo of a whole arm."""

OVERCURRENT, TOO_FAR_AWAY = 0x2310, 0x8611
"""EMCY codes of what goes wrong in the plant: continuous over-current, following error."""

NEARLY = 0.99
"""A torque limit (6072h) of so much of the drive's own is none: rated torque is rounded."""


class PlainServoArm(Simulation):
    """A `Simulation` whose joints go their own ways: each with its torque, its limit, its faults.

    Attributes:
        faults: By joint, the EMCY codes that the last rows have brought.
    """

    faults: dict[int, int]

    def preload(self, joint: int, torque: float) -> None:
        """Add to the torque [N·m] that a joint's integrator gives."""
        self.joints.states["integral"][joint] += torque

    def load(self, joint: int, torque: float) -> None:
        """Set the torque [N·m] that a joint's integrator gives."""
        self.joints.states["integral"][joint] = torque

    def limit(self, joint: int, torque: float) -> None:
        """Let a drive give no more than this [N·m]."""
        self.joints.servos["limit"][joint] = torque

    def take(self, joint: int) -> None:
        """Make the state in which one joint is its set-point."""
        data = self.plant.data
        self._setpoint[:, joint] = data.qpos[joint], data.qvel[joint], 0.0

    def bias(self, joint: int) -> float:
        """Torque [N·m] that gravity (and motion) puts on a joint."""
        return float(self.plant.data.qfrc_bias[joint])

    def carry(self) -> None:
        """Let every integrator begin with what its joint has to carry where the arm stands."""
        mujoco.mj_forward(self.plant.model, self.plant.data)
        self.joints.states["integral"] = self.plant.data.qfrc_bias

    @property
    def at_limit(self) -> list[bool]:
        """(n,) whether the servo wants more torque than it may give."""
        wanted: list[bool] = (self.joints.states["overload_s"] > 0.0).tolist()
        return wanted

    def follow(self, rows: FloatArray) -> Samples:
        """Follow rows (N, 3, n) to their end, whatever happens on the way.

        One that has run away comes back as no samples, where it was when the rows began.
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
        """See `Simulation`; what the integrators give is kept for when the brakes open."""
        given = self.joints.states["integral"].copy()
        super().engage_brakes()
        self.joints.states["integral"] = given

    def _blame(self, fault: int, followed: FloatArray) -> None:
        """Find the joints; `followed` (n,) is where the arm should be [rad]."""
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
        """The simulation has gone wrong: the arm stands at `q` (n,) [rad] again."""
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
        """What the drives believe to turn: rotors without an arm, anywhere but in gravity."""
        believed = self._nominal.model
        believed.opt.gravity[:] = 0.0
        believed.body_mass[:] = 0.0
        believed.body_inertia[:] = 0.0
        super()._attach()
