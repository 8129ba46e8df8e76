"""What a station YAML may say: the robots of this bench and what stands around them."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from hil.spec.experiment import Finite, Name, NonNegative, Positive, Strict, Vector3


class Wall(Strict):
    """A plane the arm must stay in front of."""

    name: str = "wall"
    point_m: Vector3
    normal: Vector3 = Field(description="Points to the side where the arm may be.")


class Box(Strict):
    """An axis-aligned obstacle in the robot's base frame."""

    name: str = "box"
    centre_m: Vector3
    size_m: tuple[Positive, Positive, Positive]


class Surroundings(Strict):
    """What stands around a robot, in its base frame."""

    table_z_m: Finite | None = Field(0.0, description="Height of the table top; null for none.")
    walls: tuple[Wall, ...] = ()
    boxes: tuple[Box, ...] = ()
    clearance_m: NonNegative = Field(0.02, description="Least distance kept to everything.")


class StationRobot(Strict):
    """One robot of the bench."""

    driver: str = Field(description="Name under `hil.drivers`, e.g. `mock`, `ur`.")
    model: str = Field(description="A built-in arm (`ur5`) or a path to a URDF.")
    options: dict[str, Any] = Field({}, description="The driver's own options.")
    surroundings: Surroundings = Surroundings()
    gravity_m_s2: Vector3 = Field(
        (0.0, 0.0, -9.81), description="Gravity in the base frame: says how the arm is mounted."
    )


class Station(Strict):
    """A bench: its robots by name."""

    hil_station: Literal[1] = Field(description="Version of the station format.")
    name: Name = "bench"
    robots: dict[str, StationRobot] = Field(min_length=1)
