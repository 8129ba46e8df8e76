"""Read a URDF and say what is wrong with it before Pinocchio, which says little, sees it."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from hil.core import SpecError, neighbour_of, no_file

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


def _end(joint: ET.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else str(element.get("link"))


def _numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split()] or [math.nan]
    except ValueError:
        return [math.nan]


def _first(element: ET.Element, attribute: str) -> float:
    return _numbers(element.get(attribute, "0"))[0]
