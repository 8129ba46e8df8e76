"""The regressor an excitation is designed for, with its exact derivative, for many samples at once.

`IdentificationColumns` are the columns: base parameters, rotors and friction by choice.

τⱼ = Σ_{i ≥ j} Jⱼ · (Φᵢ πᵢ): seen from link i, joint j moves it with the twist (u, z), and the block
of the regressor that belongs to both is (u, z)ᵀΦ, a closed form in u, z, the link's angular
velocity ω, its angular acceleration α and the acceleration d of its origin. The derivative of a
scalar function of the regressor is pulled back through these forms and then, by sums along the
chain, through the kinematics: one sweep, whatever the function, no tensor of derivatives and no
loop over samples. (The derivatives of twists are those of Singh, Russell and Wensing 2022.)

Twists and wrenches are Plücker coordinates in base axes about the base's origin, as arrays
(2, 3, …): linear before angular. Samples come last, so that every operation runs over long rows.
Notation of Featherstone 2008: `a` includes the acceleration −g of the base.
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
    """Derivatives of a scalar by the motion, each (N, n)."""

    q: FloatArray
    qd: FloatArray
    qdd: FloatArray


class Rows(NamedTuple):
    """A regressor at some samples.

    Attributes:
        transposed: (b, n·N) the regressor's transpose, rows joint by joint.
        pull_back: From the derivative of a scalar by `transposed` to that by the motion.
    """

    transposed: FloatArray
    pull_back: Callable[[FloatArray], MotionGradient]


_FRICTION = ("coulomb", "viscous", "offset")


class IdentificationColumns:
    """Columns of independent parameters of one robot, differentiable by the motion.

    Args:
        robot: The robot.
        rotor: Whether rotor inertias are among the parameters.
        friction: Whether Coulomb, viscous and offset torques of every joint are.
        sign_width: Of tanh(qd / width), which stands for the sign in Coulomb columns [rad/s].
        base: The base parameters, where it is to be others than `base_parameters` chooses: the
            condition number of unscaled columns depends on the choice.

    Attributes:
        names: (b,) of the parameters: base parameters, then `coulomb_1` … `offset_n`.
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
        # Where one motor moves several joints, the rows are the motors' (`CoupledModel`).
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
        """The regressor at `q`, `qd`, `qdd`, each (N, n)."""
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
    """(n, n, N): column j acts on joint j only, by x (N, n)."""
    N, n = x.shape
    out = np.zeros((n, n, N))
    out[np.arange(n), np.arange(n)] = x.T
    return out


@dataclass(frozen=True, slots=True, eq=False)
class ChainMotion:
    """The motion of n links at N samples.

    Attributes:
        R: (3, 3, n, N) orientation of the joints' frames in the base.
        p: (3, n, N) their origins.
        J: (2, 3, n, N) twist per unit of joint speed.
        J_dot: (2, 3, n, N) its derivative by time.
        v, a: (2, 3, n, N) twists of the links and their spatial accelerations.
    """

    R: FloatArray
    p: FloatArray
    J: FloatArray
    J_dot: FloatArray
    v: FloatArray
    a: FloatArray


@dataclass(frozen=True, eq=False)
class RegressorSweep:
    """The regressor of some samples, with what is needed to differentiate it.

    Attributes:
        motion: Of the links.
        link, joint: (P,) link i and joint j of every pair j ≤ i, ordered by link.
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
        """The sweep of a robot at `q`, `qd`, `qdd`, each (N, n).

        `geometry` is the robot's own, for those who ask again and again.
        """
        link, joint = np.tril_indices(robot.n)
        rows = (np.ascontiguousarray(x.T) for x in (q, qd, qdd))
        motion = chain_motion(geometry or robot.joint_geometry(), robot.gravity_vector, *rows)
        return cls(motion, link, joint)

    @cached_property
    def columns(self) -> FloatArray:
        """(10·n, n, N): for each inertial parameter its part of all torques at all samples.

        `columns.T.reshape(N * n, 10 * n)` is `RobotModel.regressor(…, rotor=False)`.
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
        """The derivative of a scalar by the motion.

        Args:
            by_columns: (10·n, n, N) its derivative by `columns`.
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
        """From derivatives by the links' twists and accelerations to those by q, qd, qdd.

        Args:
            by_v: (2, 3, n, N) by the twists, wrenches in the base frame.
            by_a: (2, 3, n, N) by the accelerations.
            by_pairs: (2, 3, P, N), Jⱼ ×* of the derivative by the twist of joint j seen from i.
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
        """Linear and angular part of joint j's twist seen from link i, each (3, P, N)."""
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
        """Wrenches (2, 3, …, N) given in the frames of `link`."""
        R, p = self.motion.R[:, :, link], self.motion.p[:, link]
        force = rotate(R, wrench[0])
        return np.stack([force, rotate(R, wrench[1]) + cross(p, force)])


