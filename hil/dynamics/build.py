"""Pinocchio models from an arm description or a URDF file."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin

from hil.arms import ArmDescription
from hil.errors import SpecError
from hil.typing import FloatArray

MOVING = ("revolute", "continuous", "prismatic")
UNLIMITED_RAD = 1e6
FLANGE_NAMES = ("tool0", "flange")


def model_from_arm(arm: ArmDescription) -> pin.Model:
    """A Pinocchio model of an arm in standard DH convention.

    Joint i turns about z of DH frame i−1; Pinocchio's joint frame i sits there, turned by q_i, so
    inertial parameters are about that frame. The centres of mass are given in the DH frames, which
    is why a body is appended at the same placement as the joint that follows.
    """
    model = pin.Model()
    model.name = arm.name
    parent, placement = 0, pin.SE3.Identity()
    for i, (a, alpha, d, theta) in enumerate(arm.dh):
        zero = pin.SE3(pin.utils.rotate("z", theta), np.zeros(3))
        parent = model.addJoint(
            parent,
            pin.JointModelRZ(),
            placement * zero,
            arm.joint_names[i],
            *(np.array([x[i]]) for x in (arm.effort_max, arm.qd_max, arm.q_min, arm.q_max)),
        )
        placement = pin.SE3(pin.utils.rotate("x", alpha), np.array([a, 0.0, d]))
        body = pin.Inertia(float(arm.mass[i]), arm.com[i], arm.inertia[i])
        model.appendBodyToJoint(parent, body, placement)
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
    root = _parsed(path)
    _require_serial_arm(root, path)
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
    return model, _flange_frame(model, path, flange)


def _parsed(path: Path) -> ET.Element:
    try:
        root = ET.parse(path).getroot()  # noqa: S314  a file of the user's own bench
    except OSError as error:
        raise SpecError(
            f"{path}: cannot be read ({error.strerror})",
            hint="give the path of a URDF file or the name of a built-in arm",
        ) from None
    except ET.ParseError as error:
        raise SpecError(f"{path}: not well-formed XML: {error}", hint="is it a xacro?") from None
    if root.tag != "robot":
        raise SpecError(
            f"{path}: the outermost element is <{root.tag}>, a URDF has <robot>",
            hint="turn a xacro into a URDF with `xacro file.xacro > file.urdf`",
        )
    return root


def _require_serial_arm(root: ET.Element, path: Path) -> None:
    kinds = {str(j.get("name")): str(j.get("type")) for j in root.findall("joint")}
    free = [name for name, kind in kinds.items() if kind not in (*MOVING, "fixed")]
    if free:
        raise SpecError(
            f"{path}: joint {free[0]!r} is of type {kinds[free[0]]!r}",
            hint="only fixed-base arms of revolute and prismatic joints can be identified",
        )
    if not set(kinds.values()) & set(MOVING):
        raise SpecError(f"{path}: no joint moves", hint="at least one joint must not be fixed")
    forks = _forks(root)
    if forks:
        raise SpecError(
            f"{path}: not a serial arm: {forks[0]}",
            hint="make the joints of grippers and other branches fixed",
        )


def _forks(root: ET.Element) -> list[str]:
    """Where more than one moving joint hangs on a link, possibly over fixed joints."""
    joints = root.findall("joint")
    up = {_end(j, "child"): _end(j, "parent") for j in joints if j.get("type") == "fixed"}
    carried: dict[str, list[str]] = {}
    for joint in joints:
        if joint.get("type") in MOVING:
            link = _end(joint, "parent")
            while link in up:
                link = up[link]
            carried.setdefault(link, []).append(str(joint.get("name")))
    return [
        f"link {link!r} carries the joints {', '.join(names)}"
        for link, names in carried.items()
        if len(names) > 1
    ]


def _end(joint: ET.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else str(element.get("link"))


def _limit(joint: ET.Element) -> None:
    """Make an endless joint an ordinary one: Pinocchio would give it two coordinates."""
    joint.set("type", "revolute")
    limit = joint.find("limit")
    if limit is None:
        limit = ET.SubElement(joint, "limit", effort="inf", velocity="inf")
    limit.set("lower", str(-UNLIMITED_RAD))
    limit.set("upper", str(UNLIMITED_RAD))


def _unlimit(model: pin.Model, endless: list[str]) -> None:
    low, high = model.lowerPositionLimit.copy(), model.upperPositionLimit.copy()
    for name in endless:
        index = model.joints[model.getJointId(name)].idx_q
        low[index], high[index] = -np.inf, np.inf
    model.lowerPositionLimit, model.upperPositionLimit = low, high


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


def pose_of(placement: pin.SE3) -> FloatArray:
    """(4, 4) homogeneous matrix."""
    return np.array(placement.homogeneous)
