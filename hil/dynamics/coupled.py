"""An arm in the coordinates of its motors, where one motor moves more than one joint.

In some wrists a motor's gear also turns with the joint before it: joints q follow the motors'
angles behind their gears s by q = T s, and by virtual work the motors' torques behind their gears
are Tᵀ times the joints'. In these coordinates every motor has one row: its own rotor inertia, its
own friction, its own current. In joint coordinates a motor's friction and rotor act on two rows
and depend on two velocities, which no per-joint friction column can say (Gautier, Janot & Vandanjon
2013 add extra columns for the TX40's joint 5 and 6; this is the same model).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray, IntArray, SpecError
from hil.dynamics.inertial import PARAMETERS
from hil.dynamics.robot_model import GRAVITY, MOTOR_SIDE, RobotModel


class CoupledModel(RobotModel):
    """A `RobotModel` whose q, velocities and torques are those of the motors behind their gears.

    The inertial parameters are those of the same links; rotor inertias and limits are the motors'.
    Position limits are the smallest box that holds all of the joints', so not every position in it
    can be reached. `joint_geometry` stays that of the joints.

    Attributes:
        joints_per_motor: (n, n) T of q = T s.
    """

    def __init__(
        self,
        model: pin.Model,
        flange: int,
        *,
        name: str,
        arm: ArmDescription | None = None,
        payloads: tuple[Payload, ...] = (),
        rotor_inertia: FloatArray | None = None,
    ) -> None:
        super().__init__(model, flange, name=name, arm=arm, payloads=payloads)
        if arm is None or np.array_equal(arm.joints_per_motor, np.eye(self.n)):
            raise SpecError(
                f"{name}: every motor of this arm moves one joint only",
                hint=f"leave {MOTOR_SIDE} out of its name",
            )
        if rotor_inertia is not None:
            self.rotor_inertia = rotor_inertia
        bare = model.copy()
        bare.armature = np.zeros(self.n)  # counted here, in the motors' coordinates
        self._serial = RobotModel(bare, flange, name=name, arm=arm)
        self._T = T = np.array(arm.joints_per_motor)
        back: FloatArray = np.asarray(np.linalg.inv(T), np.float64)
        self.q_min, self.q_max = _box(back, self.q_min, self.q_max)
        self.qd_max = np.abs(back) @ self.qd_max
        self.effort_max = np.abs(T).T @ self.effort_max

    @classmethod
    def from_arm(
        cls,
        name: str,
        rotor_inertia: Sequence[float] | FloatArray | None = None,
        gravity: Sequence[float] = GRAVITY,
    ) -> RobotModel:
        """A built-in arm, `rotor_inertia` (n,) that of the motors behind their gears [kg·m²].

        Raises:
            SpecError: There is no such arm, or none of its motors moves two joints.
        """
        made = super().from_arm(name.removesuffix(MOTOR_SIDE), rotor_inertia, gravity)
        made.name = name
        return made

    @property
    def joints_per_motor(self) -> FloatArray:
        """(n, n) T of q = T s."""
        return self._T

    def joints(self, *motors: FloatArray) -> tuple[FloatArray, ...]:
        """Angles (N, n) of the joints, or their rates, from those of the motors."""
        return tuple(rows @ self._T.T for rows in self._rows(*motors))

    def inverse_dynamics(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """(N, n) torques of the motors behind their gears, rotor inertias included."""
        return self.torque(self.parameters(), q, qd, qdd)

    def torque(
        self, parameters: FloatArray, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> FloatArray:
        """(N, n) regressor times parameters (11·n,), without the regressor."""
        bodies, rotors = np.split(np.asarray(parameters), [len(PARAMETERS) * self.n])
        links = np.concatenate([bodies, np.zeros(self.n)])
        joints = self._serial.torque(links, *self.joints(q, qd, qdd))
        out: FloatArray = joints @ self._T + rotors * np.asarray(qdd)
        return out

    def inverse_dynamics_derivatives(
        self, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Each (N, n, n), in the motors' coordinates."""
        found = self._serial.inverse_dynamics_derivatives(*self.joints(q, qd, qdd))
        by_q, by_qd, by_qdd = (np.asarray(self._T.T @ one @ self._T) for one in found)
        return by_q, by_qd, by_qdd + np.diag(self.rotor_inertia)

    def momentum(
        self, parameters: FloatArray, q: FloatArray, qd: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """As `RobotModel.momentum`, in the motors' coordinates."""
        bodies, rotors = np.split(np.asarray(parameters), [len(PARAMETERS) * self.n])
        links = np.concatenate([bodies, np.zeros(self.n)])
        p, gradient = self._serial.momentum(links, *self.joints(q, qd))
        return p @ self._T + rotors * np.asarray(qd), gradient @ self._T

    def gravity(self, q: FloatArray) -> FloatArray:
        """(N, n) motor torques behind the gears that hold the arm still."""
        torque: FloatArray = self._serial.gravity(*self.joints(q)) @ self._T
        return torque

    def mass_matrix(self, q: FloatArray) -> FloatArray:
        """(N, n, n) inertia in the motors' coordinates."""
        M: FloatArray = self._T.T @ self._serial.mass_matrix(*self.joints(q)) @ self._T
        return np.asarray(M + np.diag(self.rotor_inertia))

    def regressor(
        self,
        q: FloatArray,
        qd: FloatArray,
        qdd: FloatArray,
        *,
        rotor: bool = True,
        columns: IntArray | None = None,
    ) -> FloatArray:
        """(N·n, p) as `RobotModel.regressor`, in the motors' coordinates."""
        body = len(PARAMETERS) * self.n
        wanted = np.arange(body + rotor * self.n) if columns is None else np.asarray(columns)
        moves = self.joints(q, qd, qdd)
        W = self._serial.regressor(*moves, columns=wanted).reshape(len(moves[0]), self.n, -1)
        out = self._T.T @ W
        for place in np.flatnonzero(wanted >= body):
            out[:, :, place] = 0.0
            out[:, wanted[place] - body, place] = np.asarray(qdd)[:, wanted[place] - body]
        return np.ascontiguousarray(out.reshape(-1, len(wanted)))

    def parameters(self, *, rotor: bool = True) -> FloatArray:
        """(p,) parameters in the order of the regressor's columns."""
        bodies = self._serial.parameters(rotor=False)
        return np.concatenate([bodies, self.rotor_inertia]) if rotor else bodies

    def with_payload(self, payload: Payload) -> RobotModel:
        """The same arm with a load rigidly mounted at the flange."""
        if payload.is_empty:
            return self
        loaded = self._with_body(payload)
        mounted = (*self.payloads, payload)
        rotors = self.rotor_inertia
        return CoupledModel(
            loaded, self._flange, name=self.name, arm=self.arm, payloads=mounted,
            rotor_inertia=rotors,
        )  # fmt: skip

    def flange_pose(self, q: FloatArray) -> FloatArray:
        """(N, 4, 4) pose of the flange in the base frame."""
        return self._serial.flange_pose(*self.joints(q))


def _box(matrix: FloatArray, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest value of every row of matrix·x over low ≤ x ≤ high."""
    ends = np.stack([matrix * low, matrix * high])
    return ends.min(axis=0).sum(axis=1), ends.max(axis=0).sum(axis=1)
