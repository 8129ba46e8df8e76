"""Pinocchio models from an arm description or a URDF file.

Pinocchio says little about a URDF it cannot use, so `read_serial_arm` says what is wrong first.
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


def _set_armature(model: pin.Model, root: ET.Element) -> None:
    """Rotor inertias: the `armature` of a joint's dynamics is MuJoCo's word, not URDF's."""
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


MOVING = ("revolute", "continuous", "prismatic")

NUMBERS = {
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
    "origin": ("xyz", "rpy"),
    "axis": ("xyz",),
    "limit": ("lower", "upper", "effort", "velocity"),
    "dynamics": ("damping", "friction", "armature"),
}
"""Attributes that hold numbers, by element, in the joints and the inertias."""


def read_serial_arm(path: Path) -> ET.Element:
    """The root element of a URDF that describes a fixed-base serial arm.

    Raises:
        SpecError: The file is missing, no XML, no URDF or of another kind of robot; one line per
            problem.
    """
    root = _parsed(path)
    problems = list(_problems(root))
    if problems:
        raise SpecError(
            "\n".join(f"{path}: {problem}" for problem in problems),
            hint="mend the file; only fixed-base serial arms of revolute and prismatic joints can "
            "be identified, so make the joints of grippers and other branches fixed",
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
        raise SpecError(f"{path}: not well-formed XML: {error}", hint="is it a URDF?") from None
    if root.tag != "robot":
        raise SpecError(
            f"{path}: the outermost element is <{root.tag}>, a URDF has <robot>",
            hint="turn a xacro into a URDF with `xacro file.xacro > file.urdf`",
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
            yield "has a lower limit above its upper one"
    if kind in MOVING and limit is not None:
        for word in ("effort", "velocity"):
            if limit.get(word) is None:
                yield f"has a <limit> without `{word}`"
            elif _first(limit, word) < 0:
                yield f"has a negative {word} limit"
    if joint.find("mimic") is not None:
        yield "mimics another"
    axis = joint.find("axis")
    if kind in MOVING and axis is not None and not any(_numbers(axis.get("xyz", ""))):
        yield "turns about an axis of length 0"


def _first(element: ET.Element, attribute: str) -> float:
    return _numbers(element.get(attribute, "0"))[0]


def _numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split()] or [math.nan]
    except ValueError:
        return [math.nan]


def _number_problems(element: ET.Element) -> Iterator[str]:
    """Of a link only its inertia counts: meshes and colours are not read."""
    name = f"{element.tag} {element.get('name')!r}"
    part = element.find("inertial") if element.tag == "link" else element
    if part is not None and element.tag == "link":
        for tag in ("mass", "inertia"):
            said = part.find(tag)
            lacks = [word for word in NUMBERS[tag] if said is None or said.get(word) is None]
            if lacks:
                yield f"{name}: its <{tag}> lacks {', '.join(lacks)}"
    for child in () if part is None else part:
        for attribute in NUMBERS.get(child.tag, ()):
            text = child.get(attribute)
            if text is not None and not all(map(math.isfinite, _numbers(text))):
                yield f"{name}: <{child.tag} {attribute}={text!r}> is not a number"
        if child.tag == "mass" and _first(child, "value") < 0:
            yield f"{name}: its mass is negative"


def _tree_problems(links: list[ET.Element], joints: list[ET.Element]) -> Iterator[str]:
    names = {str(link.get("name")) for link in links}
    ends = [(_end(joint, "parent"), _end(joint, "child")) for joint in joints]
    lost = sorted({name for pair in ends for name in pair} - names)
    if lost:
        yield f"joints hang on links that are not there: {', '.join(map(repr, lost))}"
        return
    carried = Counter(child for _, child in ends)
    yield from (f"link {name!r} hangs on {n} joints" for name, n in carried.items() if n > 1)
    roots = names - carried.keys()
    adrift = names - _reached(roots, ends) if len(roots) == 1 else roots
    if len(roots) != 1 or adrift:
        yield f"the links are not one tree: {', '.join(map(repr, sorted(adrift)))} hang apart"
        return
    yield from _forks(joints)


def _end(joint: ET.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else str(element.get("link"))


def _reached(roots: set[str], ends: list[tuple[str, str]]) -> set[str]:
    """All links that hang on the roots, which are among them."""
    reached, new = set(roots), set(roots)
    while new:
        new = {child for parent, child in ends if parent in new} - reached
        reached |= new
    return reached


def _forks(joints: list[ET.Element]) -> Iterator[str]:
    """Where more than one moving joint hangs on a link, possibly over fixed joints."""
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
