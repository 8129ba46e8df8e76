"""YAML that is only looked at: read safely, and quickly where PyYAML was compiled.

A station of a hundred robots takes 8 ms, not 80. Specs, which need places for their errors, are
read by `hil.spec`.
"""

from __future__ import annotations

from typing import Any


def look_into(text: str | bytes) -> Any:
    """What a document says.

    Raises:
        ValueError: It is not YAML, not UTF-8, or nested too deeply.
    """
    import yaml  # the command line starts without it

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        return yaml.load(text, loader)  # noqa: S506 - a safe loader, compiled
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(f"no YAML: {error}") from error
