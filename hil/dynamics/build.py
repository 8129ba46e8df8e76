"""Construction of Pinocchio models from an arm description or a URDF file.

The error messages of Pinocchio for an unusable URDF contain few details. Therefore
`read_serial_arm` checks the file first and reports the problems.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pinocchio as pin

from hil.arms import ArmDescription
from hil.core import BoolArray, FloatArray, SpecError, neighbour_of, no_file, utf8_text

UNLIMITED = 1e9
"""Number that replaces infinity in a URDF, which cannot represent infinity."""

FLANGE_NAMES = ("tool0", "flange")


def model_from_arm(arm: ArmDescription) -> pin.Model:
    """Return a new Pinocchio model of an arm in standard DH convention.

    Joint i of an arm in DH convention rotates about the z axis of DH frame i−1. Joint frame i of
    Pinocchio is DH frame i−1, rotated by q_i; the inertial parameters of the model refer to this
    joint frame. The centres of mass of an arm description are defined in DH frames, so a body has
    the same placement as the following joint.
    """
    return _built(arm).copy()


@lru_cache(maxsize=16)
def _built(arm: ArmDescription) -> pin.Model:
    """Return the cached Pinocchio model of a description; equal descriptions share one object."""
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
    """Return a Pinocchio model of DH parameters and inertial parameters.

    Args:
        dh: (n, 4) DH parameters in the order of `ArmDescription`.
        mass: (n,) masses.
        com: (n, 3) centres of mass in the DH frames.
        inertia: (n, 3, 3) inertias.
        names: Names of the n joints; empty for `joint_1`, `joint_2`, ….
        limits: Limits of torque, speed, lower position and upper position, each (n,); empty for no
            limits.
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
    """Return the Pinocchio model of a fixed-base serial arm, and the frame that carries loads.

    Args:
        path: URDF file.
        flange: Name of the link that carries loads; if not passed, `tool0` or `flange` if the file
            has such a link, else the link of the last joint.

    Raises:
        SpecError: The file is missing, is not XML, is not a URDF, or does not describe a fixed-base
            serial arm.
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


def _limit(joint: ET.Element) -> None:
    """Make a continuous joint revolute, because Pinocchio would use two coordinates for it."""
    joint.set("type", "revolute")
    limit = joint.find("limit")
    if limit is None:
        limit = ET.SubElement(joint, "limit", effort=str(UNLIMITED), velocity=str(UNLIMITED))
    limit.set("lower", str(-UNLIMITED))
    limit.set("upper", str(UNLIMITED))


def _unlimit(model: pin.Model, endless: list[str]) -> None:
    """Set those limits of a model to infinity for which `_limit` had to insert a number."""
    for name in ("lowerPositionLimit", "upperPositionLimit", "velocityLimit", "effortLimit"):
        values = getattr(model, name).copy()
        for index in (model.joints[model.getJointId(joint)].idx_q for joint in endless):
            if abs(values[index]) == UNLIMITED:
                values[index] *= np.inf
        setattr(model, name, values)


def _set_armature(model: pin.Model, root: ET.Element) -> None:
    """Set the rotor inertias from `armature`, an attribute of `<dynamics>` that MuJoCo defines."""
    armature = model.armature.copy()
    for joint in root.findall("joint"):
        told = joint.find("dynamics")
        if told is not None and joint.get("type") != "fixed":
            index = model.joints[model.getJointId(str(joint.get("name")))].idx_v
            armature[index] = float(told.get("armature", "0"))
    model.armature = armature


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
            hint=f"use one of {', '.join(bodies)}",
        )
    return int(model.getFrameId(name))


@dataclass(frozen=True, slots=True, eq=False)
class JointGeometry:
    """Placements and axes of the joints of a serial chain.

    Attributes:
        placement: (n, 4, 4) pose of each joint frame in the previous joint frame, at q = 0.
        axis: (n, 3) unit vectors in the joint frames.
        turns: (n,) flags; true if a joint is revolute about its axis, false if it is prismatic
            along its axis.
    """

    placement: FloatArray
    axis: FloatArray
    turns: BoolArray


def joint_geometry(model: pin.Model) -> JointGeometry:
    """Return the geometry of a model's joints; the first placement is in the base frame."""
    data, joints = model.createData(), range(1, model.njoints)
    pin.computeJointJacobians(model, data, pin.neutral(model))
    moves = [pin.getJointJacobian(model, data, j, pin.ReferenceFrame.LOCAL) for j in joints]
    # Column j of the Jacobian of frame j is the motion of joint j in its own frame, linear before
    # angular. For a single joint, Pinocchio returns a vector.
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
    """Return the homogeneous matrix (4, 4) of a placement."""
    return np.array(placement.homogeneous)


MOVING = ("revolute", "continuous", "prismatic")

NUMBERS = {
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
    "origin": ("xyz", "rpy"),
    "axis": ("xyz",),
    "limit": ("lower", "upper", "effort", "velocity"),
    "dynamics": ("damping", "friction", "armature"),
}
"""Mapping from a URDF element to those of its attributes that contain numbers, in joints and
inertias.
"""


def read_serial_arm(path: Path) -> ET.Element:
    """Return the root element of a URDF that describes a fixed-base serial arm.

    Raises:
        SpecError: The file is missing, is not XML, is not a URDF, or describes a different kind of
            robot; the message has one line per problem.
    """
    root = _parsed(path)
    problems = list(_problems(root))
    if problems:
        raise SpecError(
            "\n".join(f"{path}: {problem}" for problem in problems),
            hint="repair the file; only fixed-base serial arms of revolute and prismatic joints "
            "can be identified, so set the joints of grippers and other branches to `fixed`",
        )
    return root


