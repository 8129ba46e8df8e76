"""JSON Schema of import maps, for editors: `hil schema map`."""

from __future__ import annotations

from typing import Any

from hil.importers.import_map import ImportMap
from hil.spec import DIALECT


def map_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of an import map."""
    head = {"$schema": DIALECT, "$id": "urn:hil:schema:map:1", "title": "hil map"}
    schema = ImportMap.model_json_schema()
    return head | {key: value for key, value in schema.items() if key not in head}
