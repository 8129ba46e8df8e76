"""Joint-torque regressors with their exact derivative, for many samples at once.

τⱼ = Σ_{i ≥ j} Jⱼ · (Φᵢ πᵢ): seen from link i, joint j moves it with the twist (u, z), and the block
of the regressor that belongs to both is (u, z)ᵀΦ, a closed form in u, z, the link's angular
velocity ω, its angular acceleration α and the acceleration d of its origin. The derivative of a
scalar function of the regressor is pulled back through these forms and then, by sums along the
chain, through the kinematics: one sweep, whatever the function, no tensor of derivatives and no
loop over samples. (The derivatives of twists are those of Singh, Russell and Wensing 2022.)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hil.core import FloatArray, IntArray
from hil.dynamics.chain_motion import (
    ChainMotion,
    chain_motion,
    cross,
    dot,
    power,
    rotate,
    rotate_back,
    wrench_cross,
)
from hil.dynamics.inertial import PARAMETERS

if TYPE_CHECKING:
    from hil.dynamics.build import JointGeometry
    from hil.dynamics.robot_model import RobotModel


class MotionGradient(NamedTuple):
    """Derivatives of a scalar by the motion, each (N, n)."""

    q: FloatArray
    qd: FloatArray
    qdd: FloatArray


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


class _LinkMotion(NamedTuple):
    """In each link's own frame, (3, n, N): d, α, ω, and the velocity of the origin."""

    d: FloatArray
    alpha: FloatArray
    omega: FloatArray
    speed: FloatArray


def _outwards(wrench: FloatArray) -> FloatArray:
    """Sums over all links from k to the last, (2, 3, n, N)."""
    return np.flip(np.cumsum(np.flip(wrench, axis=2), axis=2), axis=2)


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
