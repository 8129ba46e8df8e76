"""The arm with the joint servos of plain drives: each knows its own rotor, and nothing of the arm.

A robot's own controller feeds forward what a model of the whole arm needs; a drive on a bus has
position and velocity, an integrator, and what its master adds by the torque offset (60B2h).
"""

from __future__ import annotations

from hil_mock_robot.records import Joints
from hil_mock_robot.simulation import Simulation

INTEGRAL_S = 0.1
REST_INTEGRAL_S = 0.1
"""Reset times of the integrators: a drive's loop is quicker than the servo of a whole arm."""


class PlainServoArm(Simulation):
    """A `Simulation` whose joints go their own ways: brakes, torque, jumps of one of them."""

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

    def engage_brakes(self) -> None:
        """See `Simulation`; what the integrators give is kept for when the brakes open."""
        given = self.joints.states["integral"].copy()
        super().engage_brakes()
        self.joints.states["integral"] = given

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
