"""A digest over what makes an arm out of its file: comments and remarks may change.

Of a description everything counts but `guessed` and `sources`, which say how its numbers are known;
of a URDF its joints and inertias, not what it looks like. How the numbers are written, the order of
keys and comments count nowhere.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from hashlib import sha256
from typing import Any

REMARKS = ("guessed", "sources")
LOOKS = ("visual", "collision", "material", "gazebo", "transmission")
"""Elements of a URDF that no model is made of."""


def description_sha256(document: Mapping[str, Any]) -> str:
    """SHA-256 of a description, as its YAML was read: canonical JSON without remarks."""
    said = {key: value for key, value in document.items() if key not in REMARKS}
    text = json.dumps(_plain(said), sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    return sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def urdf_sha256(content: bytes) -> str:
    """SHA-256 of a URDF's canonical XML without looks; of the bytes where they are no XML."""
    try:
        root = ET.fromstring(content)  # noqa: S314  a file of the user's own bench
    except (ET.ParseError, ValueError):
        return sha256(content).hexdigest()
    text = ET.canonicalize(ET.tostring(root, "unicode"), strip_text=True, exclude_tags=LOOKS)
    return sha256(text.encode()).hexdigest()


def _plain(value: Any) -> Any:
    """The value with every number as a float: 250 is 250.0."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_plain(one) for one in value]
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value if isinstance(value, str | float | bool | None) else str(value)
