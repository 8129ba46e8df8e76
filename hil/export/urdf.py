"""Export of an identified model as a URDF for simulators, planners and controllers.

If the robot is defined by a URDF, the export writes that file with new inertias and friction. All
other bytes of the URDF stay identical. An XML library would lose the layout, the comments and the
entities of the URDF; expat therefore only locates the elements (`edited`). For a built-in arm the
export writes a new file (`written`). In either case the written file is read back and compared with
the predictions of the model (`missed`).
"""

from __future__ import annotations

import math
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np

from hil.core import FitError, FloatArray
from hil.dynamics import GRAVITY, RobotModel, about_centre
from hil.estimators import RobotEstimator
from hil.export.agreement import FAULT, RATE_HZ, SAMPLES, motion, scale_of
from hil.export.exported import Exported, require_new, write_file
from hil.export.identified_parameters import (
    SIGN_WIDTH,
    IdentifiedParameters,
    friction_asked,
    identified_parameters,
    rigid_asked,
)


@dataclass(frozen=True, slots=True, eq=False)
class Miss:
    """Errors of the URDF over all motions, as shares of each joint's largest torque of that kind.

    Attributes:
        rigid: (n,) the larger of two errors: that of gravity alone, and that of gravity with
            inertia.
        friction: (n,) error of the URDF's friction and damping relative to the model's friction
            without offset.
        avoidable: (n,) part of the friction error that the best Coulomb and viscous friction would
            avoid.
    """

    rigid: FloatArray
    friction: FloatArray
    avoidable: FloatArray


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class UrdfExport(Exported):
    """Result of an export to URDF, in addition to the common fields.

    Attributes:
        found: Parameters that the file contains.
        miss: Errors of the file relative to the model, after reading the file back.
        edited: Whether the URDF of the robot was edited; otherwise a new URDF was written.
        turns: Whether each joint is revolute; joints that are not revolute are prismatic.
    """

    found: IdentifiedParameters
    miss: Miss
    edited: bool
    turns: tuple[bool, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the documented output of `hil export --to urdf --json`.

        For prismatic joints, N replaces the unit N·m, and N·s/m replaces N·m·s/rad.
        """
        n = len(self.joint_names)
        bodies = self.found.inertial[: 10 * n].reshape(n, 10)
        return Exported.to_dict(self) | {
            "edited": self.edited,
            "own_parameters": self.found.own,
            "exact": self.found.exact,
            "joint_types": ["revolute" if turns else "prismatic" for turns in self.turns],
            "mass_kg": bodies[:, 0].tolist(),
            "com_m": (bodies[:, 1:4] / bodies[:, :1]).tolist(),
            "rotor_inertia_kgm2": self.found.inertial[10 * n :].tolist(),
            "coulomb_nm": self.found.coulomb.tolist(),
            "viscous_nms_rad": self.found.viscous.tolist(),
            "mismatch_nm": self.found.mismatch.tolist(),
            "rigid_miss": self.miss.rigid.tolist(),
            "friction_miss": self.miss.friction.tolist(),
        }


def export_urdf(model: RobotEstimator, out: Path, *, unchecked: bool = False) -> UrdfExport:
    """Write the arm of a fitted model as a URDF that reproduces the torques of the model.

    Args:
        model: Fitted model with a rigid part; loads are not part of the URDF.
        out: File that is created.
        unchecked: Whether the file is written even if its torques deviate from the model by more
            than the tolerance. The deviation from the model is reported in any case.

    Raises:
        FitError: The model is not fitted, has no rigid part, or has a rigid part that URDF cannot
            represent; or the torques of the file deviate from the model by more than the tolerance.
        PluginError: Consistent parameters must be computed and the package cvxpy is not installed.
        RecordingError: The file already exists, or cannot be created.
    """
    require_new(out)
    if not hasattr(model, "sigma_"):
        raise FitError(f"{model.estimator} is not fitted yet", hint="call fit first")
    robot = model.robot_
    _require_joints(robot)
    found = identified_parameters(model)
    content = _content(model, found)
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder, "arm.urdf")
        draft.write_bytes(content)
        miss = missed(draft, model)
    if not unchecked:
        require_near(miss, found, robot.joint_names)
    write_file(content, out)
    own = robot.arm is None
    made = "the robot's own URDF, edited" if own else "written from the built-in arm"
    return UrdfExport(
        out=out,
        files=(out.name,),
        joint_names=robot.joint_names,
        effort_unit="",
        parts=f"{model.estimator}, {made}",
        checked=words(miss, found),
        notes=_notes(robot, found, own),
        found=found,
        miss=miss,
        edited=own,
        turns=tuple(bool(turns) for turns in robot.joint_geometry().turns),
    )


def _require_joints(robot: RobotModel) -> None:
    """Raise if a motor moves more than one joint.

    Raises:
        FitError: A motor moves more than one joint.
    """
    if getattr(robot, "joints_per_motor", None) is not None:
        raise FitError(
            f"{robot.name} is described in motor angles, and some motors move two joints; in a "
            "URDF each joint has its own rotor and friction",
            hint="use --to json, which contains `joints_per_motor`, or fit the arm in joint "
            f"angles: robot: {robot.name.split('@')[0]}",
        )


def _content(model: RobotEstimator, found: IdentifiedParameters) -> bytes:
    robot = model.robot_
    if robot.arm is not None:
        comment = " ".join([f"identified: {model.estimator}.", *_mount(robot)])
        return written(robot, found, comment).encode()
    parts = range(robot.n)
    content = edited(
        Path(robot.name).read_bytes(),
        {robot.joint_names[j]: inertial(found.inertial[10 * j : 10 * j + 10]) for j in parts},
        {robot.joint_names[j]: dynamics(found, j) for j in parts},
    )
    for words_ in _mount(robot):
        before, end, behind = content.rpartition(b"</robot>")
        content = before + f"<!-- {plain(words_)} -->\n".encode() + end + behind
    return content


def _mount(robot: RobotModel) -> tuple[str, ...]:
    """Return a note on the mounting of the arm, which URDF cannot represent; empty if upright."""
    if np.allclose(robot.gravity_vector, GRAVITY, atol=1e-9):
        return ()
    x, y, z = (float(one) for one in robot.gravity_vector)
    told = f"({x:.6g}, {y:.6g}, {z:.6g}) m/s2"
    return (f"URDF does not contain gravity: set {told} in the base frame after loading",)


def _notes(robot: RobotModel, found: IdentifiedParameters, own: bool) -> tuple[str, ...]:
    notes = [*found.notes, *_mount(robot)]
    if np.any(found.inertial[10 * robot.n :] > 0):
        notes.append(
            "rotor inertias are in armature=…, which is not part of URDF: hil reads it, "
            "most other programs do not"
        )
    if not np.all(robot.joint_geometry().turns):
        notes.append("for prismatic joints, torques are forces [N] and damping is in N·s/m")
    if own:
        notes.append("mesh paths are unchanged: keep the file in the folder of the original")
    return tuple(notes)


UNLIMITED = 1e9
"""Effort and speed for joints with unknown limits, because URDF cannot represent infinity."""


def written(robot: RobotModel, found: IdentifiedParameters, comment: str) -> str:
    """Return a new URDF for a robot that is not defined by a URDF."""
    geometry = robot.joint_geometry()
    links = ["base_link", *(_link_name(name) for name in robot.joint_names)]
    lines = ['<?xml version="1.0"?>', f"<!-- {plain(comment)} -->"]
    lines += [f"<robot name={quoteattr(robot.name)}>", f"  <link name={quoteattr(links[0])}/>"]
    pose = np.eye(4)
    for j, joint in enumerate(robot.joint_names):
        body = found.inertial[10 * j : 10 * j + 10]
        lines += [
            f"  <link name={quoteattr(links[j + 1])}>",
            f"    {inertial(body)}",
            "  </link>",
            f'  <joint name={quoteattr(joint)} type="{_kind(robot, j, bool(geometry.turns[j]))}">',
            f"    {_origin(geometry.placement[j])}",
            f"    <parent link={quoteattr(links[j])}/>",
            f"    <child link={quoteattr(links[j + 1])}/>",
            f'    <axis xyz="{_numbers(geometry.axis[j])}"/>',
            f"    {_limit(robot, j)}",
            f"    {dynamics(found, j)}",
            "  </joint>",
        ]
        pose = pose @ geometry.placement[j]
    flange = np.linalg.solve(pose, robot.flange_pose(np.zeros((1, robot.n)))[0])
    return "\n".join([*lines, *_flange(links[-1], flange), "</robot>", ""])


def _link_name(joint: str) -> str:
    return joint.removesuffix("_joint") + "_link"


def _kind(robot: RobotModel, j: int, turns: bool) -> str:
    if not turns:
        return "prismatic"
    limited = np.isfinite(robot.q_min[j]) and np.isfinite(robot.q_max[j])
    return "revolute" if limited else "continuous"


def _origin(pose: FloatArray) -> str:
    angles = np.array(roll_pitch_yaw(pose[:3, :3]))
    return f'<origin xyz="{_numbers(pose[:3, 3])}" rpy="{_numbers(angles)}"/>'


def _numbers(values: FloatArray) -> str:
    return " ".join(_number(value) for value in values)


def _number(value: float) -> str:
    """Return the shortest text from which the same number is read."""
    return repr(float(value) + 0.0)


def _limit(robot: RobotModel, j: int) -> str:
    ends = (robot.q_min[j], robot.q_max[j])
    limited = all(math.isfinite(end) for end in ends)
    told = f'lower="{_number(ends[0])}" upper="{_number(ends[1])}" ' if limited else ""
    effort, speed = (
        float(values[j]) if math.isfinite(values[j]) else UNLIMITED
        for values in (robot.effort_max, robot.qd_max)
    )
    return f'<limit {told}effort="{_number(effort)}" velocity="{_number(speed)}"/>'


def _flange(parent: str, pose: FloatArray) -> Iterator[str]:
    yield '  <link name="flange"/>'
    yield '  <joint name="flange_fixed" type="fixed">'
    yield f"    {_origin(pose)}"
    yield f"    <parent link={quoteattr(parent)}/>"
    yield '    <child link="flange"/>'
    yield "  </joint>"


def inertial(body: FloatArray) -> str:
    """Return the element `<inertial>` for ten parameters about the origin of the link."""
    m, com, I = about_centre(body)  # noqa: E741
    names = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2))
    told = " ".join(f'{name}="{_number(I[i, j])}"' for name, i, j in (*names, ("izz", 2, 2)))
    return (
        f'<inertial><origin xyz="{_numbers(com)}" rpy="0 0 0"/><mass value="{_number(m)}"/>'
        f"<inertia {told}/></inertial>"
    )


def dynamics(found: IdentifiedParameters, j: int) -> str:
    """Return the element `<dynamics>` of joint j.

    The attribute `armature` is not part of URDF, and most readers ignore it.
    """
    rotor = found.inertial[10 * len(found.coulomb) + j]
    return (
        f'<dynamics damping="{_number(found.viscous[j])}" friction="{_number(found.coulomb[j])}" '
        f'armature="{_number(rotor)}"/>'
    )


def roll_pitch_yaw(R: FloatArray) -> tuple[float, float, float]:
    """Return angles [rad] with R = Rz(yaw) Ry(pitch) Rx(roll).

    The yaw angle is 0 if the pitch angle is ±90°.
    """
    across = math.hypot(R[0, 0], R[1, 0])
    pitch = math.atan2(-R[2, 0], across)
    if across < 1e-9:
        return math.atan2(-R[1, 2], R[1, 1]), pitch, 0.0
    return math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])


def plain(text: str) -> str:
    """Return text that is permitted in an XML comment."""
    return text.replace("--", "- -")


MOVING = ("revolute", "continuous", "prismatic")


class Edit(NamedTuple):
    """Edit of the URDF: replacement of the bytes from `start` to `end`."""

    start: int
    end: int
    text: str


@dataclass(slots=True)
class Element:
    """Position of a link or joint element in the file, in bytes.

    Attributes:
        start: Position of the first byte of the start tag.
        inside: Position of the first byte after the start tag.
        last: Position of the first byte of the end tag, or of the element if it has no end tag.
        empty: Whether the element consists of a single tag.
        parts: Start and end of the `<inertial>` or `<dynamics>` element within the link or joint.
    """

    start: int
    inside: int
    last: int = -1
    empty: bool = False
    parts: dict[str, tuple[int, int]] = field(default_factory=dict)


def edited(raw: bytes, inertials: Mapping[str, str], dynamics: Mapping[str, str]) -> bytes:
    """Return a URDF with new inertias and joint dynamics.

    Args:
        raw: Content of the URDF, which must describe a serial arm.
        inertials: Mapping from each moving joint to the element `<inertial>` of the body that it
            moves. The element `<inertial>` is written into the child link of the joint. Links that
            are fixed to the child link lose their element `<inertial>`, because the body includes
            them.
        dynamics: Mapping from each moving joint to its element `<dynamics>`.
    """
    links, joints = _found(raw)
    edits: list[Edit] = []
    for joint, (child, fixed) in bodies(raw).items():
        edits += _put(raw, links[child], "inertial", inertials[joint])
        edits += _put(raw, joints[joint], "dynamics", dynamics[joint])
        for name in fixed:
            where = links[name].parts.get("inertial")
            if where is not None:
                edits.append(Edit(*where, f'<!-- inertial: part of link "{child}" -->'))
    for edit in sorted(edits, reverse=True):
        raw = raw[: edit.start] + edit.text.encode() + raw[edit.end :]
    return raw


def _found(raw: bytes) -> tuple[dict[str, Element], dict[str, Element]]:
    """Return links and joints by name, with their positions in the file."""
    found: dict[str, dict[str, Element]] = {"link": {}, "joint": {}}
    path: list[tuple[str, int]] = []
    current: list[Element] = []
    parser = expat.ParserCreate()

    def begin(tag: str, attributes: dict[str, str]) -> None:
        start = parser.CurrentByteIndex
        path.append((tag, start))
        if len(path) == 2 and tag in found:
            current.append(Element(start, _tag_end(raw, start)))
            found[tag][attributes.get("name", "")] = current[-1]

    def end(tag: str) -> None:
        _, start = path.pop()
        inside = _tag_end(raw, start)
        empty = raw[inside - 2 : inside] == b"/>"
        # For a self-closing tag, expat reports the end after the tag.
        last = start if empty else parser.CurrentByteIndex
        if len(path) == 2 and tag in ("inertial", "dynamics") and path[1][0] in found:
            current[-1].parts[tag] = (start, _tag_end(raw, last))
        elif len(path) == 1 and tag in found:
            current[-1].last, current[-1].empty = last, empty

    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.Parse(raw, True)
    return found["link"], found["joint"]


def _tag_end(raw: bytes, start: int) -> int:
    """Return the position after the tag that begins at `start`; quoted text may contain `>`."""
    quote = 0
    for at in range(start, len(raw)):
        byte = raw[at]
        if quote:
            quote = 0 if byte == quote else quote
        elif byte in b"\"'":
            quote = byte
        elif byte == ord(">"):
            return at + 1
    return len(raw)


def _put(raw: bytes, element: Element, part: str, text: str) -> Iterator[Edit]:
    """Yield the edit that replaces or adds a part of an element."""
    if part in element.parts:
        yield Edit(*element.parts[part], text)
    elif element.empty:
        tag = raw[element.start : element.inside].decode()
        name = tag[1:].split(None, 1)[0]
        yield Edit(element.start, element.inside, f"{tag[:-2].rstrip()}>\n    {text}\n  </{name}>")
    else:
        yield Edit(element.last, element.last, f"  {text}\n  ")


def bodies(raw: bytes) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Return, for each moving joint, its child link and the links that are fixed to the child."""
    root = ET.fromstring(raw)  # noqa: S314  a file of the user's own bench
    joints = root.findall("joint")
    carried: dict[str, list[str]] = {}
    for joint in joints:
        if joint.get("type") == "fixed":
            carried.setdefault(_end(joint, "parent"), []).append(_end(joint, "child"))
    moving = [joint for joint in joints if joint.get("type") in MOVING]
    children = {str(joint.get("name")): _end(joint, "child") for joint in moving}
    return {name: (child, tuple(_fixed_to(child, carried))) for name, child in children.items()}


def _end(joint: ET.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else str(element.get("link"))


def _fixed_to(link: str, carried: Mapping[str, list[str]]) -> Iterator[str]:
    for name in carried.get(link, ()):
        yield name
        yield from _fixed_to(name, carried)


EXACT = 1e-9
"""Largest permitted torque error if the links have the model's parameters, as a share.

The reference for the share is the largest torque of the joint.
"""

NEAR = 0.05
"""Largest permitted error of links that approximate the model, and of avoidable friction error."""

HZ = 100.0


def missed(path: Path, model: RobotEstimator) -> Miss:
    """Return the errors of the file relative to `model.predict`, after reading the file back."""
    robot = model.robot_
    again = RobotModel.from_urdf(
        path, gravity=robot.gravity_vector.tolist(), flange=str(robot.to_dict()["flange"])
    )
    q, qd, qdd = motion(robot, SAMPLES, RATE_HZ)
    gravity, whole = rigid_asked(model, (q, qd, qdd))
    still = np.zeros_like(q)
    rigid = np.maximum(
        share(again.inverse_dynamics(q, still, still), gravity, gravity, whole),
        share(again.inverse_dynamics(q, qd, qdd), whole, gravity, whole),
    )
    friction, avoidable = _friction_missed(path, model)
    return Miss(rigid, friction, avoidable)


def _friction_missed(path: Path, model: RobotEstimator) -> tuple[FloatArray, FloatArray]:
    qd, wanted = friction_asked(model, HZ)
    sign = np.tanh(qd / SIGN_WIDTH)
    coulomb, viscous = _dynamics(path, model.joint_names_)
    largest = scale_of(wanted)
    left, least = np.empty((2, len(coulomb)))
    for j in range(len(coulomb)):
        # URDF cannot represent a constant, so the standard deviation ignores it.
        rest = wanted[:, j] - coulomb[j] * sign[:, j] - viscous[j] * qd[:, j]
        left[j] = np.std(rest) / largest[j]
        terms = np.column_stack([sign[:, j], qd[:, j], np.ones(len(qd))])
        best = np.linalg.lstsq(terms, wanted[:, j], rcond=None)[0]
        best[:2] = np.maximum(best[:2], 0.0)
        least[j] = np.std(wanted[:, j] - terms @ best) / largest[j]
    return left, left - least


def _dynamics(path: Path, names: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """Return the attributes `friction` and `damping` (n,) as they are in the file."""
    joints = {one.get("name"): one for one in ET.parse(path).getroot().findall("joint")}  # noqa: S314
    told = [joints[name].find("dynamics") for name in names]
    return tuple(  # type: ignore[return-value]
        np.array([np.nan if one is None else float(one.get(word, "nan")) for one in told])
        for word in ("friction", "damping")
    )


def share(found: FloatArray, wanted: FloatArray, *of: FloatArray) -> FloatArray:
    """Return the largest difference (n,), as a share of each joint's largest value.

    A NaN among the values counts as an infinite difference.
    """
    off: FloatArray = np.abs(found - wanted).max(axis=0) / scale_of(*of)
    return np.where(np.isnan(off), np.inf, off)


def require_near(miss: Miss, found: IdentifiedParameters, names: tuple[str, ...]) -> None:
    """Raise if the file deviates from the model by more than the permitted error.

    Raises:
        FitError: Links with the model's parameters do not reproduce the model's torques, other
            links deviate by more than `NEAR`, or a better approximation of the friction exists.
    """
    if found.exact and not np.all(miss.rigid <= EXACT):
        raise FitError(
            "gravity and inertia of the URDF, read back, differ from the model's by "
            f"{miss.rigid.max():.1g} of a joint's largest torque",
            hint=FAULT,
        )
    if not np.all(miss.avoidable <= NEAR):
        raise FitError(
            "friction and damping of the URDF, read back, are not the best approximation of the "
            f"model's: difference {miss.friction.max():.1g} of a joint's largest friction",
            hint=FAULT,
        )
    if not np.all(miss.rigid <= NEAR):
        far = ", ".join(
            f"{name} {one:.0%}" for name, one in zip(names, miss.rigid, strict=True) if one > NEAR
        )
        raise FitError(
            "no physically consistent links reproduce the model's gravity and inertia; largest "
            f"errors as shares of the joint's largest torque: {far}",
            hint="fit rigid-lmi or rigid-hysteresis, whose links are physically consistent, or "
            "write these links with --no-check",
        )


def words(miss: Miss, found: IdentifiedParameters) -> str:
    """Return a text about the agreement with the model, with one value per inexact joint."""
    if found.exact:
        rigid = f"largest difference {miss.rigid.max():.1e}"
    else:
        rigid = f"error {_percent(miss.rigid)}"
    return (
        f"read back and compared with the model: gravity and inertia: {rigid} of each joint's "
        f"largest torque; friction: error {_percent(miss.friction)} of its largest"
    )


def _percent(shares: FloatArray) -> str:
    return ", ".join(f"{100 * one:.1f}" for one in shares) + " %"