def _parsed(path: Path) -> ET.Element:
    try:
        root = ET.parse(path).getroot()  # noqa: S314  a file of the user's own bench
    except FileNotFoundError:
        hint = f"{neighbour_of(path, ['.urdf', '.xml'])} Or name a built-in arm"
        raise SpecError(no_file(path), hint=hint) from None
    except OSError as error:
        raise SpecError(
            f"{path}: cannot be read ({error.strerror})",
            hint="give the path of a URDF file or the name of a built-in arm",
        ) from None
    except (ET.ParseError, ValueError) as error:
        raise SpecError(
            f"{path}: not well-formed XML: {error}", hint="check that the file is a URDF"
        ) from None
    if root.tag != "robot":
        raise SpecError(
            f"{path}: the outermost element is <{root.tag}>, a URDF has <robot>",
            hint="convert a xacro file to a URDF with `xacro file.xacro > file.urdf`",
        )
    return root


def _problems(root: ET.Element) -> Iterator[str]:
    links, joints = root.findall("link"), root.findall("joint")
    for kind, elements in (("link", links), ("joint", joints)):
        names = Counter(str(element.get("name")) for element in elements)
        yield from (f"two {kind}s are called {name!r}" for name, n in names.items() if n > 1)
        yield from (f"a {kind} has no name" for element in elements if not element.get("name"))
    for joint in joints:
        yield from (f"joint {joint.get('name')!r} {what}" for what in _joint_problems(joint))
    for element in (*links, *joints):
        yield from _number_problems(element)
    if not any(joint.get("type") in MOVING for joint in joints):
        yield "no joint moves"
    else:
        yield from _tree_problems(links, joints)


def _joint_problems(joint: ET.Element) -> Iterator[str]:
    kind, limit = joint.get("type"), joint.find("limit")
    if kind not in (*MOVING, "fixed"):
        yield f"is of type {kind!r}"
    elif kind in ("revolute", "prismatic"):
        if limit is None:
            yield "has no <limit>"
        elif not _first(limit, "lower") <= _first(limit, "upper"):
            yield "has a lower limit above its upper limit"
    if kind in MOVING and limit is not None:
        for word in ("effort", "velocity"):
            if limit.get(word) is None:
                yield f"has a <limit> without `{word}`"
            elif _first(limit, word) < 0:
                yield f"has a negative {word} limit"
    if joint.find("mimic") is not None:
        yield "mimics a different joint"
    axis = joint.find("axis")
    if kind in MOVING and axis is not None and not any(_numbers(axis.get("xyz", ""))):
        yield "has an axis of length 0"


def _first(element: ET.Element, attribute: str) -> float:
    return _numbers(element.get(attribute, "0"))[0]


def _numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split()] or [math.nan]
    except ValueError:
        return [math.nan]


def _number_problems(element: ET.Element) -> Iterator[str]:
    """Yield problems with the numbers of a joint or a link; meshes and colours are not read."""
    name = f"{element.tag} {element.get('name')!r}"
    part = element.find("inertial") if element.tag == "link" else element
    if part is not None and element.tag == "link":
        for tag in ("mass", "inertia"):
            said = part.find(tag)
            lacks = [word for word in NUMBERS[tag] if said is None or said.get(word) is None]
            if lacks:
                yield f"{name}: <{tag}> has no {', '.join(lacks)}"
    for child in () if part is None else part:
        for attribute in NUMBERS.get(child.tag, ()):
            text = child.get(attribute)
            if text is not None and not all(map(math.isfinite, _numbers(text))):
                yield f"{name}: <{child.tag} {attribute}={text!r}> is not a number"
        if child.tag == "mass" and _first(child, "value") < 0:
            yield f"{name}: the mass is negative"


def _tree_problems(links: list[ET.Element], joints: list[ET.Element]) -> Iterator[str]:
    names = {str(link.get("name")) for link in links}
    ends = [(_end(joint, "parent"), _end(joint, "child")) for joint in joints]
    lost = sorted({name for pair in ends for name in pair} - names)
    if lost:
        yield f"joints refer to links that do not exist: {', '.join(map(repr, lost))}"
        return
    carried = Counter(child for _, child in ends)
    yield from (f"link {name!r} is the child of {n} joints" for name, n in carried.items() if n > 1)
    roots = names - carried.keys()
    adrift = names - _reached(roots, ends) if len(roots) == 1 else roots
    if len(roots) != 1 or adrift:
        yield (
            f"the links do not form one tree: not connected: {', '.join(map(repr, sorted(adrift)))}"
        )
        return
    yield from _forks(joints)


def _end(joint: ET.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else str(element.get("link"))


def _reached(roots: set[str], ends: list[tuple[str, str]]) -> set[str]:
    """Return all links that are connected to the root links, including the root links."""
    reached, new = set(roots), set(roots)
    while new:
        new = {child for parent, child in ends if parent in new} - reached
        reached |= new
    return reached


def _forks(joints: list[ET.Element]) -> Iterator[str]:
    """Yield links that carry more than one moving joint, directly or through fixed joints."""
    up = {_end(j, "child"): _end(j, "parent") for j in joints if j.get("type") == "fixed"}
    carried: dict[str, list[str]] = {}
    for joint in joints:
        if joint.get("type") != "fixed":
            link = _end(joint, "parent")
            while link in up:
                link = up[link]
            carried.setdefault(link, []).append(str(joint.get("name")))
    for link, names in carried.items():
        if len(names) > 1:
            yield f"not a serial arm: link {link!r} carries the joints {', '.join(names)}"
