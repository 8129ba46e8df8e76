"""The JSON Schema and the reference page say what the models say."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from hil.core.errors import SpecError
from hil.core.yaml import read_source
from hil.spec.documentation import (
    explain_key,
    keys_below,
    reference,
    schema_files,
    schema_of,
)
from hil.spec.experiment import ExperimentSpec
from hil.spec.model_tree import Model, keys_of, tree
from hil.spec.schedule import ScheduleSpec, is_schedule
from hil.spec.series import SeriesSpec, is_series
from hil.spec.station import Station
from tests.support.json_schema import faults
from tests.support.paths import DOCS, EXPERIMENTS

SHIPPED = sorted(EXPERIMENTS.glob("*.yaml"))
SERIES = [path for path in SHIPPED if is_series(path)]
SCHEDULES = [path for path in SHIPPED if is_schedule(path)]
SPECS = [path for path in SHIPPED if path not in (*SERIES, *SCHEDULES)]
STATIONS = sorted((EXPERIMENTS / "stations").glob("*.yaml"))


@pytest.mark.thorough
@pytest.mark.parametrize("path", SPECS, ids=lambda path: path.name)
def test_every_shipped_experiment_fits_the_schema(path: Path) -> None:
    schema = schema_of("experiment")

    assert faults(read_source(path).data, schema, schema) == []


@pytest.mark.parametrize("path", SERIES, ids=lambda path: path.name)
def test_every_shipped_series_fits_the_schema(path: Path) -> None:
    schema = schema_of("series")

    assert faults(read_source(path).data, schema, schema) == []


@pytest.mark.parametrize("path", SCHEDULES, ids=lambda path: path.name)
def test_every_shipped_schedule_fits_the_schema(path: Path) -> None:
    schema = schema_of("schedule")

    assert faults(read_source(path).data, schema, schema) == []


@pytest.mark.parametrize("path", STATIONS, ids=lambda path: path.name)
def test_every_shipped_station_fits_the_schema(path: Path) -> None:
    schema = schema_of("station")

    assert faults(read_source(path).data, schema, schema) == []


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("excitation", "waypoints"), 0),
        (("excitation", "waypoints"), 1.5),
        (("excitation", "dwell_s"), "95 ms"),
        (("excitation", "dwell_s"), 0.001),
        (("excitation", "dwell_ms"), 95),
        (("excitation", "kind"), "dwel"),
        (("excitation", "approach"), "sideways"),
        (("excitation", "range_deg"), [[0, 1, 2]]),
        (("name",), "my demo"),
        (("hil",), 2),
        (("loads",), []),
        (("loads",), [{"mass_g": 3}]),
        (("validation",), {}),
        (("warm_up", "duration_s"), -1),
    ],
)
def test_the_schema_refuses_what_loading_refuses(place: tuple[str, ...], value: object) -> None:
    schema = schema_of("experiment")
    data = read_source(EXPERIMENTS / "ur5_dwell_650.yaml").data
    target = data
    for key in place[:-1]:
        target = target[key]
    target[place[-1]] = value

    assert faults(data, schema, schema) != []


def test_the_schema_takes_interlocks_of_plug_ins_and_no_other_keys_of_built_in_ones() -> None:
    schema = schema_of("experiment")
    data = read_source(EXPERIMENTS / "ur5_dwell_650.yaml").data
    assert faults(data | {"interlocks": [{"kind": "door", "pin": 3}]}, schema, schema) == []
    assert faults(data | {"interlocks": [{"kind": "disk", "pin": 3}]}, schema, schema) != []


@pytest.mark.parametrize("path", [*SHIPPED, *STATIONS], ids=lambda path: path.name)
def test_the_first_line_of_a_shipped_file_leads_editors_to_its_schema(path: Path) -> None:
    first = path.read_text("utf-8").partition("\n")[0]
    match = re.fullmatch(r"# yaml-language-server: \$schema=(\S+)", first)
    assert match is not None

    schema = json.loads((path.parent / match[1]).read_text("utf-8"))

    assert path.parent.name in ("stations", "experiments")
    kinds = {"station": STATIONS, "series": SERIES, "schedule": SCHEDULES}
    kind = next((kind for kind, paths in kinds.items() if path in paths), "experiment")
    assert schema["$id"] == f"urn:hil:schema:{kind}:1"
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"


@pytest.mark.parametrize("name", sorted(schema_files()))
def test_the_schema_files_are_up_to_date(name: str) -> None:
    written = (EXPERIMENTS / "schema" / name).read_text("utf-8")

    assert written == schema_files()[name], (
        "run: python -m hil.spec.documentation experiments/schema"
    )


def test_the_reference_page_is_up_to_date() -> None:
    written = (DOCS / "reference" / "spec.md").read_text("utf-8")

    assert written == reference(), "run: python -m hil.spec.documentation docs/reference/spec.md"


@pytest.mark.parametrize("model", [ExperimentSpec, Station, SeriesSpec, ScheduleSpec])
def test_every_key_says_what_it_means(model: Model) -> None:
    silent = [info.path for info in keys_below(model) if not info.meaning.endswith(".")]

    assert silent == []
    assert all(owner.__doc__ for _, owner in tree(model))


def test_titles_show_the_unit() -> None:
    dwell = schema_of("experiment")["$defs"]["Dwell"]["properties"]

    assert dwell["max_acceleration_deg_s2"]["title"] == "max acceleration [°/s²]"
    assert dwell["seed"]["title"] == "seed"


def test_the_schema_uses_the_keys_of_the_file() -> None:
    assert set(schema_of("experiment")["properties"]) == set(keys_of(ExperimentSpec))
    assert "validate" in schema_of("experiment")["properties"]


def test_a_key_is_explained_by_its_path() -> None:
    (dwell,) = explain_key("excitation.dwell_s")
    assert (dwell.unit, dwell.default, dwell.allowed) == ("s", "`0.095`", "number ≥ 0.01, ≤ 600")
    assert dwell.meaning == "Minimum time at standstill in each pose."
    assert [info.kind for info in explain_key("excitation.seed")] == ["dwell", "fourier"]
    assert explain_key("loads.0.mass_kg") == explain_key("mass_kg")


def test_a_key_nobody_knows_cannot_be_explained() -> None:
    with pytest.raises(SpecError) as caught:
        explain_key("excitation.dwel_s")

    assert caught.value.hint == "did you mean 'excitation.dwell_s'?"
