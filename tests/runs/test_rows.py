"""Runs that were renamed since a model was fitted to them, known by the rows of real models."""

from __future__ import annotations

import time
from datetime import timedelta
from pathlib import Path

import pytest

from hil import api
from hil.core.errors import RegistryError
from hil.models.model_registry import Registry, facts_of
from hil.runs.retention import Policy, decide
from tests.support.report_runs import fourier_plan, robot_facts, rows_of_plan, write_run

ALL = Policy(older=timedelta(days=1))


def three_runs(root: Path) -> list[Path]:
    """Of the same motion, told apart by their currents."""
    made = []
    for more in (0.0, 0.003, 0.006):
        rows = rows_of_plan(fourier_plan())
        rows["effort"] += more
        made.append(write_run(root, fourier_plan(), rows=rows, robot=robot_facts()).path)
    return made


def whys(root: Path, models: Path) -> list[str]:
    in_a_while = time.time() + 10 * 86_400.0
    return [one.why for one in decide(root, ALL, [models], in_a_while)]


@pytest.mark.thorough
def test_a_renamed_run_stays_by_the_rows_that_the_model_remembers(tmp_path: Path) -> None:
    runs, models = tmp_path / "runs", tmp_path / "models"
    made = three_runs(runs)
    told = api.fit(made[0], estimator="rigid-wls", out=tmp_path / "fitted").to_dict()
    model = Path(told["model"])
    Registry(models).register("ur5", model, facts_of(model))
    made[0].rename(made[0].with_name("0001-of-another-name"))
    assert whys(runs, models) == ["ur5 v1 was fitted to it", "", ""]
    next(models.rglob("model.json")).unlink()
    with pytest.raises(RegistryError, match=r"the training data of .* are unknown"):
        whys(runs, models)


@pytest.mark.thorough
def test_one_of_two_that_was_renamed_stays_where_only_the_other_was_named(tmp_path: Path) -> None:
    runs, models = tmp_path / "runs", tmp_path / "models"
    made = three_runs(runs)
    told = api.fit(made[:2], estimator="rigid-wls", out=tmp_path / "fitted").to_dict()
    model = Path(told["model"])
    Registry(models).register("ur5", model, facts_of(model, made[:1]))
    made[1].rename(made[1].with_name("0002-of-another-name"))
    assert whys(runs, models) == ["ur5 v1 was fitted to it"] * 2 + [""]