def _symmetric(a: FloatArray, b: FloatArray) -> FloatArray:
    """(6, …) factors of Ixx, Ixy, Iyy, Ixz, Iyz, Izz in aᵀ I b."""
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
    """Mass, first moment (3, …) and inertia (3, 3, …) out of ten parameters (10, …)."""
    xx, xy, yy, xz, yz, zz = weights[4:]
    inertia = np.stack([np.stack([xx, xy, xz]), np.stack([xy, yy, yz]), np.stack([xz, yz, zz])])
    return weights[0], weights[1:4], inertia


def _outwards(wrench: FloatArray) -> FloatArray:
    """Sums over all links from k to the last, (2, 3, n, N)."""
    return np.flip(np.cumsum(np.flip(wrench, axis=2), axis=2), axis=2)


class _LinkMotion(NamedTuple):
    """In each link's own frame, (3, n, N): d, α, ω, and the velocity of the origin."""

    d: FloatArray
    alpha: FloatArray
    omega: FloatArray
    speed: FloatArray


def chain_motion(
    geometry: JointGeometry, gravity: FloatArray, q: FloatArray, qd: FloatArray, qdd: FloatArray
) -> ChainMotion:
    """Forward kinematics of a chain.

    Args:
        geometry: Of its joints.
        gravity: (3,) in the base frame [m/s²].
        q: (n, N) joint positions; `qd` and `qdd` are like it.
        qd: Velocities.
        qdd: Accelerations.
    """
    R, p, J = _frames(geometry, q)
    v = np.cumsum(J * qd, axis=2)
    J_dot = twist_cross(v, J)
    a = np.cumsum(J * qdd + J_dot * qd, axis=2)
    a[0] -= gravity[:, None, None]
    return ChainMotion(R, p, J, J_dot, v, a)


def _frames(geometry: JointGeometry, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """R, p and J of `ChainMotion`."""
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
    """R·Rot(axis, angle) by Rodrigues' formula, (3, 3, N)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    RK = np.einsum("abk,bc->ack", R, K)
    RKK = np.einsum("abk,bc->ack", R, K @ K)
    return np.asarray(R + np.sin(angle) * RK + (1.0 - np.cos(angle)) * RKK)


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """A × b along the first axis, (3, …)."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    np.subtract(a[1] * b[2], a[2] * b[1], out=out[0])
    np.subtract(a[2] * b[0], a[0] * b[2], out=out[1])
    np.subtract(a[0] * b[1], a[1] * b[0], out=out[2])
    return out


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """A · b along the first axis, (3, …)."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def power(twist: FloatArray, wrench: FloatArray) -> FloatArray:
    """What a wrench does along a twist, (2, 3, …) each."""
    return dot(twist[0], wrench[0]) + dot(twist[1], wrench[1])


def twist_cross(x: FloatArray, y: FloatArray) -> FloatArray:
    """X × y of two twists (2, 3, …)."""
    return np.stack([cross(x[1], y[0]) + cross(x[0], y[1]), cross(x[1], y[1])])


def wrench_cross(x: FloatArray, w: FloatArray) -> FloatArray:
    """X ×* w of a twist and a wrench (2, 3, …): y · (x ×* w) = −(x × y) · w."""
    return np.stack([cross(x[1], w[0]), cross(x[1], w[1]) + cross(x[0], w[0])])


def rotate(R: FloatArray, x: FloatArray) -> FloatArray:
    """R x for matrices (3, 3, …) and vectors (3, …)."""
    return np.asarray(R[:, 0] * x[0] + R[:, 1] * x[1] + R[:, 2] * x[2])


def rotate_back(R: FloatArray, x: FloatArray) -> FloatArray:
    """Rᵀ x for matrices (3, 3, …) and vectors (3, …)."""
    return np.asarray(R[0] * x[0] + R[1] * x[1] + R[2] * x[2])
