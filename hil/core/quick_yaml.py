"""YAML that is only looked at: read safely, and quickly where PyYAML was compiled.

A station of a hundred robots takes 13 ms, not 60. Specs, which need places for their errors, are
read by `hil.spec`.
"""

from __future__ import annotations

from typing import Any

DEEPEST = 100
"""Levels of nesting, with those behind aliases: a compiled loader has no other end than a crash."""


def look_into(text: str | bytes) -> Any:
    """What a document says.

    Raises:
        ValueError: It is not YAML, not UTF-8, nested too deeply, or blown up by aliases.
    """
    import yaml  # the command line starts without it

    require_bounded(text)
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        return yaml.load(text, loader)  # noqa: S506 - a safe loader, compiled
    except Exception as error:  # of `!!int ""` comes an IndexError, of `!!bool x` a KeyError
        raise ValueError(f"no YAML: {_said(error)}") from error


def require_bounded(text: str | bytes) -> None:
    """See that a document can be built at all, before anything of it is.

    Raises:
        ValueError: It is not YAML, not UTF-8, nested too deeply, or blown up by aliases.
    """
    import yaml

    from hil.core.yaml_extent import Extent

    extent, loader = Extent(len(text), DEEPEST), getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        for event in yaml.parse(text, loader):
            extent.see(event)
    except Exception as error:
        raise ValueError(f"no YAML: {_said(error)}") from error


def _said(error: Exception) -> str:
    """PyYAML's own errors say where; others say little of what it tripped over."""
    plain = type(error) is ValueError or hasattr(error, "problem")
    return str(error) if plain else f"{type(error).__name__}: {error}"
