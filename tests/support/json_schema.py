"""What a JSON Schema says against a document."""

from __future__ import annotations

import re
from typing import Any

TYPES: dict[str, tuple[type, ...]] = {
    "object": (dict,),
    "array": (list,),
    "string": (str,),
    "number": (int, float),
    "integer": (int,),
    "null": (type(None),),
    "boolean": (bool,),
}


def faults(value: Any, schema: dict[str, Any], root: dict[str, Any], at: str = "$") -> list[str]:
    """What JSON Schema 2020-12 says against a value; the keywords our schemas use, no more.

    Written from the specification, because no validator is among the dependencies.
    """
    if "$ref" in schema:
        target = root["$defs"][schema["$ref"].removeprefix("#/$defs/")]
        return faults(value, target, root, at)
    found = [f"{at}: no {schema['type']}"] if not _has_type(value, schema) else []
    if "const" in schema and value != schema["const"]:
        found.append(f"{at}: is not {schema['const']!r}")
    if "enum" in schema and value not in schema["enum"]:
        found.append(f"{at}: is none of {schema['enum']}")
    for combined, wanted in (("anyOf", range(1, 99)), ("oneOf", range(1, 2))):
        fitting = [s for s in schema.get(combined, ()) if not faults(value, s, root, at)]
        if combined in schema and len(fitting) not in wanted:
            found.append(f"{at}: fits {len(fitting)} of {combined}")
    if isinstance(value, dict):
        return found + _object_faults(value, schema, root, at)
    if isinstance(value, list):
        return found + _array_faults(value, schema, root, at)
    return found + _scalar_faults(value, schema, at)


def _has_type(value: Any, schema: dict[str, Any]) -> bool:
    if "type" not in schema:
        return True
    if isinstance(value, bool):  # a subclass of int in Python, and no number in JSON
        return schema["type"] == "boolean"
    return isinstance(value, TYPES[schema["type"]])


def _object_faults(
    value: dict[str, Any], schema: dict[str, Any], root: dict[str, Any], at: str
) -> list[str]:
    found = [f"{at}: lacks {key}" for key in schema.get("required", ()) if key not in value]
    properties, others = schema.get("properties", {}), schema.get("additionalProperties", True)
    if schema.get("patternProperties"):
        ((pattern, others),) = schema["patternProperties"].items()
        found += [f"{at}: {key}" for key in value if not re.search(pattern, key)]
    for key, item in value.items():
        inner = properties.get(key, others)
        if inner is False:
            found.append(f"{at}: unknown {key}")
        elif isinstance(inner, dict):
            found += faults(item, inner, root, f"{at}.{key}")
    if len(value) < schema.get("minProperties", 0):
        found.append(f"{at}: too few")
    return found


def _array_faults(
    value: list[Any], schema: dict[str, Any], root: dict[str, Any], at: str
) -> list[str]:
    fits = schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", 10**9)
    found = [] if fits else [f"{at}: has {len(value)} items"]
    prefix = schema.get("prefixItems", [])
    for i, item in enumerate(value):
        inner = prefix[i] if i < len(prefix) else schema.get("items", {})
        found += faults(item, inner, root, f"{at}[{i}]")
    return found


def _scalar_faults(value: Any, schema: dict[str, Any], at: str) -> list[str]:
    if isinstance(value, str) and not re.search(schema.get("pattern", ""), value):
        return [f"{at}: does not match"]
    if not isinstance(value, int | float) or isinstance(value, bool):
        return []
    inside = schema.get("minimum", value) <= value <= schema.get(
        "maximum", value
    ) and value > schema.get("exclusiveMinimum", value - 1)
    return [] if inside else [f"{at}: out of range"]
