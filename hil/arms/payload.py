"""A load at the flange: what was mounted, or what was identified."""

from __future__ import annotations

from dataclasses import dataclass

MASS_TOLERANCE_KG = 0.01
COM_TOLERANCE_M = 0.005


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

    def agrees_with(self, other: Payload) -> bool:
        """Whether a read-back is what was declared, within what controllers round to."""
        if abs(self.mass - other.mass) > MASS_TOLERANCE_KG:
            return False
        # The centre of mass of nothing is nowhere in particular.
        return self.is_empty or all(
            abs(a - b) <= COM_TOLERANCE_M for a, b in zip(self.com, other.com, strict=True)
        )

    def __str__(self) -> str:
        x, y, z = self.com
        return f"{self.mass:.3f} kg at ({x:.3f}, {y:.3f}, {z:.3f}) m"

    @property
    def is_empty(self) -> bool:
        """True when nothing is mounted."""
        return self.mass == 0.0
