"""The rigid body in PyTorch: joint torques of all links at once, by 4×4 matrices.

With link poses Tᵢ in the base and joint twists Gᵢ (4×4, base), velocities are V = Σ G·q̇ over the
joints up to a link, accelerations V' = Σ (G·q̈ + [V, G]·q̇), and a link with pseudo-inertia J takes
A = (V' + V²)·T J Tᵀ, gravity within V'. A joint holds τᵢ = ⟨Gᵢ, Σ A⟩ over the links it carries
(Uicker 1967, in the notation of Wensing, Kim & Slotine 2018). It is Newton and Euler without their
walk from link to link: only the poses are multiplied one by one, sums along the chain are products
with a triangular matrix. So there are few operations, which is what a sample costs in a runtime.
Where motors move more than one joint, q, q̇, q̈, rotors and torques are the motors'.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from hil.core import FloatArray
from hil.dynamics import skew
from hil.export.program import Program
from hil.export.torch_constants import hold


class RigidTorque(nn.Module):
    """Torques of links and load, linear in what the bodies are.

    Args:
        program: Geometry, gravity, flange and bodies.
    """

    def __init__(self, program: Program) -> None:
        super().__init__()
        self.n = program.n
        self.slides = not np.all(program.geometry.turns)
        self.own_gears = not np.array_equal(program.gears, program.rigid)
        self.coupled = program.coupling is not None
        if program.coupling is not None:
            hold(self, joints=program.coupling.T, motors=program.coupling)
        hold(self, **_geometry(program), **_load(program), rotors=program.rigid[:, 10])
        hold(self, bodies=np.array([pseudo_inertia(row) for row in program.rigid]))
        if self.own_gears:
            hold(self, gears=np.array([pseudo_inertia(row) for row in program.gears]))
            hold(self, gear_rotors=program.gears[:, 10])

    def forward(self, q: Tensor, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor]:
        """Torque of the rigid body with load, and what of it the gears transmit, (B, n) [N·m].

        Args:
            q: (B, n) [rad].
            qd: (B, n) [rad/s].
            qdd: (B, n) [rad/s²].
            load: (B, 10) mass [kg], centre of mass [m] in the flange's frame, inertia about it
                (xx, yy, zz, xy, xz, yz) [kg·m²].
        """
        moves = [rows @ self.joints for rows in (q, qd, qdd)] if self.coupled else [q, qd, qdd]
        pose = self._poses(moves[0])
        twist = self._twists(pose)
        moving = self._moving(twist, *moves[1:])
        mounted = self.last * self._mounted(load)
        torque = self._held(pose, twist, moving, self.bodies + mounted) + self.rotors * qdd
        if not self.own_gears:
            return torque, torque
        gears = self._held(pose, twist, moving, self.gears + mounted) + self.gear_rotors * qdd
        return torque, gears

    def _poses(self, q: Tensor) -> Tensor:
        """(B, n, 4, 4) of the links in the base."""
        angle = q.reshape(-1, self.n, 1, 1)
        step = self.still + torch.cos(angle) * self.cosine + torch.sin(angle) * self.sine
        if self.slides:
            step = step + angle * self.slide
        poses: list[Tensor] = []
        for one in step.split(1, dim=1):
            poses.append(poses[-1] @ one if poses else one)
        return torch.cat(poses, dim=1)

    def _twists(self, pose: Tensor) -> Tensor:
        """(B, n, 4, 4) velocity of space that moves with a joint, per unit of its own."""
        axis = (pose @ self.turning).reshape(-1, self.n, 4)
        turn = (axis @ self.skewed).reshape(-1, self.n, 4, 4)
        twist = turn @ (self.one - pose @ self.corner)
        return twist + pose @ self.sliding if self.slides else twist

    def _moving(self, twist: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """(B, n, 4, 4) position in the base → acceleration there, less gravity's."""
        v, a = (values.reshape(-1, self.n, 1, 1) for values in (qd, qdd))
        velocity = self._outwards(twist * v)
        bracket = velocity @ twist - twist @ velocity
        return self._outwards(twist * a + bracket * v) + velocity @ velocity + self.falling

    def _held(self, pose: Tensor, twist: Tensor, moving: Tensor, inertia: Tensor) -> Tensor:
        wrench = moving @ (pose @ inertia @ pose.transpose(2, 3))
        carried = self.inwards @ wrench.reshape(-1, self.n, 16)
        torque = (twist.reshape(-1, self.n, 16) * carried).sum(dim=2)
        return torque @ self.motors if self.coupled else torque

    def _outwards(self, each: Tensor) -> Tensor:
        """Sums over the joints up to each link."""
        return (self.outwards @ each.reshape(-1, self.n, 16)).reshape(-1, self.n, 4, 4)

    def _mounted(self, load: Tensor) -> Tensor:
        """(B, 1, 4, 4) pseudo-inertia of a load in the last link's frame."""
        about_centre = (load @ self.load_inertia).reshape(-1, 1, 4, 4)
        centre = load @ self.load_centre + self.load_origin
        mass = load[:, :1].reshape(-1, 1, 1, 1)
        return about_centre + mass * (centre.reshape(-1, 1, 4, 1) * centre.reshape(-1, 1, 1, 4))


