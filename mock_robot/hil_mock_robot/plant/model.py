"""Rigid body of the arm in MuJoCo: links, rotors, payload and gravity, without contacts.

Friction, drives and control are in other modules, and act on the rigid body as joint torques.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from hil.arms import ArmDescription, Payload
from hil.core import FloatArray, SpecError
from hil_mock_robot.plant.truth import LinkTruth

LEAST_INERTIA = 1e-9
"""Inertia [kg·m²] added to every body; a point mass is a valid payload, but MuJoCo requires an
inertia."""


@dataclass(frozen=True, slots=True, eq=False)
class Plant:
    """Compiled rigid-body model with its state and numpy views of the state.

    Attributes:
        model, data: MuJoCo objects, which must exist as long as their addresses are used.
    """

    model: Any
    data: Any

    @property
    def addresses(self) -> tuple[int, int]:
        """Addresses of mjModel and mjData."""
        return int(self.model._address), int(self.data._address)  # noqa: SLF001

    def mass_matrix(self, q: FloatArray) -> FloatArray:
        """Return the joint-space inertia (n, n) at `q` (n,), rotors included [kg·m²]."""
        scratch = mujoco.MjData(self.model)
        scratch.qpos[:] = q
        mujoco.mj_forward(self.model, scratch)
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, scratch, full)
        return full

    def inverse(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return the joint torque (n,) of a motion, without friction [N·m]."""
        scratch = mujoco.MjData(self.model)
        scratch.qpos[:], scratch.qvel[:], scratch.qacc[:] = q, qd, qdd
        mujoco.mj_inverse(self.model, scratch)
        return np.array(scratch.qfrc_inverse)


def nominal_links(arm: ArmDescription) -> tuple[LinkTruth, ...]:
    """Return the published links, which are the model of the robot's controller."""
    return tuple(
        LinkTruth(
            float(mass),
            (float(com[0]), float(com[1]), float(com[2])),
            (
                float(inertia[0, 0]), float(inertia[1, 1]), float(inertia[2, 2]),
                float(inertia[0, 1]), float(inertia[0, 2]), float(inertia[1, 2]),
            ),
        )
        for mass, com, inertia in zip(arm.mass, arm.com, arm.inertia, strict=True)
    )  # fmt: skip


def build_plant(
    dh: FloatArray,
    links: Sequence[LinkTruth],
    rotors: Sequence[float],
    payload: Payload,
    gravity: tuple[float, float, float],
    timestep: float,
) -> Plant:
    """Build and compile the rigid-body model of the arm.

    Each body has the frame of its joint and rotates about its z axis. The fixed part of the DH
    transform, Tz(d)·Tx(a)·Rx(α), leads to the distal frame. Inertial parameters are given in the
    distal frame, in which the next joint begins.

    Args:
        dh: (n, 4) rows of a, alpha, d, theta offset.
        links: n links in their distal DH frames.
        rotors: n reflected rotor inertias [kg·m²].
        payload: Payload at the flange, in the distal frame of the last link.
        gravity: Gravity in the base frame [m/s²].
        timestep: Integration step [s].
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.option.gravity = gravity
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.disableflags = _disabled()
    parent, position, rotation = spec.worldbody, np.zeros(3), np.eye(3)
    for i, (row, link, rotor) in enumerate(zip(dh, links, rotors, strict=True)):
        turned = rotation @ _rotation_z(row[3])
        body = parent.add_body(name=f"link{i + 1}", pos=position, quat=_quaternion(turned))
        body.add_joint(
            name=f"joint{i + 1}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], armature=rotor
        )
        position = np.array([row[0], 0.0, row[2]])
        rotation = _rotation_x(row[1])
        _set_inertial(body, link, position, rotation)
        parent = body
    if not payload.is_empty:
        load = parent.add_body(name="payload", pos=position, quat=_quaternion(rotation))
        _set_inertial(
            load, LinkTruth(payload.mass, payload.com, payload.inertia), np.zeros(3), np.eye(3)
        )
    try:
        model = spec.compile()
    except ValueError as error:
        raise SpecError(
            f"the mock cannot simulate this arm: {error}",
            hint="check mass_kg and inertia_kgm2 in the description of the arm",
        ) from error
    return Plant(model, mujoco.MjData(model))


def _disabled() -> int:
    """Return the flags that disable unneeded features, and autoreset, which hides divergence."""
    bit = mujoco.mjtDisableBit
    flags = (
        bit.mjDSBL_CONTACT, bit.mjDSBL_CONSTRAINT, bit.mjDSBL_ACTUATION, bit.mjDSBL_SENSOR,
        bit.mjDSBL_SPRING, bit.mjDSBL_DAMPER, bit.mjDSBL_EULERDAMP, bit.mjDSBL_ISLAND,
        bit.mjDSBL_AUTORESET,
    )  # fmt: skip
    return sum(int(flag) for flag in flags)


def _rotation_z(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _quaternion(rotation: FloatArray) -> FloatArray:
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    return quaternion


def _rotation_x(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _set_inertial(body: Any, link: LinkTruth, position: FloatArray, rotation: FloatArray) -> None:
    xx, yy, zz, xy, xz, yz = link.inertia_kgm2
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    turned = rotation @ inertia @ rotation.T + LEAST_INERTIA * np.eye(3)
    body.explicitinertial = True
    body.mass = link.mass_kg
    body.ipos = position + rotation @ np.array(link.com_m)
    body.fullinertia = [
        turned[0, 0], turned[1, 1], turned[2, 2], turned[0, 1], turned[0, 2], turned[1, 2],
    ]  # fmt: skip
