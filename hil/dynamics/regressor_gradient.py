"""Regressor with its exact derivative for many samples at once, for the design of excitations.

`IdentificationColumns` defines the columns: base parameters, and optionally rotors and friction.

The torque is τⱼ = Σ_{i ≥ j} Jⱼ · (Φᵢ πᵢ). In the frame of link i, joint j moves the link with the
twist (u, z), and the block of the regressor for the pair of link i and joint j is (u, z)ᵀΦ. Each
block of the regressor is a closed form in u, z, the angular velocity ω of the link, its angular
acceleration α and the acceleration d of its origin. The derivative of a scalar function of the
regressor is propagated backwards through the closed forms of the blocks and then, by sums along the
chain, through the kinematics. The propagation takes one sweep for any function, without a tensor of
derivatives and without a loop over samples. (The derivatives of twists are taken from Singh,
Russell and Wensing 2022.)

Twists and wrenches are Plücker coordinates in base axes about the origin of the base. Twists and
wrenches are stored as arrays (2, 3, …), the linear part before the angular part. Samples are the
last axis of all arrays, so that every operation processes long rows. The notation follows
Featherstone 2008: the spatial acceleration `a` includes the acceleration −g of the base.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hil.core import FloatArray, IntArray
from hil.dynamics.base import BaseParameters, base_parameters
from hil.dynamics.build import JointGeometry
from hil.dynamics.inertial import PARAMETERS

if TYPE_CHECKING:
    from hil.dynamics.robot_model import RobotModel


class MotionGradient(NamedTuple):
    """Derivatives of a scalar by q, qd and qdd, each (N, n)."""

    q: FloatArray
    qd: FloatArray
    qdd: FloatArray


class Rows(NamedTuple):
    """Regressor at some samples of a motion, with its derivative.

    Attributes:
        transposed: (b, n·N) transpose of the regressor, with rows ordered by joint.
        pull_back: Function that converts the derivative of a scalar by `transposed` to its
            derivative by the motion.
    """

    transposed: FloatArray
    pull_back: Callable[[FloatArray], MotionGradient]


_FRICTION = ("coulomb", "viscous", "offset")


class IdentificationColumns:
    """Regressor columns of independent parameters of one robot, differentiable by the motion.

    Args:
        robot: Robot model.
        rotor: Flag; if true, the parameters include rotor inertias.
        friction: Flag; if true, the parameters include Coulomb, viscous and offset torques of every
            joint.
        sign_width: Width of tanh(qd / width) [rad/s], which replaces the sign function in Coulomb
            columns.
        base: Base parameters to use; None for those of `base_parameters`. The condition number of
            unscaled columns depends on the choice of base parameters.

    Attributes:
        names: Names of the b parameters: base parameters, then `coulomb_1` … `offset_n`.
    """

    def __init__(
        self,
        robot: RobotModel,
        *,
        rotor: bool = False,
        friction: bool = False,
        sign_width: float = 0.01,
        base: BaseParameters | None = None,
    ) -> None:
        base = base or base_parameters(robot, rotor=rotor)
        self._robot, self._geometry = robot, robot.joint_geometry()
        # If a motor moves several joints, the rows refer to the motors (`CoupledModel`).
        self._T: FloatArray = getattr(robot, "joints_per_motor", np.eye(robot.n))
        self._width, self._friction = sign_width, friction
        bodies = 10 * robot.n
        self._inertial = base.independent[base.independent < bodies]
        self._rotors = base.independent[base.independent >= bodies] - bodies
        added = [f"{kind}_{j + 1}" for kind in _FRICTION for j in range(robot.n)]
        self.names = (*base.names, *(added if friction else ()))

    def __len__(self) -> int:
        return len(self.names)

    def rows(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> Rows:
        """Return the regressor at `q`, `qd`, `qdd`, each (N, n)."""
        joints = q @ self._T.T, qd @ self._T.T, qdd @ self._T.T
        sweep = RegressorSweep.of(self._robot, *joints, self._geometry)
        parts = [np.matmul(self._T.T, sweep.columns[self._inertial])]
        parts.append(_diagonal(qdd)[self._rotors])
        if self._friction:
            sign = np.tanh(qd / self._width)
            parts += [_diagonal(x) for x in (sign, qd, np.ones_like(qd))]
        (N, n), counts = q.shape, np.cumsum([len(part) for part in parts[:-1]])

        def pull_back(by_rows: FloatArray) -> MotionGradient:
            by_parts = np.split(by_rows.reshape(-1, n, N), counts)
            by = self._pull_back_inertial(sweep, by_parts[0])
            for joint, by_column in zip(self._rotors, by_parts[1], strict=True):
                by.qdd[:, joint] += by_column[joint]
            if self._friction:
                coulomb, viscous = (part[range(n), range(n)].T for part in by_parts[2:4])
                by.qd[:] += coulomb * (1.0 - sign**2) / self._width + viscous
            return by

        return Rows(np.concatenate(parts).reshape(-1, n * N), pull_back)

    def _pull_back_inertial(self, sweep: RegressorSweep, by_part: FloatArray) -> MotionGradient:
        by_bodies = np.zeros_like(sweep.columns)
        by_bodies[self._inertial] = np.matmul(self._T, by_part)
        return MotionGradient(*(by @ self._T for by in sweep.pull_back(by_bodies)))


def _diagonal(x: FloatArray) -> FloatArray:
    """Return columns (n, n, N) in which column j acts on joint j only and has the values x[j]."""
    N, n = x.shape
    out = np.zeros((n, n, N))
    out[np.arange(n), np.arange(n)] = x.T
    return out


@dataclass(frozen=True, slots=True, eq=False)
class ChainMotion:
    """Motion of n links at N samples.

    Attributes:
        R: (3, 3, n, N) orientations of the joint frames in the base frame.
        p: (3, n, N) origins of the joint frames in the base frame [m].
        J: (2, 3, n, N) twist of each joint per unit of joint velocity.
        J_dot: (2, 3, n, N) time derivative of J.
        v, a: (2, 3, n, N) twists and spatial accelerations of the links.
    """

    R: FloatArray
    p: FloatArray
    J: FloatArray
    J_dot: FloatArray
    v: FloatArray
    a: FloatArray


@dataclass(frozen=True, eq=False)
class RegressorSweep:
    """Regressor at some samples, with the intermediate results for its derivative.

    Attributes:
        motion: Motion of the links.
        link, joint: (P,) index of link i and of joint j for every pair with j ≤ i, ordered by link.
    """

    motion: ChainMotion
    link: IntArray
    joint: IntArray

    @classmethod
    def of(
        cls,
        robot: RobotModel,
        q: FloatArray,
        qd: FloatArray,
        qdd: FloatArray,
        geometry: JointGeometry | None = None,
    ) -> RegressorSweep:
        """Return the regressor sweep of a robot at `q`, `qd`, `qdd`, each (N, n).

        Code that calls this method often passes the `geometry` of the robot, to avoid recomputing
        it.
        """
        link, joint = np.tril_indices(robot.n)
        rows = (np.ascontiguousarray(x.T) for x in (q, qd, qdd))
        motion = chain_motion(geometry or robot.joint_geometry(), robot.gravity_vector, *rows)
        return cls(motion, link, joint)

    @cached_property
    def columns(self) -> FloatArray:
        """Contribution (10·n, n, N) of each inertial parameter to all torques at all samples.

        The expression `columns.T.reshape(N * n, 10 * n)` equals `RobotModel.regressor(…,
        rotor=False)`.
        """
        m, (u, z), s = self.motion, self._twist, self._links
        n, N = m.p.shape[1:]
        out = np.zeros((n, len(PARAMETERS), n, N))
        d, alpha, omega = (x[:, self.link] for x in (s.d, s.alpha, s.omega))
        block = np.empty((len(PARAMETERS), len(self.link), N))
        block[0] = dot(u, d)
        block[1:4] = cross(u, alpha) + cross(omega, cross(omega, u)) + cross(d, z)
        block[4:] = _symmetric(z, alpha) + _symmetric(cross(z, omega), omega)
        out[self.link, :, self.joint] = block.transpose(1, 0, 2)
        return out.reshape(len(PARAMETERS) * n, n, N)

    def pull_back(self, by_columns: FloatArray) -> MotionGradient:
        """Return the derivative of a scalar by q, qd and qdd.

        Args:
            by_columns: (10·n, n, N) derivative of the scalar by `columns`.
        """
        m, (u, z), s = self.motion, self._twist, self._links
        n, N = m.p.shape[1:]
        weights = by_columns.reshape(n, len(PARAMETERS), n, N)[self.link, :, self.joint]
        mass, moment, inertia = _as_body(weights.transpose(1, 0, 2))
        d, alpha, omega = (x[:, self.link] for x in (s.d, s.alpha, s.omega))

        by_d = mass * u + cross(z, moment)
        by_alpha = cross(moment, u) + rotate(inertia, z)
        turned = rotate(inertia, omega)
        by_omega = moment * dot(omega, u) + u * dot(moment, omega)
        by_omega += rotate(inertia, cross(z, omega)) + cross(turned, z)
        by_omega -= 2.0 * omega * dot(moment, u)
        force = mass * d + cross(alpha, moment) + cross(omega, cross(omega, moment))
        torque = cross(moment, d) + rotate(inertia, alpha) + cross(omega, turned)

        starts = np.flatnonzero(self.joint == 0)
        g_d, g_alpha, g_omega = (
            np.add.reduceat(x, starts, axis=1) for x in (by_d, by_alpha, by_omega)
        )
        by_a = self._to_base(np.stack([g_d, g_alpha]), slice(None))
        by_v = np.stack([cross(g_d, s.omega), g_omega + cross(s.speed, g_d)])
        by_v = self._to_base(by_v, slice(None))
        twist = wrench_cross(np.stack([u, z]), np.stack([force, torque]))
        return self._through_chain(by_v, by_a, self._to_base(twist, self.link))

    def _through_chain(
        self, by_v: FloatArray, by_a: FloatArray, by_pairs: FloatArray
    ) -> MotionGradient:
        """Convert derivatives by link twists and accelerations to derivatives by q, qd, qdd.

        Args:
            by_v: (2, 3, n, N) derivatives by the link twists, as wrenches in the base frame.
            by_a: (2, 3, n, N) derivatives by the link accelerations, as wrenches in the base frame.
            by_pairs: (2, 3, P, N) products Jⱼ ×* w, in which w is the derivative by the twist of
                joint j in the frame of link i.
        """
        m = self.motion
        on_v = _outwards(by_v + wrench_cross(m.v, by_a))
        on_a = _outwards(by_a)
        k = np.arange(m.p.shape[1])[:, None]
        between = ((self.joint <= k) & (k <= self.link)).astype(float)
        turning = np.matmul(between, by_pairs)
        by_q = power(m.J_dot, on_v) - power(m.J, turning + wrench_cross(m.a, on_a))
        by_q -= power(m.J_dot, wrench_cross(m.v, on_a))
        by_qd = power(m.J, on_v) + 2.0 * power(m.J_dot, on_a)
        return MotionGradient(by_q.T, by_qd.T, power(m.J, on_a).T)

    @cached_property
    def _twist(self) -> tuple[FloatArray, FloatArray]:
        """Linear and angular twist of joint j in the frame of link i, each (3, P, N)."""
        m = self.motion
        R, p, J = m.R[:, :, self.link], m.p[:, self.link], m.J[:, :, self.joint]
        return rotate_back(R, J[0] + cross(J[1], p)), rotate_back(R, J[1])

    @cached_property
    def _links(self) -> _LinkMotion:
        m = self.motion
        omega, alpha = rotate_back(m.R, m.v[1]), rotate_back(m.R, m.a[1])
        speed = rotate_back(m.R, m.v[0] + cross(m.v[1], m.p))
        linear = rotate_back(m.R, m.a[0] + cross(m.a[1], m.p))
        return _LinkMotion(linear + cross(omega, speed), alpha, omega, speed)

    def _to_base(self, wrench: FloatArray, link: IntArray | slice) -> FloatArray:
        """Convert wrenches (2, 3, …, N) from the frames of `link` to the base frame."""
        R, p = self.motion.R[:, :, link], self.motion.p[:, link]
        force = rotate(R, wrench[0])
        return np.stack([force, rotate(R, wrench[1]) + cross(p, force)])


def _symmetric(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the factors (6, …) of Ixx, Ixy, Iyy, Ixz, Iyz, Izz in the product aᵀ I b."""
    return np.stack(
        [
            a[0] * b[0],
            a[0] * b[1] + a[1] * b[0],
            a[1] * b[1],
            a[0] * b[2] + a[2] * b[0],
            a[1] * b[2] + a[2] * b[1],
            a[2] * b[2],
        ]
    )


