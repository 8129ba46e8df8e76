"""What about a declared load contradicts the identified one, by its name."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray

Kind = Literal["mass", "centre", "mount", "inertia", "no body"]

TURNED_RAD = np.radians(45.0)
"""A centre that is turned about the flange's axis by as much is a tool mounted the wrong way."""

SLACK = 1e-9
"""Share of an inertia by which rounding may take it out of what bodies can have."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One contradiction.

    Attributes:
        kind: What is wrong: the mass, the centre of mass, the angle of the mount, the inertia, or
            that no body has such an inertia.
        text: The same with figures, for people.
    """

    kind: Kind
    text: str


def findings(declared: Payload, found: FloatArray, limit: FloatArray) -> tuple[Finding, ...]:
    """What contradicts a declaration.

    Args:
        declared: The load.
        found: (10,) identified, in the order of `PayloadEstimate.values`.
        limit: (10,) how far off each may be.
    """
    return tuple(_findings(declared, found, limit))


def mount_observable(declared: Payload, limit: FloatArray) -> bool:
    """Whether half a turn about the flange's axis would move the centre by more than its limit."""
    x, y, _ = (abs(value) for value in declared.com)
    return bool(not declared.is_empty and (2 * x > limit[1] or 2 * y > limit[2]))


def _findings(declared: Payload, found: FloatArray, limit: FloatArray) -> Iterator[Finding]:
    more = found[0] - declared.mass
    if abs(more) > limit[0]:
        told = f"{abs(more):.2f} kg {'heavier' if more > 0 else 'lighter'} than declared"
        yield Finding("mass", f"{told} (±{limit[0]:.2f} kg)")
    if declared.is_empty:
        return  # the centre of nothing is nowhere
    turn = 0.0
    com, reach = np.array(declared.com), limit[1:4]
    if np.any(np.abs(found[1:4] - com) > reach):
        turn = _turn(com, found[1:4], reach)
        yield _centre(com, found[1:4], turn)
    yield from _inertia(_matrix(np.array(declared.inertia)), turn, found[4:], limit[4:])


def _centre(com: FloatArray, found: FloatArray, turn: float) -> Finding:
    distance = 1e3 * float(np.linalg.norm(found - com))
    if turn:
        return Finding("mount", f"turned by {np.degrees(turn):.0f}° about the flange's axis")
    by = ", ".join(f"{1e3 * value:+.0f}" for value in found - com)
    return Finding("centre", f"centre of mass {distance:.0f} mm off: by ({by}) mm")


def _turn(com: FloatArray, found: FloatArray, reach: FloatArray) -> float:
    """Angle about z that explains where the centre was found [rad]; 0 when none does."""
    angle = np.arctan2(found[1], found[0]) - np.arctan2(com[1], com[0])
    angle = float((angle + np.pi) % (2 * np.pi) - np.pi)
    explained = np.all(np.abs(_about_z(angle) @ com - found) <= reach)
    return angle if explained and abs(angle) >= TURNED_RAD else 0.0


def _inertia(
    declared: FloatArray, turn: float, found: FloatArray, limit: FloatArray
) -> Iterator[Finding]:
    if not np.any(declared):
        return  # nobody declared one
    half = 0.5 * float(np.trace(declared))
    if np.linalg.eigvalsh(half * np.eye(3) - declared)[0] < -SLACK * max(abs(half), 1e-300):
        yield Finding("no body", "no body has the inertia declared")
        return
    R = _about_z(turn)
    turned = R @ declared @ R.T
    off = found - turned[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    worst = int(np.argmax(np.abs(off) / limit))
    if abs(off[worst]) > limit[worst]:
        name = ("Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")[worst]
        told = f"{name} {abs(off[worst]):.3g} kg·m² {'more' if off[worst] > 0 else 'less'}"
        yield Finding("inertia", f"{told} than declared (±{limit[worst]:.2g} kg·m²)")


def _about_z(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _matrix(six: FloatArray) -> FloatArray:
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
