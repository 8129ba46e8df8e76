"""The page about import maps: complete, and its examples are what they claim to be."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from hil.importers import import_recording, load_map
from hil.importers.import_map import QUANTITY_DIMENSIONS, ImportMap, units_of
from hil.importers.sources import load_source
from hil.spec.model_tree import Model, keys_of, tree
from tests.support.paths import DOCS

PAGE = (DOCS / "reference" / "maps.md").read_text("utf-8")
MODELS = list(dict.fromkeys(model for _, model in tree(ImportMap)))
TITLES = {
    "ImportMap": "## Top of the file",
    "Columns": "## `columns`",
    "Quantity": "### A quantity",
    "Time": "### `columns.t`",
    "Window": "## `windows`",
    "Load": "## `payload`",
}


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def rows_of(model: Model) -> dict[str, list[str]]:
    """The cells of a section's table by key."""
    section = PAGE.split("\n" + TITLES[model.__name__])[1].split("\n#")[0]
    rows = [line.strip("|").split(" | ") for line in section.splitlines() if line.startswith("|")]
    return {row[0].strip(" `"): row for row in rows[2:]}


def defaults() -> list[tuple[str, str, Model]]:
    return [(model.__name__, key, model) for model in MODELS for key in keys_of(model)]


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_every_key_has_a_row_and_every_row_is_a_key(model: Model) -> None:
    assert sorted(rows_of(model)) == sorted(keys_of(model))


@pytest.mark.parametrize(
    ("name", "key", "model"), defaults(), ids=lambda given: given if isinstance(given, str) else ""
)
def test_the_page_says_which_keys_are_required(name: str, key: str, model: Model) -> None:
    required = keys_of(model)[key].is_required()
    assert (rows_of(model)[key][2].strip() == "required") is required


@pytest.mark.parametrize("key", ["header", "delimiter", "decimal", "topic", "stamp"])
def test_defaults_of_the_page_are_those_of_the_map(key: str) -> None:
    default = ImportMap.model_fields[key].default
    shown = str(default).lower() if isinstance(default, bool) else str(default)
    assert rows_of(ImportMap)[key][2].strip(" `") == shown


@pytest.mark.parametrize("dimensions", sorted(set(QUANTITY_DIMENSIONS.values())), ids=", ".join)
def test_every_unit_is_listed(dimensions: tuple[str, ...]) -> None:
    table = PAGE.split("\n## Units")[1].split("\n##")[0]
    for dimension in dimensions:
        (row,) = [line for line in table.splitlines() if line.startswith(f"| {dimension} |")]
        listed = set(re.split(r"[ ,|]+", row))
        spelled = {"°": "deg", "°/s": "deg/s", "°/s²": "deg/s²", "µs": "us", "°F": "F"}
        assert {spelled.get(unit, unit) for unit in units_of((dimension,))} <= listed


@pytest.mark.parametrize("number", range(len(blocks("yaml"))))
def test_every_example_is_a_valid_map(number: int, tmp_path: Path) -> None:
    path = tmp_path / "map.yaml"
    path.write_text(blocks("yaml")[number], "utf-8")
    assert load_map(path).description


def test_the_first_example_imports_the_file_shown_with_it(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(blocks("yaml")[0], "utf-8")
    (tmp_path / "run.csv").write_text(blocks("csv")[0], "utf-8")
    out = tmp_path / "run.mcap"
    import_recording(tmp_path / "run.csv", map_file=tmp_path / "map.yaml", out=out)
    data = load_source(out)
    assert data["t"] == pytest.approx([0.0, 0.01, 0.02])
    assert data["q"][0] == pytest.approx([0.1745329, -1.5707963])
    assert data["effort"][0] == pytest.approx([0.512, -0.301])
    assert data.conditions[0].payload.mass == 1.2


def test_windows_of_the_page_depend_on_the_name_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(blocks("yaml")[3], "utf-8")
    layout = load_map(tmp_path / "map.yaml")
    counts = {name: len(layout.windows_of(name)) for name in ("monday_2.csv", "tuesday.csv", "x")}
    assert counts == {"monday_2.csv": 1, "tuesday.csv": 2, "x": 0}
