"""Payload of an arm: a rigid body at the flange, declared or identified."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeAlias

from hil.core import SpecError

MASS_TOLERANCE_KG = 0.01
COM_TOLERANCE_M = 0.005


@dataclass(frozen=True, slots=True)
class Payload:
    """Rigid body fixed to the flange.

    Attributes:
        mass: Mass [kg], ≥ 0.
        com: Position of the centre of mass in the flange frame [m].
        inertia: Inertia (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) about the centre of mass, in flange axes
            [kg·m²].
    """

    mass: float = 0.0
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    inertia: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def agrees_with(self, other: Payload) -> bool:
        """Return whether a payload read from a controller equals this one, except for rounding."""
        if abs(self.mass - other.mass) > MASS_TOLERANCE_KG:
            return False
        # The centre of mass of an empty payload is undefined and not compared.
        return self.is_empty or all(
            abs(a - b) <= COM_TOLERANCE_M for a, b in zip(self.com, other.com, strict=True)
        )

    def __str__(self) -> str:
        x, y, z = self.com
        return f"{self.mass:.3f} kg at ({x:.3f}, {y:.3f}, {z:.3f}) m"

    @property
    def is_empty(self) -> bool:
        """Whether the payload is empty, i.e. no payload is mounted."""
        return self.mass == 0.0


AnyPayload: TypeAlias = str | float | Payload
"""Forms of a payload: text `MASS` or `MASS,X,Y,Z` [kg, m], mass [kg], or `Payload`."""


def payload_of(given: AnyPayload | None) -> Payload | None:
    """Return the payload that an argument of a public function describes.

    A number or text with only a mass describes a payload whose centre of mass is at the origin of
    the flange.

    Returns:
        Payload; None for the argument None, and an empty payload for 0.

    Raises:
        SpecError: The argument is not a valid payload.
    """
    if given is None:
        return None
    if isinstance(given, Payload):
        read = parse_payload(",".join(f"{number}" for number in (given.mass, *given.com)))
        return replace(read, inertia=given.inertia)
    return parse_payload(f"{given}")


def parse_payload(text: str) -> Payload:
    """Return the payload of the text `MASS` or `MASS,X,Y,Z`, in kg and m.

    Raises:
        SpecError: The text has neither of the forms `MASS` and `MASS,X,Y,Z`.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except (ValueError, AttributeError):
        numbers = []
    if len(numbers) not in (1, 4) or not all(map(math.isfinite, numbers)) or numbers[0] < 0:
        raise SpecError(
            f"the payload {text!r} is neither MASS nor MASS,X,Y,Z",
            hint="for example: 2.8 or 2.8,0,0,0.05 (kg and m, in the flange frame)",
        )
    x, y, z = numbers[1:] or (0.0, 0.0, 0.0)
    return Payload(numbers[0], (x, y, z))
