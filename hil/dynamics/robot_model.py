"""Model of a serial arm, based on Pinocchio, that computes many samples at once.

A robot model is created from an arm description or a URDF, and can carry payloads. The stored form
of a robot model contains its source, gravity, rotor inertias and payloads, but no link parameters.
`CoupledModel` is an arm with motors that move more than one joint.
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
"""Suffix of the name of an arm whose motors move more than one joint, see `CoupledModel`."""


class RobotModel:
    """Moving links of a fixed-base serial arm: torques, momentum, regressors and poses.

    Every method takes samples as rows (N, n) and returns values ordered by sample: row k·n + j of a
    regressor belongs to joint j at sample k. All units of a robot model are SI units; prismatic
    joints use m and N.

    The inertial parameters refer to the joint frames of Pinocchio. The origin of frame i is on the
    axis of joint i (for DH arms: the origin of DH frame i−1), and the frame rotates with link i.
    The order of the parameters of a link is that of `hil.dynamics.PARAMETERS`. Rotor inertias,
    reflected to the joint, come after the parameters of all links.

    An instance contains scratch memory, so it can be shared between processes, but not between
    threads.

    Args:
        model: Pinocchio model.
        flange: Number of the Pinocchio frame that carries loads.
        name: Arm name or URDF path.
        arm: Arm description from which the model was built; None for a URDF.
        payloads: Payloads that are already included in `model`.

    Attributes:
        name: Arm name or URDF path.
        n: Number of joints.
        joint_names: Names of the n joints.
        q_min, q_max: (n,) position limits [rad]; infinite for continuous joints.
        qd_max: (n,) velocity limits [rad/s].
        effort_max: (n,) torque limits [N·m].
        arm: Arm description from which the model was built; None for a URDF.
        payloads: Payloads that were mounted with `with_payload`.
        gravity_vector: (3,) gravity vector in the base frame [m/s²], which depends on how the arm
            is mounted.
        rotor_inertia: (n,) rotor inertias, reflected to the joint [kg·m²].
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
        """Return the model of a built-in arm or of an arm description.

        Args:
            name: Name of the arm, for example `ur5`.
            rotor_inertia: (n,) rotor inertias reflected to the joints [kg·m²]; None for zero.
            gravity: (3,) gravity vector in the base frame [m/s²], which depends on how the arm is
                mounted.

        Raises:
            SpecError: The arm does not exist, or `rotor_inertia` has a wrong length.
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
        """Return the model of a fixed-base serial arm from a URDF file.

        The rotor inertias are the argument `rotor_inertia` if it is passed, otherwise the
        attributes `<dynamics armature=…>` of the joints, otherwise zero. The argument `flange` is
        the name of the link that carries loads.

        Raises:
            SpecError: The URDF file cannot be used; the message contains the reason.
        """
        model, frame = model_from_urdf(Path(path), flange)
        _configure(model, rotor_inertia, gravity)
        return cls(model, frame, name=str(path))

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> RobotModel:
        """Return the model from the result of `to_dict`; a URDF is read again from its path.

        Raises:
            SpecError: The arm or the URDF cannot be used on this machine.
            KeyError, TypeError, ValueError: The document does not have the keys and types of the
                result of `to_dict`.
        """
        given = (document["name"], document["rotor_inertia_kgm2"], document["gravity_m_s2"])
        is_urdf = document["kind"] == "urdf"
        robot = cls.from_urdf(*given, document["flange"]) if is_urdf else cls.from_arm(*given)
        for load in document["payloads"]:
            robot = robot.with_payload(_payload(load))
        return robot

    def to_dict(self) -> dict[str, Any]:
        """Return the source of the model as a JSON object, without inertial parameters.

        The keys of the JSON object are `kind` (`arm` or `urdf`), `name` (arm name or URDF path),
        `joint_names`, `flange`, `gravity_m_s2`, `rotor_inertia_kgm2`, `payloads`.
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
        """Return the same arm with a payload rigidly mounted at the flange."""
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
        """Return the joint torques (N, n) of a motion, including the torques of rotor inertias."""
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
        """Return the derivatives of the joint torques by q, qd and qdd, each (N, n, n).

        Entry (i, j) of the derivative at each sample is the derivative of torque i by the
        coordinate of joint j.
        """
        rows = self._rows(q, qd, qdd)
        out = np.empty((3, *rows[0].shape, self.n))
        for k, sample in enumerate(zip(*rows, strict=True)):
            out[:, k] = pin.computeRNEADerivatives(self._model, self._data, *sample)
        return out[0], out[1], out[2]

    def torque(
        self, parameters: FloatArray, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> FloatArray:
        """Return the product of regressor and parameters (N, n), without computing the regressor.

        The parameters (11·n,) may have any values, for example those from `BaseParameters.expand`.
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
        """Return momentum M(q) q̇ [N·m·s] and Cᵀ(q, q̇) q̇ [N·m], each (N, n).

        The parameters (11·n,) may have any values.
        """
        return momentum(self._chain, np.asarray(parameters), *self._rows(q, qd))

    def loaded_parameters(self, parameters: FloatArray, payload: Payload) -> FloatArray:
        """Return the parameters (11·n,) of the arm with a payload mounted at the flange."""
        last = slice((self.n - 1) * len(PARAMETERS), self.n * len(PARAMETERS))
        X = transfer_matrix(pose_of(self._model.frames[self._flange].placement))
        loaded = np.array(parameters, dtype=np.float64)
        loaded[last] += X @ payload_parameters(payload)
        return loaded

    def gravity(self, q: FloatArray) -> FloatArray:
        """Return the joint torques (N, n) that hold the static arm against gravity."""
        (rows,) = self._rows(q)
        out = np.empty(rows.shape)
        for tau, sample in zip(out, rows, strict=True):
            tau[:] = pin.computeGeneralizedGravity(self._model, self._data, sample)
        return out

    def mass_matrix(self, q: FloatArray) -> FloatArray:
        """Return the joint-space inertia matrices (N, n, n), including rotor inertias."""
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
        """Return the regressor W (N·n, p) with W @ parameters = torques of inverse dynamics.

        Args:
            q: (N, n) position.
            qd: (N, n) velocity.
            qdd: (N, n) acceleration.
            rotor: Flag; if true, the columns of the rotor inertias, which contain qdd, are
                included. With the columns of the rotor inertias, p is 11·n, otherwise 10·n.
            columns: (k,) ascending indices of the columns to compute, such as those of base
                parameters; p is then k.
        """
        count = (len(PARAMETERS) + rotor) * self.n
        wanted = np.arange(count) if columns is None else np.asarray(columns)
        key = wanted.tobytes()
        if key not in self._regressors:
            self._regressors[key] = Regressor(self._model, self._chain, wanted)
        return self._regressors[key](*self._rows(q, qd, qdd))

    def gravity_regressor(self, q: FloatArray) -> FloatArray:
        """Return the regressor W (N·n, 10·n) with W @ parameters(rotor=False) = gravity torques."""
        still = np.zeros(np.shape(q))
        return self.regressor(q, still, still, rotor=False)

    def parameters(self, *, rotor: bool = True) -> FloatArray:
        """Return the parameters (p,) of the model in the order of the regressor columns."""
        bodies = [np.array(body.toDynamicParameters()) for body in self._model.inertias]
        rotors = [np.array(self._model.armature)] if rotor else []
        return np.concatenate([*bodies[1:], *rotors])

    def parameter_names(self, *, rotor: bool = True) -> tuple[str, ...]:
        """Return the names `m_1`, `mx_1`, …, `Izz_6`, `Ia_1` in the order of the columns."""
        joints = range(1, self.n + 1)
        bodies = tuple(f"{name}_{joint}" for joint in joints for name in PARAMETERS)
        return bodies + tuple(f"Ia_{joint}" for joint in joints if rotor)

    @property
    def columns_key(self) -> tuple[bytes, ...]:
        """Key of the regressor columns: joints and gravity, without the masses of the links."""
        return tuple(constants.tobytes() for constants in self._chain)

    def flange_pose(self, q: FloatArray) -> FloatArray:
        """Return the pose (N, 4, 4) of the flange in the base frame."""
        (rows,) = self._rows(q)
        out = np.empty((len(rows), 4, 4))
        for pose, sample in zip(out, rows, strict=True):
            pin.framesForwardKinematics(self._model, self._data, sample)
            pose[:] = pose_of(self._data.oMf[self._flange])
        return out

    def joint_geometry(self) -> JointGeometry:
        """Return the joint geometry, for code that does not use Pinocchio."""
        return joint_geometry(self._model)

    def payload_effort(
        self, payload: Payload, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> FloatArray:
        """Return the joint torques (N, n) that a payload adds to those of the arm."""
        if self._loaded is None or self._loaded[0] != payload:
            # Cached, because callers use the same payload for many samples.
            self._loaded = payload, self.with_payload(payload)
        loaded = self._loaded[1].inverse_dynamics(q, qd, qdd)
        return loaded - self.inverse_dynamics(q, qd, qdd)

    def payload_regressor(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return the regressor W (N·n, 10) with W @ payload_parameters(payload) = payload torques.

        The payload parameters refer to the flange frame.
        """
        body = len(PARAMETERS)
        W = self.regressor(q, qd, qdd, columns=np.arange((self.n - 1) * body, self.n * body))
        return W @ transfer_matrix(pose_of(self._model.frames[self._flange].placement))

    def _rows(self, *arrays: FloatArray) -> tuple[FloatArray, ...]:
        rows = tuple(np.ascontiguousarray(array, dtype=np.float64) for array in arrays)
        shapes = [array.shape for array in rows]
        if any(len(s) != 2 or s[1] != self.n or s != shapes[0] for s in shapes):
            raise DataError(
                f"the model {self.name} expects arrays of one shape with {self.n} joints per "
                f"row, got the shapes {', '.join(map(str, shapes))}",
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
            f"{armature.size} rotor inertias were passed for the {model.nv} joints of {model.name}",
            hint="pass one value per joint, reflected to the joint, in kg·m²",
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
    """Return the model of a built-in arm by its name, or of a URDF or arm description by its path.

    Raises:
        SpecError: The arm or file does not exist, or the URDF cannot be used.
    """
    text = str(name_or_path)
    if is_description(text.removesuffix(MOTOR_SIDE)):
        return RobotModel.from_arm(text, rotor_inertia, gravity)
    if Path(text).suffix or "/" in text or Path(text).is_file():
        return RobotModel.from_urdf(text, rotor_inertia, gravity)
    return RobotModel.from_arm(text, rotor_inertia, gravity)


class CoupledModel(RobotModel):
    """`RobotModel` in motor coordinates, for arms with motors that move more than one joint.

    In some wrists the gear of a motor rotates together with the previous joint, too. The joint
    positions q follow from the motor angles s, measured after the gears: q = T s. According to
    virtual work, the motor torques after the gears are Tᵀ times the joint torques. In motor
    coordinates, every motor has one row of the equations of motion, which contains its rotor
    inertia, its friction and its current. In joint coordinates, the friction and the rotor of a
    motor act on two rows and depend on two velocities. Friction columns per joint cannot represent
    this dependence (Gautier, Janot & Vandanjon 2013 add extra columns for joints 5 and 6 of the
    TX40; `CoupledModel` is equivalent).

    The inertial parameters of a `CoupledModel` are those of the same links, whereas rotor inertias
    and limits refer to the motors. The position limits of the motors are the smallest box that
    contains all permitted joint positions, so some positions in the box cannot be reached. The
    value of `joint_geometry` refers to the joints and not to the motors.

    Attributes:
        joints_per_motor: (n, n) matrix T in q = T s, which converts motor angles to joint
            positions.
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
                f"{name}: every motor of this arm moves only one joint",
                hint=f"remove {MOTOR_SIDE} from the name",
            )
        if rotor_inertia is not None:
            self.rotor_inertia = rotor_inertia
        bare = model.copy()
        bare.armature = np.zeros(self.n)  # rotor inertias are added in motor coordinates
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
        """Return the model of a built-in arm in motor coordinates.

        Args:
            name: Name of the arm, with the suffix `@motors`.
            rotor_inertia: (n,) inertias of the motors, reflected to the output sides of their gears
                [kg·m²].
            gravity: (3,) gravity vector in the base frame [m/s²].

        Raises:
            SpecError: The arm does not exist, or no motor of the arm moves two joints.
        """
        made = super().from_arm(name.removesuffix(MOTOR_SIDE), rotor_inertia, gravity)
        made.name = name
        return made

    @property
    def joints_per_motor(self) -> FloatArray:
        """Matrix T (n, n) of q = T s."""
        return self._T

    @property
    def columns_key(self) -> tuple[bytes, ...]:
        """Key of the regressor columns, see `RobotModel.columns_key`."""
        return (*super().columns_key, b"motors", self._T.tobytes())

    def joints(self, *motors: FloatArray) -> tuple[FloatArray, ...]:
        """Return joint positions (N, n), or their derivatives, from those of the motors."""
        return tuple(rows @ self._T.T for rows in self._rows(*motors))

    def inverse_dynamics(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return the motor torques (N, n) after the gears, including rotor inertias."""
        return self.torque(self.parameters(), q, qd, qdd)

    def torque(
        self, parameters: FloatArray, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> FloatArray:
        """Return regressor times parameters (N, n), without computing the regressor."""
        bodies, rotors = np.split(np.asarray(parameters), [len(PARAMETERS) * self.n])
        links = np.concatenate([bodies, np.zeros(self.n)])
        joints = self._serial.torque(links, *self.joints(q, qd, qdd))
        out: FloatArray = joints @ self._T + rotors * np.asarray(qdd)
        return out

    def inverse_dynamics_derivatives(
        self, q: FloatArray, qd: FloatArray, qdd: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the derivatives of the motor torques in motor coordinates, each (N, n, n)."""
        found = self._serial.inverse_dynamics_derivatives(*self.joints(q, qd, qdd))
        by_q, by_qd, by_qdd = (np.asarray(self._T.T @ one @ self._T) for one in found)
        return by_q, by_qd, by_qdd + np.diag(self.rotor_inertia)

    def momentum(
        self, parameters: FloatArray, q: FloatArray, qd: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the results of `RobotModel.momentum` in motor coordinates."""
        bodies, rotors = np.split(np.asarray(parameters), [len(PARAMETERS) * self.n])
        links = np.concatenate([bodies, np.zeros(self.n)])
        p, gradient = self._serial.momentum(links, *self.joints(q, qd))
        return p @ self._T + rotors * np.asarray(qd), gradient @ self._T

    def gravity(self, q: FloatArray) -> FloatArray:
        """Return the motor torques (N, n) after the gears that hold the arm against gravity."""
        torque: FloatArray = self._serial.gravity(*self.joints(q)) @ self._T
        return torque

    def mass_matrix(self, q: FloatArray) -> FloatArray:
        """Return the inertia matrices (N, n, n) in motor coordinates."""
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
        """Return the regressor (N·n, p) of `RobotModel.regressor` in motor coordinates."""
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
        """Return the parameters (p,) of the model in the order of the regressor columns."""
        bodies = self._serial.parameters(rotor=False)
        return np.concatenate([bodies, self.rotor_inertia]) if rotor else bodies

    def with_payload(self, payload: Payload) -> RobotModel:
        """Return the same arm with a payload rigidly mounted at the flange."""
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
        """Return the pose (N, 4, 4) of the flange in the base frame."""
        return self._serial.flange_pose(*self.joints(q))


def _box(matrix: FloatArray, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and highest value of every row of matrix·x for low ≤ x ≤ high."""
    ends = np.stack([matrix * low, matrix * high])
    return ends.min(axis=0).sum(axis=1), ends.max(axis=0).sum(axis=1)