def _geometry(program: Program) -> dict[str, FloatArray]:
    """Poses of the joints are still + cosine·cos q + sine·sin q + slide·q (Rodrigues)."""
    n, geometry = program.n, program.geometry
    whole = np.zeros((4, n, 4, 4))
    still, cosine, sine, slide = whole
    turning = np.zeros((n, 4, 1))
    falling = np.zeros((4, 4))
    falling[:3, 3] = -program.gravity
    last = np.zeros((n, 1, 1))
    last[-1] = 1.0
    for i, axis in enumerate(geometry.axis):
        still[i, 3, 3] = 1.0
        if geometry.turns[i]:
            along = np.outer(axis, axis)
            still[i, :3, :3], cosine[i, :3, :3], sine[i, :3, :3] = (
                along, np.eye(3) - along, skew(axis),
            )  # fmt: skip
            turning[i, :3, 0] = axis
        else:
            still[i, :3, :3], slide[i, :3, 3] = np.eye(3), axis
    still, cosine, sine, moved = (geometry.placement @ part for part in whole)
    skewed = np.zeros((4, 4, 4))
    skewed[:3, :3, :3] = np.array([skew(axis) for axis in np.eye(3)])
    return {
        "still": still, "cosine": cosine, "sine": sine, "slide": moved, "sliding": slide,
        "turning": turning, "skewed": skewed.reshape(4, 16), "falling": falling, "last": last,
        "one": np.eye(4), "corner": np.diag([0.0, 0.0, 0.0, 1.0]),
        "outwards": np.tril(np.ones((n, n))), "inwards": np.triu(np.ones((n, n))),
    }  # fmt: skip


def _load(program: Program) -> dict[str, FloatArray]:
    """A load's ten numbers → its inertia about its centre, and where that is, in the last link."""
    flange = program.flange
    inertia, centre = np.zeros((10, 4, 4)), np.zeros((10, 4))
    # xx, yy, zz, xy, xz, yz among the parameters of a body
    for number, parameter in enumerate((4, 6, 9, 5, 7, 8)):
        inertia[4 + number] = flange @ pseudo_inertia(np.eye(10)[parameter]) @ flange.T
    centre[1:4] = flange[:, :3].T
    return {
        "load_inertia": inertia.reshape(10, 16),
        "load_centre": centre,
        "load_origin": flange[:, 3],
    }


def pseudo_inertia(body: FloatArray) -> FloatArray:
    """(4, 4) ∫ x xᵀ dm of x = (position, 1), from a body in `hil.dynamics.inertial`'s order."""
    m, xx, xy, yy, xz, yz, zz = body[0], *body[4:10]
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    J = np.empty((4, 4))
    J[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    J[:3, 3] = J[3, :3] = body[1:4]
    J[3, 3] = m
    return J
