"""Pinocchio models from an arm description or a URDF file."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pinocchio as pin

from hil.arms import ArmDescription
from hil.core import BoolArray, FloatArray, SpecError, utf8_text
from hil.dynamics.urdf import read_serial_arm

UNLIMITED = 1e9
"""Stands for infinity in a URDF, which has no word for it."""

FLANGE_NAMES = ("tool0", "flange")


def model_from_arm(arm: ArmDescription) -> pin.Model:
    """Return a Pinocchio model of an arm in standard DH convention: the caller's own copy.

    Joint i turns about z of DH frame i−1; Pinocchio's joint frame i sits there, turned by q_i, so
    inertial parameters are about that frame. The centres of mass are given in the DH frames, which
    is why a body is appended at the same placement as the joint that follows.
    """
    return _built(arm).copy()


@lru_cache(maxsize=16)
def _built(arm: ArmDescription) -> pin.Model:
    """Build the model of a description, which is one object per arm and never changes."""
    limits = (arm.effort_max, arm.qd_max, arm.q_min, arm.q_max)
    model = model_of_dh(arm.dh, arm.mass, arm.com, arm.inertia, arm.joint_names, limits)
    model.name = utf8_text(arm.name)
    return model


def model_of_dh(
    dh: FloatArray,
    mass: FloatArray,
    com: FloatArray,
    inertia: FloatArray,
    names: Sequence[str] = (),
    limits: Sequence[FloatArray] = (),
) -> pin.Model:
    """The same of bare numbers: (n, 4), (n,), (n, 3), (n, 3, 3) as `ArmDescription` has them.

    `limits` are those of torque, speed and position, each (n,); none by default.
    """
    model = pin.Model()
    parent, placement = 0, pin.SE3.Identity()
    for i, (a, alpha, d, theta) in enumerate(dh):
        zero = pin.SE3(pin.utils.rotate("z", theta), np.zeros(3))
        name = names[i] if names else f"joint_{i + 1}"
        bounds = [np.array([limit[i]]) for limit in limits]
        parent = model.addJoint(parent, pin.JointModelRZ(), placement * zero, name, *bounds)
        placement = pin.SE3(pin.utils.rotate("x", alpha), np.array([a, 0.0, d]))
        model.appendBodyToJoint(parent, pin.Inertia(float(mass[i]), com[i], inertia[i]), placement)
    model.addFrame(pin.Frame("flange", parent, 0, placement, pin.FrameType.OP_FRAME))
    return model


def model_from_urdf(path: Path, flange: str | None = None) -> tuple[pin.Model, int]:
    """A Pinocchio model of a fixed-base serial arm and the frame loads are mounted at.

    Args:
        path: The URDF file.
        flange: Link that loads are mounted at; by default `tool0` or `flange` where the file has
            one, else the link of the last joint.

    Raises:
        SpecError: The file is missing, no XML, no URDF, or not of a fixed-base serial arm.
    """
    root = read_serial_arm(path)
    endless = [joint for joint in root.findall("joint") if joint.get("type") == "continuous"]
    for joint in endless:
        _limit(joint)
    try:
        model = pin.buildModelFromXML(ET.tostring(root, encoding="unicode"))
    except (ValueError, RuntimeError) as error:
        raise SpecError(
            f"{path}: not a usable URDF: {error}", hint="check it with `check_urdf`"
        ) from None
    _unlimit(model, [str(joint.get("name")) for joint in endless])
    _set_armature(model, root)
    return model, _flange_frame(model, path, flange)


def _set_armature(model: pin.Model, root: ET.Element) -> None:
    """Rotor inertias: the `armature` of a joint's dynamics is MuJoCo's word, not URDF's."""
    armature = model.armature.copy()
    for joint in root.findall("joint"):
        told = joint.find("dynamics")
        if told is not None and joint.get("type") != "fixed":
            index = model.joints[model.getJointId(str(joint.get("name")))].idx_v
            armature[index] = float(told.get("armature", "0"))
    model.armature = armature


def _limit(joint: ET.Element) -> None:
    """Make an endless joint an ordinary one: Pinocchio would give it two coordinates."""
    joint.set("type", "revolute")
    limit = joint.find("limit")
    if limit is None:
        limit = ET.SubElement(joint, "limit", effort=str(UNLIMITED), velocity=str(UNLIMITED))
    limit.set("lower", str(-UNLIMITED))
    limit.set("upper", str(UNLIMITED))


def _unlimit(model: pin.Model, endless: list[str]) -> None:
    """Say infinite where `_limit` had to say a number."""
    for name in ("lowerPositionLimit", "upperPositionLimit", "velocityLimit", "effortLimit"):
        values = getattr(model, name).copy()
        for index in (model.joints[model.getJointId(joint)].idx_q for joint in endless):
            if abs(values[index]) == UNLIMITED:
                values[index] *= np.inf
        setattr(model, name, values)


def _flange_frame(model: pin.Model, path: Path, flange: str | None) -> int:
    last = model.njoints - 1
    bodies = [
        frame.name
        for frame in model.frames
        if frame.parentJoint == last and frame.type == pin.FrameType.BODY
    ]
    known = [name for name in FLANGE_NAMES if name in bodies]
    name = flange or (known or bodies)[0]
    if name not in bodies:
        raise SpecError(
            f"{path}: the flange {name!r} is not a link behind the last joint",
            hint=f"there are {', '.join(bodies)}",
        )
    return int(model.getFrameId(name))


@dataclass(frozen=True, slots=True, eq=False)
class JointGeometry:
    """Where the joints of a chain are, and about or along what they move.

    Attributes:
        placement: (n, 4, 4) of each joint's frame in the one before, at q = 0.
        axis: (n, 3) of length 1, in the joint's own frame.
        turns: (n,) true where the joint turns about its axis, false where it slides along it.
    """

    placement: FloatArray
    axis: FloatArray
    turns: BoolArray


def joint_geometry(model: pin.Model) -> JointGeometry:
    """The geometry of a model's joints, the first one's frame given in the base's."""
    data, joints = model.createData(), range(1, model.njoints)
    pin.computeJointJacobians(model, data, pin.neutral(model))
    moves = [pin.getJointJacobian(model, data, j, pin.ReferenceFrame.LOCAL) for j in joints]
    # Column j of its own Jacobian: how joint j moves its own frame, linear before angular. Of a
    # single joint, Pinocchio's Jacobian is a vector.
    motions = np.array(
        [move.reshape(6, -1)[:, j - 1] for j, move in zip(joints, moves, strict=True)]
    )
    linear, angular = motions[:, :3], motions[:, 3:]
    return JointGeometry(
        placement=np.array([pose_of(place) for place in list(model.jointPlacements)[1:]]),
        axis=linear + angular,
        turns=np.any(angular != 0, axis=1),
    )


def pose_of(placement: pin.SE3) -> FloatArray:
    """(4, 4) homogeneous matrix."""
    return np.array(placement.homogeneous)
