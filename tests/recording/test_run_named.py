"""Which run is meant by what somebody types."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import hil
from hil.core.errors import DataError, SpecError
from hil.runs.listing import find_run
from tests.support.paths import EXPERIMENTS

FOLDERS = (
    "2026-11-20/ur5/0009-dwell",
    "2026-11-21/arm/0010-desk_arm",
    "2026-11-20/arm/0012-desk_arm",
    "2026-11-22/ur5/0011-dwell-12",
    "2026-11-23/ur5/renamed",
)


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for name in FOLDERS:
        (tmp_path / name).mkdir(parents=True)
    return tmp_path


@pytest.mark.parametrize(
    ("named", "number"),
    [
        ("10", 10),
        ("0010-desk_arm", 10),
        ("desk_arm", 12),
        ("Desk_Arm", 12),
        ("dwell", 9),
        ("last", 12),
    ],
)
def test_a_run_is_named_by_number_folder_experiment_or_as_the_last(
    runs: Path, named: str, number: int
) -> None:
    assert int(find_run(named, runs).name[:4]) == number


@pytest.mark.parametrize("named", ["13", "dwel", "desk", "first"])
def test_nothing_else_is_taken_for_a_run(runs: Path, named: str) -> None:
    with pytest.raises(DataError, match="there is no run"):
        find_run(named, runs)


def test_without_runs_there_is_no_last(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="there is no run last"):
        find_run("last", tmp_path)


def test_overrides_from_python_are_values_or_the_texts_of_set() -> None:
    spec = EXPERIMENTS / "ci_dwell_12.yaml"
    made = [
        hil.load(spec, overrides={"excitation.waypoints": value, "reference.every": every})
        for value, every in ((20, 5), ("20", np.int64(5)))
    ]
    assert [one.spec.excitation.waypoints for one in made] == [20, 20]
    assert made[0].spec == made[1].spec


def test_what_yaml_has_not_is_refused() -> None:
    with pytest.raises(SpecError, match="is not a YAML value"):
        hil.load(EXPERIMENTS / "ci_dwell_12.yaml", overrides={"reference.every": object()})
