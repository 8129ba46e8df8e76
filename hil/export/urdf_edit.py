"""Another's URDF with other inertias: only what changes is touched, byte for byte.

An XML library would write the file anew and lose its layout, comments and entities. So expat is
asked where the elements are, and the bytes between are kept.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple
from xml.parsers import expat

MOVING = ("revolute", "continuous", "prismatic")


class Edit(NamedTuple):
    """Bytes `start` to `end` are replaced."""

    start: int
    end: int
    text: str


@dataclass(slots=True)
class Element:
    """Where a link or joint of the robot stands.

    Attributes:
        start: Of its tag.
        inside: First byte behind its start tag.
        last: First byte of its end tag, or of the tag itself where it has none.
        empty: Whether it is one tag alone.
        parts: Start and end of its `<inertial>` or `<dynamics>`.
    """

    start: int
    inside: int
    last: int = -1
    empty: bool = False
    parts: dict[str, tuple[int, int]] = field(default_factory=dict)


def edited(raw: bytes, inertials: Mapping[str, str], dynamics: Mapping[str, str]) -> bytes:
    """A URDF with other inertias and joint dynamics.

    Args:
        raw: The file; known to be a serial arm.
        inertials: Moving joint → `<inertial>` of the body behind it. It goes into the joint's
            child; links fixed to that lose theirs, which it contains.
        dynamics: Moving joint → its `<dynamics>`.
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


def bodies(raw: bytes) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Moving joint → its child link, and the links fixed to that."""
    root = ET.fromstring(raw)  # noqa: S314  a file of the user's own bench
    joints = root.findall("joint")
    carried: dict[str, list[str]] = {}
    for joint in joints:
        if joint.get("type") == "fixed":
            carried.setdefault(_end(joint, "parent"), []).append(_end(joint, "child"))
    moving = [joint for joint in joints if joint.get("type") in MOVING]
    children = {str(joint.get("name")): _end(joint, "child") for joint in moving}
    return {name: (child, tuple(_fixed_to(child, carried))) for name, child in children.items()}


def _fixed_to(link: str, carried: Mapping[str, list[str]]) -> Iterator[str]:
    for name in carried.get(link, ()):
        yield name
        yield from _fixed_to(name, carried)


def _end(joint: ET.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else str(element.get("link"))


def _put(raw: bytes, element: Element, part: str, text: str) -> Iterator[Edit]:
    """The edit that gives an element this part, instead of the one it has or as a new one."""
    if part in element.parts:
        yield Edit(*element.parts[part], text)
    elif element.empty:
        tag = raw[element.start : element.inside].decode()
        name = tag[1:].split(None, 1)[0]
        yield Edit(element.start, element.inside, f"{tag[:-2].rstrip()}>\n    {text}\n  </{name}>")
    else:
        yield Edit(element.last, element.last, f"  {text}\n  ")


def _found(raw: bytes) -> tuple[dict[str, Element], dict[str, Element]]:
    """Links and joints by name, with where they stand."""
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
        # Of a tag that ends itself, expat says the end is behind it.
        last = start if empty else parser.CurrentByteIndex
        if len(path) == 2 and tag in ("inertial", "dynamics") and path[1][0] in found:
            current[-1].parts[tag] = (start, _tag_end(raw, last))
        elif len(path) == 1 and tag in found:
            current[-1].last, current[-1].empty = last, empty

    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.Parse(raw, True)
    return found["link"], found["joint"]


def _tag_end(raw: bytes, start: int) -> int:
    """First byte behind the tag that begins at `start`; quotes may hold a `>`."""
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
