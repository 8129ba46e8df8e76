"""What may be mounted at the flange, and whether such a body can exist."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from hil.arms import Payload
from hil.spec.field_types import IS_NUMBER, Finite, NonNegative, Strict, mistake

# What is longer than ten metres is a slip of the unit, and no flange carries it.
Lever = Annotated[float, Field(ge=-10, le=10), IS_NUMBER]
Extent = Annotated[float, Field(gt=0, le=10), IS_NUMBER]


def _is_inertia_of_a_body(inertia: tuple[float, ...]) -> bool:
    """True when the second moments of mass tr(I)/2·1 − I are positive semidefinite.

    That holds exactly if the principal moments satisfy the triangle inequality (Traversaro et
    al., 'Identification of fully physical consistent inertial parameters', IROS 2016).
    """
    xx, yy, zz, xy, xz, yz = inertia
    half = (xx + yy + zz) / 2
    a, b, c, d, e, f = half - xx, half - yy, half - zz, -xy, -xz, -yz
    minors = (a, b, c, a * b - d * d, a * c - e * e, b * c - f * f)
    determinant = a * (b * c - f * f) - d * (d * c - e * f) + e * (d * f - b * e)
    slack = 1e-9 * max(abs(half), 1e-300)
    sizes = (1, 1, 1, half, half, half, half * half)
    return all(
        m >= -slack * abs(size) for m, size in zip((*minors, determinant), sizes, strict=True)
    )


class Load(Strict):
    """A body mounted at the flange for one pass of the excitation."""

    mass_kg: NonNegative = Field(0.0, description="Mass; 0 is the bare flange.")
    com_m: tuple[Lever, Lever, Lever] = Field(
        (0.0, 0.0, 0.0), description="Centre of mass in the flange frame."
    )
    inertia_kgm2: tuple[Finite, Finite, Finite, Finite, Finite, Finite] = Field(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        description="Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of mass, flange axes.",
    )
    size_m: tuple[Extent, Extent] | None = Field(
        None,
        description="Length and radius of the payload's body along the flange axis, for collision "
        "checks; a body is assumed from the mass when this is absent.",
    )
    prompt: str = Field("", description="What the operator is asked to do before this load.")

    def payload(self) -> Payload:
        """The same load as the robot and the estimators see it."""
        return Payload(self.mass_kg, self.com_m, self.inertia_kgm2)

    @model_validator(mode="after")
    def _inertia_belongs_to_a_body(self) -> Load:
        if not _is_inertia_of_a_body(self.inertia_kgm2):
            raise mistake(
                "no body has this inertia: each principal moment must be ≥ 0 and at most the sum "
                "of the other two (the order is Ixx, Iyy, Izz, Ixy, Ixz, Iyz)",
                "inertia_kgm2",
            )
        return self
