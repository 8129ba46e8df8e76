"""What the functions of the API take: paths, and parameters as people type them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

AnyPath = str | Path


def paths(given: AnyPath | Iterable[AnyPath]) -> list[Path]:
    """One path or several; a text is a path, not a row of letters."""
    return [Path(given)] if isinstance(given, str | Path) else [Path(path) for path in given]


def parse_parameters(texts: Iterable[str]) -> dict[str, Any]:
    """`name=value` texts to a dict; values are read as YAML scalars."""
    from hil.errors import SpecError
    from hil.spec.yaml_values import scalar

    pairs = [text.partition("=") for text in texts]
    for name, equals, _ in pairs:
        if not (name and equals):
            raise SpecError(f"--set {name!r} is not NAME=VALUE", hint="for example: --set seed=3")
    return {name: scalar(value) for name, _, value in pairs}
