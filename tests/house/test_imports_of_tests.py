"""Every test module imports names that exist.

A test file that cannot be imported runs nowhere, and nothing notices while only others are run.
"""

from __future__ import annotations

import ast
import importlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.paths import ROOT

OURS = ("hil", "hil_drivers", "hil_mock_robot")


def imported_names(file: Path) -> Iterator[tuple[str, str]]:
    """Module and name of each `from … import` of our packages, also inside functions."""
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in OURS:
            yield from ((str(node.module), alias.name) for alias in node.names)


def exists(module: str, name: str) -> bool:
    try:
        return hasattr(importlib.import_module(module), name) or bool(
            importlib.import_module(f"{module}.{name}")
        )
    except ModuleNotFoundError as error:
        # Tests of an extra that is not installed are skipped; only our own modules must be there.
        return (error.name or "").split(".")[0] not in OURS


@pytest.mark.thorough
def test_names_that_tests_import_exist() -> None:
    used: dict[tuple[str, str], str] = {}
    for file in sorted((ROOT / "tests").rglob("*.py")):
        used |= dict.fromkeys(imported_names(file), file.name)
    missing = [f"{file}: from {m} import {n}" for (m, n), file in used.items() if not exists(m, n)]
    assert missing == []
