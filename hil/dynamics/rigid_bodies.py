"""Rigid-body dynamics of a serial arm, vectorised over samples: a thin layer over Pinocchio.

Every method takes rows of samples (N, n) and stacks results sample-major: row k·n + j of a
regressor is joint j at sample k. SI throughout; prismatic joints count in m and N.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from hil.arms import Payload
from hil.core import DataError, FloatArray, IntArray
from hil.dynamics.build import JointGeometry, joint_geometry, pose_of
from hil.dynamics.chain import Chain
from hil.dynamics.inertial import PARAMETERS, payload_parameters, transfer_matrix
from hil.dynamics.momentum import momentum
from hil.dynamics.regressor import Regressor, compiles


class RigidBodies:
    """The moving links of a fixed-base serial arm: torques, momentum, regressors, poses.

    Inertial parameters are those of Pinocchio's joint frames: frame i has its origin on the axis
    of joint i (for DH arms: the origin of DH frame i−1) and turns with link i; the order is that
    of `hil.dynamics.inertial.PARAMETERS`. Rotor inertias, reflected to the joint, come last.
    An instance holds scratch memory: share it between processes, not between threads.

    Args:
        model: Of Pinocchio.
        flange: Its frame that carries loads.
        name: For messages.
    """

    def __init__(self, model: pin.Model, flange: int, *, name: str) -> None:
        self._model = model
        self._data = model.createData()
        self._flange = flange
        self._chain = Chain.of(joint_geometry(model), model.gravity.linear)
        self._regressors: dict[bytes, Regressor] = {}
        self.name = name
        self.n = int(model.nv)

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
        from hil.dynamics.compiled_torques import fill_torques

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
