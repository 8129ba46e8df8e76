"""A load at the flange: what was mounted, or what was identified."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Payload:
    """A rigid body fixed to the flange.

    Attributes:
        mass: Mass [kg], ≥ 0.
        com: Centre of mass in the flange frame [m].
        inertia: (Ixx, Iyy, Izz, Ixy, Ixz, Iyz) about the centre of mass in flange axes [kg·m²].
    """

    mass: float = 0.0
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    inertia: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def is_empty(self) -> bool:
        """True when nothing is mounted."""
        return self.mass == 0.0
