"""Model of a fleet YAML file: the robots that run an experiment, with their addresses."""

from __future__ import annotations

from pathlib import Path as FilePath

from pydantic import Field

from hil.core import read_source
from hil.spec.field_types import FormatVersion, Name, Strict
from hil.spec.load import refuse_other_kind, validated

KEY = "hil_fleet"


class FleetSpec(Strict):
    """Robots of one station that run an experiment; required for real robots."""

    hil_fleet: FormatVersion = Field(description="Version of the fleet format.")
    robots: dict[Name, str] = Field(
        min_length=1,
        description="Address of every robot, by its name in the station, such as "
        "`{ur5-001: 192.168.0.11}`.",
    )


def load_fleet_spec(path: str | FilePath) -> FleetSpec:
    """Read and validate the file of a fleet.

    Raises:
        SpecError: The file has problems; the message has one line `file:line:column: path: message`
            per problem.
    """
    source = read_source(path)
    refuse_other_kind(source, KEY)
    return validated(source, FleetSpec)
