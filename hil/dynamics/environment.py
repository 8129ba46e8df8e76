"""What an arm may run into besides itself, in the frame of its base."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.arms import Capsule, Payload
from hil.core import FloatArray

Vector = tuple[float, float, float]

PAYLOAD_DENSITY = 2700.0
"""kg/m³, aluminium: real loads are mostly denser, so a body sized with it is rather too large."""

PAYLOAD_RADIUS_MIN = 0.03
"""[m]"""


@dataclass(frozen=True, slots=True)
class Plane:
    """A half-space the arm must stay in.

    Attributes:
        point: Any point of the plane [m].
        normal: Points to the side where the arm may be; its length does not matter.
        name: For messages.
    """

    point: Vector
    normal: Vector
    name: str = "wall"

    @property
    def unit_normal(self) -> FloatArray:
        """(3,) normal of length 1."""
        normal = np.array(self.normal, dtype=np.float64)
        return np.asarray(normal / np.linalg.norm(normal))


@dataclass(frozen=True, slots=True)
class Box:
    """A solid box along the axes of the base frame.

    Attributes:
        centre: [m].
        size: Full edge lengths [m].
        name: For messages.
    """

    centre: Vector
    size: Vector
    name: str = "box"

    @property
    def corners(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner, each (3,) [m]."""
        centre, half = np.array(self.centre, dtype=np.float64), 0.5 * np.array(self.size)
        return centre - half, centre + half


@dataclass(frozen=True, slots=True)
class Environment:
    """Everything around the arm.

    Attributes:
        table_z: Height of the table the base stands on [m], None when there is none.
        walls: Planes the arm must stay in front of.
        boxes: Obstacles the arm must stay out of.
    """

    table_z: float | None = None
    walls: tuple[Plane, ...] = ()
    boxes: tuple[Box, ...] = ()

    @property
    def table(self) -> Plane | None:
        """The table as a plane."""
        if self.table_z is None:
            return None
        return Plane((0.0, 0.0, self.table_z), (0.0, 0.0, 1.0), "table")


def payload_capsule(payload: Payload, link: int, radius: float | None = None) -> Capsule | None:
    """A body for a load of which only mass and centre of mass are known; None without a load.

    It reaches from the flange through the centre of mass and as far again behind it, with the
    radius of an aluminium bar of that length and mass, at least 3 cm.

    Args:
        payload: The load.
        link: Number of the last link, n.
        radius: The true radius [m], where it is known.
    """
    if payload.is_empty:
        return None
    com = np.array(payload.com)
    length = 2.0 * float(np.linalg.norm(com))
    sized = max(_bar_radius(payload.mass, length), PAYLOAD_RADIUS_MIN)
    x, y, z = (float(2.0 * c) for c in com)
    return Capsule(link, (0.0, 0.0, 0.0), (x, y, z), sized if radius is None else radius)


def _bar_radius(mass: float, length: float) -> float:
    """Radius [m] of a bar of that length, or of a ball where that is smaller."""
    volume = mass / PAYLOAD_DENSITY
    ball = float(np.cbrt(0.75 * volume / np.pi))
    return ball if length == 0.0 else min(ball, float(np.sqrt(volume / (np.pi * length))))
