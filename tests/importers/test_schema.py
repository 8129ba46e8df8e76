"""The JSON Schema of import maps says what `load_map` says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hil.core.yaml import read_source
from hil.importers.import_map import map_schema
from tests.support.json_schema import faults
from tests.support.paths import EXPERIMENTS

MAPS = sorted((EXPERIMENTS / "maps").glob("*.yaml"))


def shipped(name: str = "ur10e_columns") -> dict[str, Any]:
    data = read_source(EXPERIMENTS / "maps" / f"{name}.yaml").data
    assert isinstance(data, dict)
    return data


def faults_of(data: Any) -> list[str]:
    schema = map_schema()
    found: list[str] = faults(data, schema, schema)
    return found


@pytest.mark.parametrize("path", MAPS, ids=lambda path: path.stem)
def test_every_shipped_map_fits_the_schema(path: Path) -> None:
    assert faults_of(read_source(path).data) == []


@pytest.mark.parametrize("address", [7, "2:7", "joint_1", [1, 2], ["a", "b"]])
def test_every_way_to_write_columns_fits(address: Any) -> None:
    data = shipped()
    data["columns"]["q"]["columns"] = address
    assert faults_of(data) == []


@pytest.mark.parametrize(
    ("key", "value"), [("columns", 0), ("columns", []), ("scale", "2"), ("unit", 3), ("limt", 1)]
)
def test_mistakes_in_a_quantity_do_not_fit(key: str, value: Any) -> None:
    data = shipped()
    data["columns"]["q"][key] = value
    assert faults_of(data) != []


def test_a_map_without_joints_does_not_fit() -> None:
    data = shipped()
    del data["joint_names"]
    assert faults_of(data) != []
