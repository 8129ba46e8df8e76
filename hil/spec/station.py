"""Model of a station YAML file: the robots of a bench and their surroundings."""

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
        raise mistake("must not be the zero vector")
    return vector


class Wall(Strict):
    """Plane that the arm must not cross."""

    name: str = Field("wall", description="Name of the plane, used in messages.")
    point_m: Vector3 = Field(description="Any point of the plane, in the robot's base frame.")
    normal: Annotated[Vector3, AfterValidator(_has_a_direction)] = Field(
        description="Normal vector that points to the side of the arm; its length has no effect."
    )


class Box(Strict):
    """Axis-aligned obstacle in the robot's base frame."""

    name: str = Field("box", description="Name of the box, used in messages.")
    centre_m: Vector3 = Field(description="Centre of the box, in the robot's base frame.")
    size_m: tuple[Positive, Positive, Positive] = Field(description="Full lengths along x, y, z.")


class Surroundings(Strict):
    """Obstacles around a robot, in its base frame."""

    table_z_m: Finite | None = Field(
        0.0, description="Height of the table top; null if there is no table."
    )
    walls: tuple[Wall, ...] = Field((), description="Planes that the arm must not cross.")
    boxes: tuple[Box, ...] = Field((), description="Obstacles that the arm must not touch.")
    clearance_m: NonNegative = Field(
        0.02, description="Minimum distance of the arm to its surroundings and to itself."
    )


class StationRobot(Strict):
    """Robot of a station."""

    driver: str = Field(
        description="Name of the driver (entry point in `hil.drivers`): `mock`, or a driver that "
        "`hil plugins` lists."
    )
    model: str = Field(
        description="Name of a built-in arm (`ur5`), or path of an arm description (`hil new "
        "own-urdf`) or of a URDF; a relative path starts at the folder of the station."
    )
    options: dict[str, Any] = Field({}, description="Options of the driver.")
    own_process: bool = Field(
        False,
        description="Run the driver in a separate process, which stops the arm if `hil` dies, "
        "and which keeps a hanging driver from blocking `hil`; Linux only.",
    )
    in_service: date | None = Field(
        None,
        description="Date on which the robot was put into service, such as 2021-03-01; fleet "
        "reports compute its age from it.",
    )
    surroundings: Surroundings = Field(
        Surroundings(), description="Obstacles around the robot; by default a table at its base."
    )
    checklist: tuple[Annotated[str, Field(min_length=1)], ...] = Field(
        (),
        description="Conditions to check before this robot moves; shown with every confirmation "
        "of a motion, and recorded with the answer.",
    )
    gravity_m_s2: Vector3 = Field(
        (0.0, 0.0, -9.81),
        description="Gravity vector in the base frame; it describes how the arm is mounted.",
    )


class Station(Strict):
    """Bench with its robots, by name."""

    hil_station: FormatVersion = Field(description="Version of the station format.")
    name: Name = Field("bench", description="Name of the bench; stored with every run.")
    robots: dict[Name, StationRobot] = Field(
        min_length=1, description="Robots, by the names that experiments use."
    )

    def as_text(self, title: str) -> str:
        """Return the text of the station file for the copy in a run directory.

        Args:
            title: Text about the origin of the station, written in the first line.
        """
        return f"# {name_text(title)}\n{json_text(self.model_dump(mode='json'), indent=1)}\n"