def _as_body(weights: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mass, first moment (3, …) and inertia (3, 3, …) given by ten parameters (10, …)."""
    xx, xy, yy, xz, yz, zz = weights[4:]
    inertia = np.stack([np.stack([xx, xy, xz]), np.stack([xy, yy, yz]), np.stack([xz, yz, zz])])
    return weights[0], weights[1:4], inertia


def _outwards(wrench: FloatArray) -> FloatArray:
    """Return for each link k the sum over the links from k to the last one, (2, 3, n, N)."""
    return np.flip(np.cumsum(np.flip(wrench, axis=2), axis=2), axis=2)


class _LinkMotion(NamedTuple):
    """Quantities d, α, ω and origin velocity of each link in the link's frame, each (3, n, N)."""

    d: FloatArray
    alpha: FloatArray
    omega: FloatArray
    speed: FloatArray


def chain_motion(
    geometry: JointGeometry, gravity: FloatArray, q: FloatArray, qd: FloatArray, qdd: FloatArray
) -> ChainMotion:
    """Return the forward kinematics of a chain.

    Args:
        geometry: Geometry of the joints of the chain.
        gravity: (3,) gravity vector in the base frame [m/s²].
        q: (n, N) joint positions.
        qd: (n, N) joint velocities.
        qdd: (n, N) joint accelerations.
    """
    R, p, J = _frames(geometry, q)
    v = np.cumsum(J * qd, axis=2)
    J_dot = twist_cross(v, J)
    a = np.cumsum(J * qdd + J_dot * qd, axis=2)
    a[0] -= gravity[:, None, None]
    return ChainMotion(R, p, J, J_dot, v, a)


def _frames(geometry: JointGeometry, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the quantities R, p and J of `ChainMotion`."""
    n, N = q.shape
    R, p, J = np.empty((3, 3, n, N)), np.empty((3, n, N)), np.zeros((2, 3, n, N))
    turn, origin = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, N)), np.zeros((3, N))
    for i in range(n):
        pose, axis = geometry.placement[i], geometry.axis[i]
        origin = origin + np.einsum("abk,b->ak", turn, pose[:3, 3])
        turn = np.einsum("abk,bc->ack", turn, pose[:3, :3])
        z = np.einsum("abk,b->ak", turn, axis)
        if geometry.turns[i]:
            turn = _turned(turn, axis, q[i])
            J[0, :, i], J[1, :, i] = cross(origin, z), z
        else:
            origin = origin + z * q[i]
            J[0, :, i] = z
        R[:, :, i], p[:, i] = turn, origin
    return R, p, J


def _turned(R: FloatArray, axis: FloatArray, angle: FloatArray) -> FloatArray:
    """Return the rotation R·Rot(axis, angle), (3, 3, N), by Rodrigues' formula."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    RK = np.einsum("abk,bc->ack", R, K)
    RKK = np.einsum("abk,bc->ack", R, K @ K)
    return np.asarray(R + np.sin(angle) * RK + (1.0 - np.cos(angle)) * RKK)


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross product a × b along the first axis, (3, …)."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    np.subtract(a[1] * b[2], a[2] * b[1], out=out[0])
    np.subtract(a[2] * b[0], a[0] * b[2], out=out[1])
    np.subtract(a[0] * b[1], a[1] * b[0], out=out[2])
    return out


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the scalar product a · b along the first axis, (3, …)."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def power(twist: FloatArray, wrench: FloatArray) -> FloatArray:
    """Return the power of a wrench along a twist; wrench and twist are (2, 3, …) each."""
    return dot(twist[0], wrench[0]) + dot(twist[1], wrench[1])


def twist_cross(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the cross product x × y of two twists (2, 3, …)."""
    return np.stack([cross(x[1], y[0]) + cross(x[0], y[1]), cross(x[1], y[1])])


def wrench_cross(x: FloatArray, w: FloatArray) -> FloatArray:
    """Return x ×* w for a twist x and a wrench w (2, 3, …), with y · (x ×* w) = −(x × y) · w."""
    return np.stack([cross(x[1], w[0]), cross(x[1], w[1]) + cross(x[0], w[0])])


def rotate(R: FloatArray, x: FloatArray) -> FloatArray:
    """Return the products R x of matrices (3, 3, …) and vectors (3, …)."""
    return np.asarray(R[:, 0] * x[0] + R[:, 1] * x[1] + R[:, 2] * x[2])


def rotate_back(R: FloatArray, x: FloatArray) -> FloatArray:
    """Return the products Rᵀ x of matrices (3, 3, …) and vectors (3, …)."""
    return np.asarray(R[0] * x[0] + R[1] * x[1] + R[2] * x[2])
