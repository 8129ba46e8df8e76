"""JSON Schema of the YAML files, so that editors complete keys and mark mistakes while typing.

`python -m hil.spec.schema experiments/schema` writes the files that the shipped specs point to.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from pydantic.json_schema import GenerateJsonSchema

from hil.core import split_unit, symbol_of
from hil.spec.experiment import ExperimentSpec
from hil.spec.field_types import Strict
from hil.spec.fleet import FleetSpec
from hil.spec.schedule import ScheduleSpec
from hil.spec.series import SeriesSpec
from hil.spec.station import Station

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def experiment_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of an experiment."""
    return _schema(ExperimentSpec, "experiment")


def station_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a station."""
    return _schema(Station, "station")


def series_schema() -> dict[str, Any]:
    """JSON Schema of a series of experiments."""
    return _schema(SeriesSpec, "series")


def schedule_schema() -> dict[str, Any]:
    """JSON Schema of a schedule."""
    return _schema(ScheduleSpec, "schedule")


def fleet_schema() -> dict[str, Any]:
    """Return the JSON Schema of a fleet's file."""
    return _schema(FleetSpec, "fleet")


def schema_files() -> dict[str, str]:
    """The text of every schema file by its name."""
    schemas = {
        "experiment": experiment_schema(),
        "fleet": fleet_schema(),
        "schedule": schedule_schema(),
        "series": series_schema(),
        "station": station_schema(),
    }
    return {
        f"{name}.schema.json": json.dumps(schema, indent=2, ensure_ascii=False) + "\n"
        for name, schema in schemas.items()
    }


class _WithUnits(GenerateJsonSchema):
    """Pydantic's generator, with titles that say the unit instead of spelling the key again."""

    def get_title_from_name(self, name: str) -> str:
        """`mass_kg` → `mass [kg]`."""
        unit = symbol_of(name)
        words = split_unit(name)[0].replace("_", " ")
        return f"{words} [{unit}]" if unit else words


def _schema(model: type[Strict], kind: str) -> dict[str, Any]:
    schema = model.model_json_schema(by_alias=True, schema_generator=_WithUnits)
    head = {"$schema": DIALECT, "$id": f"urn:hil:schema:{kind}:1", "title": f"hil {kind}"}
    return head | {key: value for key, value in schema.items() if key not in head}


def write_schemas(folder: Path) -> None:
    """Write the schema files into a folder, which is made if need be."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in schema_files().items():
        (folder / name).write_text(text, "utf-8")


if __name__ == "__main__":
    write_schemas(Path(sys.argv[1] if len(sys.argv) > 1 else "experiments/schema"))
