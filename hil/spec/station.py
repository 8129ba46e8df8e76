"""What a station YAML may say: the robots of this bench and what stands around them."""

from __future__ import annotations

from datetime import date
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from hil.core import json_text, name_text
from hil.spec.field_types import (
    Finite,
    FormatVersion,
    Name,
    NonNegative,
    Positive,
    Strict,
    Vector3,
    mistake,
)


def _has_a_direction(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(vector):
        raise mistake("must point somewhere; it is all zeros")
    return vector


class Wall(Strict):
    """A plane the arm must stay in front of."""

    name: str = Field("wall", description="Shown when something comes too close.")
    point_m: Vector3 = Field(description="Any point of the plane, in the robot's base frame.")
    normal: Annotated[Vector3, AfterValidator(_has_a_direction)] = Field(
        description="Points to the side where the arm may be; its length does not matter."
    )


class Box(Strict):
    """An axis-aligned obstacle in the robot's base frame."""

    name: str = Field("box", description="Shown when something comes too close.")
    centre_m: Vector3 = Field(description="Its centre, in the robot's base frame.")
    size_m: tuple[Positive, Positive, Positive] = Field(description="Full lengths along x, y, z.")


class Surroundings(Strict):
    """What stands around a robot, in its base frame."""

    table_z_m: Finite | None = Field(0.0, description="Height of the table top; null for none.")
    walls: tuple[Wall, ...] = Field((), description="Planes the arm must stay in front of.")
    boxes: tuple[Box, ...] = Field((), description="Obstacles the arm must stay out of.")
    clearance_m: NonNegative = Field(0.02, description="Least distance kept to everything.")


class StationRobot(Strict):
    """One robot of the bench."""

    driver: str = Field(
        description="Name under `hil.drivers`: `mock`, or what `hil plugins` lists."
    )
    model: str = Field(
        description="A built-in arm (`ur5`), or a path to a description of an arm "
        "(`hil new own-urdf`) or to a URDF; a relative path starts at the folder of the station."
    )
    options: dict[str, Any] = Field({}, description="The driver's own options.")
    own_process: bool = Field(
        False,
        description="Run the driver in a process of its own, which stops the arm when `hil` dies "
        "and keeps a driver that hangs from hanging `hil`; Linux only.",
    )
    in_service: date | None = Field(
        None, description="Day it went into service (2021-03-01), for its age in reports of fleets."
    )
    surroundings: Surroundings = Field(
        Surroundings(), description="What the arm must not touch; by default a table at its base."
    )
    checklist: tuple[Annotated[str, Field(min_length=1)], ...] = Field(
        (),
        description="Conditions to check before this robot moves; shown with every confirmation "
        "of a motion, and recorded with the answer.",
    )
    gravity_m_s2: Vector3 = Field(
        (0.0, 0.0, -9.81), description="Gravity in the base frame: says how the arm is mounted."
    )


class Station(Strict):
    """A bench: its robots by name."""

    hil_station: FormatVersion = Field(description="Version of the station format.")
    name: Name = Field("bench", description="Which bench this is; stored with every run.")
    robots: dict[Name, StationRobot] = Field(
        min_length=1, description="The robots by the names that experiments use."
    )

    def as_text(self, title: str) -> str:
        """Return its file, as it is copied into a run directory.

        Args:
            title: Where it comes from, in the first line.
        """
        return f"# {name_text(title)}\n{json_text(self.model_dump(mode='json'), indent=1)}\n"
