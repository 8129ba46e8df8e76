"""A serial arm as a model, vectorised over samples: a thin layer over Pinocchio.

It is made from a description of an arm or a URDF, stored by what it was made from, and loaded with
payloads. `CoupledModel` is an arm whose motors move more than one joint.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from hil.arms import ArmDescription, Payload, is_description, load_arm
from hil.core import DataError, FloatArray, IntArray, SpecError
from hil.dynamics.build import (
    JointGeometry,
    joint_geometry,
    model_from_arm,
    model_from_urdf,
    pose_of,
)
from hil.dynamics.chain import Chain, momentum
from hil.dynamics.inertial import PARAMETERS, payload_inertia, payload_parameters, transfer_matrix
from hil.dynamics.regressor import Regressor, compiles

GRAVITY = (0.0, 0.0, -9.81)

MOTOR_SIDE = "@motors"
"""Behind the name of an arm whose motors move more than one joint: see `CoupledModel`."""


class RobotModel:
    """The moving links of a fixed-base serial arm: torques, momentum, regressors, poses.

    Every method takes rows of samples (N, n) and stacks results sample-major: row k·n + j of a
    regressor is joint j at sample k. SI throughout; prismatic joints count in m and N.

    Inertial parameters are those of Pinocchio's joint frames: frame i has its origin on the axis
    of joint i (for DH arms: the origin of DH frame i−1) and turns with link i; the order is that
    of `hil.dynamics.PARAMETERS`. Rotor inertias, reflected to the joint, come last.

    An instance holds scratch memory: share it between processes, not between threads.

    Args:
        model: Of Pinocchio.
        flange: Its frame that carries loads.
        name: For messages.
        arm: The description it was built from.
        payloads: Mounted already.

    Attributes:
        name: Arm name or URDF path.
        n: Number of joints.
        joint_names: Length n.
        q_min, q_max: Position limits [rad], (n,); infinite for endless joints.
        qd_max: Velocity limits [rad/s], (n,).
        effort_max: Torque limits [N·m], (n,).
        arm: The description the model was built from, None for a URDF.
        payloads: The loads that `with_payload` mounted.
        gravity_vector: (3,) in the base frame [m/s²]: says how the arm is mounted.
        rotor_inertia: (n,) reflected to the joint [kg·m²].
    """

    def __init__(
        self,
        model: pin.Model,
        flange: int,
        *,
        name: str,
        arm: ArmDescription | None = None,
        payloads: tuple[Payload, ...] = (),
    ) -> None:
        self._model = model
        self._data = model.createData()
        self._flange = flange
        self._chain = Chain.of(joint_geometry(model), model.gravity.linear)
        self._regressors: dict[bytes, Regressor] = {}
        self.name = name
        self.n = int(model.nv)
        self._loaded: tuple[Payload, RobotModel] | None = None
        self.arm = arm
        self.payloads = payloads
        self.joint_names = tuple(str(joint) for joint in model.names)[1:]
        self.q_min = np.array(model.lowerPositionLimit)
        self.q_max = np.array(model.upperPositionLimit)
        self.qd_max = np.array(model.velocityLimit)
        self.effort_max = np.array(model.effortLimit)
        self.gravity_vector = np.array(model.gravity.linear)
        self.rotor_inertia = np.array(model.armature)

    @classmethod
    def from_arm(
        cls,
        name: str,
        rotor_inertia: Sequence[float] | FloatArray | None = None,
        gravity: Sequence[float] = GRAVITY,
    ) -> RobotModel:
        """A built-in arm.

        Args:
            name: Key of the arm, e.g. `ur5`.
            rotor_inertia: (n,) rotor inertia reflected to the joint [kg·m²]; none by default.
            gravity: (3,) in the base frame [m/s²]: says how the arm is mounted.

        Raises:
            SpecError: There is no such arm, or `rotor_inertia` has another length.
        """
        if name.endswith(MOTOR_SIDE):
            return CoupledModel.from_arm(name, rotor_inertia, gravity)
        arm = load_arm(name)
        model = model_from_arm(arm)
        _configure(model, rotor_inertia, gravity)
        return cls(model, int(model.getFrameId("flange")), name=name, arm=arm)

    @classmethod
    def from_urdf(
        cls,
        path: str | Path,
        rotor_inertia: Sequence[float] | FloatArray | None = None,
        gravity: Sequence[float] = GRAVITY,
        flange: str | None = None,
    ) -> RobotModel:
        """A fixed-base serial arm from a URDF file; `flange` names the link that carries loads.

        Rotor inertias are those given, else `<dynamics armature=…>` of the joints, else none.

        Raises:
            SpecError: The file cannot be used; the message says why.
        """
        model, frame = model_from_urdf(Path(path), flange)
        _configure(model, rotor_inertia, gravity)
        return cls(model, frame, name=str(path))

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> RobotModel:
        """Inverse of `to_dict`; a URDF is read again from its path.

        Raises:
            SpecError: The arm or the URDF cannot be used here.
            KeyError, TypeError, ValueError: The document is not what `to_dict` wrote.
        """
        given = (document["name"], document["rotor_inertia_kgm2"], document["gravity_m_s2"])
        is_urdf = document["kind"] == "urdf"
        robot = cls.from_urdf(*given, document["flange"]) if is_urdf else cls.from_arm(*given)
        for load in document["payloads"]:
            robot = robot.with_payload(_payload(load))
        return robot

    def to_dict(self) -> dict[str, Any]:
        """JSON form: what the model was made from, not its inertial parameters.

        Keys: `kind` (`arm` or `urdf`), `name` (of the arm, or the URDF's path), `joint_names`,
        `flange`, `gravity_m_s2`, `rotor_inertia_kgm2`, `payloads`.
        """
        return {
            "kind": "urdf" if self.arm is None else "arm",
            "name": self.name,
            "joint_names": list(self.joint_names),
            "flange": str(self._model.frames[self._flange].name),
            "gravity_m_s2": self.gravity_vector.tolist(),
            "rotor_inertia_kgm2": self.rotor_inertia.tolist(),
            "payloads": [_payload_document(load) for load in self.payloads],
        }

    def with_payload(self, payload: Payload) -> RobotModel:
        """The same arm with a load rigidly mounted at the flange."""
        if payload.is_empty:
            return self
        model, mounted = self._with_body(payload), (*self.payloads, payload)
        return RobotModel(model, self._flange, name=self.name, arm=self.arm, payloads=mounted)

    def _with_body(self, payload: Payload) -> pin.Model:
        model = self._model.copy()
        body = pin.Inertia(payload.mass, np.array(payload.com), payload_inertia(payload))
        frame = model.frames[self._flange]
        model.appendBodyToJoint(frame.parentJoint, body, frame.placement)
        return model

    def inverse_dynamics(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """(N, n) joint torques for the motion, rotor inertias included."""
        rows = self._rows(q, qd, qdd)
        if compiles(len(q)):
            return self._recursion(self.parameters(), *rows)
        out = np.empty(rows[0].shape)
        for tau, *sample in zip(out, *rows, strict=True):
            tau[:] = pin.rnea(self._model, self._data, *sample)
        return out

    def inverse_dynamics_derivatives(
        self, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Each (N, n, n): how row i of the joint torques changes with q, qd and qdd of joint j."""
        rows = self._rows(q, qd, qdd)
        out = np.empty((3, *rows[0].shape, self.n))
        for k, sample in enumerate(zip(*rows, strict=True)):
            out[:, k] = pin.computeRNEADerivatives(self._model, self._data, *sample)
        return out[0], out[1], out[2]

    def torque(
        self, parameters: FloatArray, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> FloatArray:
        """(N, n) regressor times parameters (11·n,), without the regressor.

        Any parameters will do, those `BaseParameters.expand` makes of base parameters too.
        """
        rows = self._rows(q, qd, qdd)
        if compiles(len(q)):
            return self._recursion(np.asarray(parameters), *rows)
        return (self.regressor(*rows) @ parameters).reshape(rows[0].shape)

    def _recursion(self, parameters: FloatArray, *rows: FloatArray) -> FloatArray:
        from hil.dynamics.compiled import fill_torques

        q, qd, qdd = rows
        bodies, rotors = np.split(parameters, [len(PARAMETERS) * self.n])
        out = np.empty(q.shape)
        fill_torques(self._chain, q, qd, qdd, bodies.reshape(self.n, -1), rotors, out)
        return out

    def momentum(
        self, parameters: FloatArray, q: FloatArray, qd: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Momentum M(q) q̇ [N·m·s] and Cᵀ(q, q̇) q̇ [N·m], each (N, n), of any parameters (11·n,)."""
        return momentum(self._chain, np.asarray(parameters), *self._rows(q, qd))

    def loaded_parameters(self, parameters: FloatArray, payload: Payload) -> FloatArray:
        """(11·n,) parameters with a load fixed to the flange."""
        last = slice((self.n - 1) * len(PARAMETERS), self.n * len(PARAMETERS))
        X = transfer_matrix(pose_of(self._model.frames[self._flange].placement))
        loaded = np.array(parameters, dtype=np.float64)
        loaded[last] += X @ payload_parameters(payload)
        return loaded

    def gravity(self, q: FloatArray) -> FloatArray:
        """(N, n) joint torques that hold the arm still."""
        (rows,) = self._rows(q)
        out = np.empty(rows.shape)
        for tau, sample in zip(out, rows, strict=True):
            tau[:] = pin.computeGeneralizedGravity(self._model, self._data, sample)
        return out

    def mass_matrix(self, q: FloatArray) -> FloatArray:
        """(N, n, n) joint-space inertia, rotor inertias included."""
        (rows,) = self._rows(q)
        out = np.empty((len(rows), self.n, self.n))
        for M, sample in zip(out, rows, strict=True):
            M[:] = pin.crba(self._model, self._data, sample)
        upper = np.triu(out)
        return upper + np.swapaxes(np.triu(out, 1), 1, 2)

    def regressor(
        self,
        q: FloatArray,
        qd: FloatArray,
        qdd: FloatArray,
        *,
        rotor: bool = True,
        columns: IntArray | None = None,
    ) -> FloatArray:
        """(N·n, p) W with W @ parameters = inverse dynamics; p = 10·n, plus n with `rotor`.

        Args:
            q: (N, n), with qd and qdd the motion.
            qd: (N, n).
            qdd: (N, n).
            rotor: Whether the columns of the rotor inertias, which hold qdd, are among them.
            columns: (k,) only these, ascending, such as those of base parameters; then p = k.
                The others are not computed.
        """
        count = (len(PARAMETERS) + rotor) * self.n
        wanted = np.arange(count) if columns is None else np.asarray(columns)
        key = wanted.tobytes()
        if key not in self._regressors:
            self._regressors[key] = Regressor(self._model, self._chain, wanted)
        return self._regressors[key](*self._rows(q, qd, qdd))

    def gravity_regressor(self, q: FloatArray) -> FloatArray:
        """(N·n, 10·n) W with W @ parameters(rotor=False) = gravity torques."""
        still = np.zeros(np.shape(q))
        return self.regressor(q, still, still, rotor=False)

    def parameters(self, *, rotor: bool = True) -> FloatArray:
        """(p,) parameters in the order of the regressor's columns."""
        bodies = [np.array(body.toDynamicParameters()) for body in self._model.inertias]
        rotors = [np.array(self._model.armature)] if rotor else []
        return np.concatenate([*bodies[1:], *rotors])

    def parameter_names(self, *, rotor: bool = True) -> tuple[str, ...]:
        """Names such as `m_1`, `mx_1`, …, `Izz_6`, `Ia_1` in the order of the columns."""
        joints = range(1, self.n + 1)
        bodies = tuple(f"{name}_{joint}" for joint in joints for name in PARAMETERS)
        return bodies + tuple(f"Ia_{joint}" for joint in joints if rotor)

    @property
    def columns_key(self) -> tuple[bytes, ...]:
        """What a regressor's columns depend on: joints and gravity, not what the links weigh."""
        return tuple(constants.tobytes() for constants in self._chain)

    def flange_pose(self, q: FloatArray) -> FloatArray:
        """(N, 4, 4) pose of the flange in the base frame."""
        (rows,) = self._rows(q)
        out = np.empty((len(rows), 4, 4))
        for pose, sample in zip(out, rows, strict=True):
            pin.framesForwardKinematics(self._model, self._data, sample)
            pose[:] = pose_of(self._data.oMf[self._flange])
        return out

    def joint_geometry(self) -> JointGeometry:
        """Where the joints are, for code that cannot have Pinocchio."""
        return joint_geometry(self._model)

    def payload_effort(
        self, payload: Payload, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> FloatArray:
        """(N, n) what a load adds to the joint torques: inverse dynamics with minus without it."""
        if self._loaded is None or self._loaded[0] != payload:
            # Asked again and again for one load, sample by sample.
            self._loaded = payload, self.with_payload(payload)
        loaded = self._loaded[1].inverse_dynamics(q, qd, qdd)
        return loaded - self.inverse_dynamics(q, qd, qdd)

    def payload_regressor(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """(N·n, 10) W with W @ payload_parameters(payload) = payload effort, flange frame."""
        body = len(PARAMETERS)
        W = self.regressor(q, qd, qdd, columns=np.arange((self.n - 1) * body, self.n * body))
        return W @ transfer_matrix(pose_of(self._model.frames[self._flange].placement))

    def _rows(self, *arrays: FloatArray) -> tuple[FloatArray, ...]:
        rows = tuple(np.ascontiguousarray(array, dtype=np.float64) for array in arrays)
        shapes = [array.shape for array in rows]
        if any(len(s) != 2 or s[1] != self.n or s != shapes[0] for s in shapes):
            raise DataError(
                f"the model {self.name} takes rows of {self.n} joints, all arrays alike; "
                f"it got the shapes {', '.join(map(str, shapes))}",
                hint="check that the data were recorded on this robot",
            )
        return rows


def _configure(
    model: pin.Model,
    rotor_inertia: Sequence[float] | FloatArray | None,
    gravity: Sequence[float],
) -> None:
    model.gravity.linear = np.asarray(gravity, dtype=np.float64)
    if rotor_inertia is None:
        return
    armature = np.asarray(rotor_inertia, dtype=np.float64)
    if armature.shape != (model.nv,):
        raise SpecError(
            f"{armature.size} rotor inertias were given for the {model.nv} joints of {model.name}",
            hint="give one per joint, reflected to the joint, in kg·m²",
        )
    model.armature = armature


def _payload(document: Mapping[str, Any]) -> Payload:
    return Payload(
        float(document["mass_kg"]), tuple(document["com_m"]), tuple(document["inertia_kgm2"])
    )


def _payload_document(load: Payload) -> dict[str, Any]:
    return {
        "mass_kg": load.mass,
        "com_m": list(load.com),
        "inertia_kgm2": list(load.inertia),
    }


def load_model(
    name_or_path: str | Path,
    rotor_inertia: Sequence[float] | FloatArray | None = None,
    gravity: Sequence[float] = GRAVITY,
) -> RobotModel:
    """A built-in arm by name, or a URDF or a description of an arm by path.

    Raises:
        SpecError: Neither exists, or the URDF cannot be used.
    """
    text = str(name_or_path)
    if is_description(text.removesuffix(MOTOR_SIDE)):
        return RobotModel.from_arm(text, rotor_inertia, gravity)
    if Path(text).suffix or "/" in text or Path(text).is_file():
        return RobotModel.from_urdf(text, rotor_inertia, gravity)
    return RobotModel.from_arm(text, rotor_inertia, gravity)


class CoupledModel(RobotModel):
    """A `RobotModel` whose q, velocities and torques are those of the motors behind their gears.

    In some wrists a motor's gear also turns with the joint before it: joints q follow the motors'
    angles behind their gears s by q = T s, and by virtual work the motors' torques behind their
    gears are Tᵀ times the joints'. In these coordinates every motor has one row: its own rotor
    inertia, its own friction, its own current. In joint coordinates a motor's friction and rotor
    act on two rows and depend on two velocities, which no per-joint friction column can say
    (Gautier, Janot & Vandanjon 2013 add extra columns for the TX40's joint 5 and 6; this is the
    same model).

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

    @property
    def columns_key(self) -> tuple[bytes, ...]:
        """What a regressor's columns depend on; see `RobotModel.columns_key`."""
        return (*super().columns_key, b"motors", self._T.tobytes())

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
