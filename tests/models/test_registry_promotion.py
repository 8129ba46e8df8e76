"""From recordings to a champion and back, at the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core.errors import DataError, RegistryError, Rejected, SpecError
from hil.models.model_registry import Registry, facts_of
from tests.estimators.test_sources import recording
from tests.support.synthetic_motion import nominal

TRAINED, FRESH = (1, 2, 3), (11, 12, 13, 14)


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    folder = tmp_path_factory.mktemp("recordings")
    return {seed: recording(folder, seed) for seed in (*TRAINED, *FRESH)}


@pytest.fixture(scope="module")
def models(sources, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """`good` learned from three trajectories; `poor` takes viscous friction for nothing else."""
    out = tmp_path_factory.mktemp("models")
    told = {"good": {}, "poor": {"sign_width": 5.0}}
    return {
        name: hil.fit(
            [sources[k] for k in TRAINED], estimator="rigid-wls", out=out, parameters=how
        ).fitted.folder
        for name, how in told.items()
    }


@pytest.fixture
def registry(models, tmp_path: Path) -> Path:
    root = tmp_path / "registry"
    for name in ("poor", "good"):
        Registry(root).register("ur5", models[name], facts_of(models[name]))
    return root


def called(registry: Path, *words: str | Path):
    arguments = ["models", *map(str, words), "--registry", str(registry)]
    return CliRunner().invoke(app, arguments)


def on(sources) -> list[str]:
    return [word for seed in FRESH for word in ("--on", str(sources[seed]))]


@pytest.mark.thorough
def test_the_better_is_promoted_and_the_way_back_is_there(registry, sources) -> None:
    first = called(registry, "promote", "ur5", "v1", *on(sources))
    assert "ur5: v1 is champion: there is no other champion" in first.stdout
    second = called(registry, "promote", "ur5", "v2", *on(sources), "--reason", "weekly")
    assert second.exit_code == 0, second.output
    assert "ur5: v2 is champion: weekly: the challenger errs less" in second.stdout
    assert "v1 is champion again" in called(registry, "rollback", "ur5").stdout
    log = json.loads(called(registry, "log", "ur5", "--json").stdout)["log"]
    assert [one["event"] for one in log][2:] == ["promoted", "promoted", "rolled-back"]
    assert log[3]["evidence"]["comparison"]["better"] is True


@pytest.mark.thorough
def test_the_worse_is_never_promoted(registry, sources) -> None:
    called(registry, "promote", "ur5", "v2", *on(sources))
    for more in ([], ["--unless-worse"]):
        done = called(registry, "promote", "ur5", "v1", *on(sources), *more)
        assert isinstance(done.exception, Rejected)
        assert "v1 is not promoted, v2 stays: the challenger errs more" in done.exception.message
    assert Registry(registry).aliases("ur5").champion == 2
    assert Registry(registry).log("ur5")[-1].event == "kept"


@pytest.mark.thorough
def test_criteria_are_met_or_there_is_no_promotion(registry, sources) -> None:
    done = called(registry, "promote", "ur5", "v2", *on(sources), "--max-rmse", "1e-9")
    assert isinstance(done.exception, Rejected)
    assert "criteria are missed: rmse_raw of mean is" in done.exception.message
    assert Registry(registry).aliases("ur5").champion == 0


def test_nobody_is_judged_on_what_it_learned_from(registry, sources) -> None:
    done = called(registry, "promote", "ur5", "v2", "--on", sources[1])
    assert isinstance(done.exception, DataError)
    assert "was fitted to" in str(done.exception)
    unjudged = called(registry, "promote", "ur5", "v2", "--max-rmse", "1")
    assert isinstance(unjudged.exception, SpecError)


@pytest.mark.thorough
def test_two_versions_side_by_side(registry, sources) -> None:
    files = [sources[seed] for seed in FRESH]
    done = called(registry, "compare", "ur5", "v2", *files, "--with", "v1")
    assert done.exit_code == 0, done.output
    assert "the challenger errs less" in done.stdout
    told = json.loads(
        called(registry, "compare", "ur5", "v2", *files, "--with", "v1", "--json").stdout
    )
    assert np.all(np.array(told["challenger_rmse"]) <= told["champion_rmse"])
    assert told["samples"] == 4 * 1000


def test_a_comparison_without_a_champion_names_what_else_can_be_done(registry, sources) -> None:
    done = called(registry, "compare", "ur5", "v2", sources[FRESH[0]])
    assert isinstance(done.exception, RegistryError)
    assert done.exception.message == "ur5 has no champion"
    assert "--with v2" in done.exception.hint
    assert "hil models promote ur5 v1" in done.exception.hint


@pytest.mark.thorough
def test_what_is_there_is_listed(registry, models) -> None:
    done = called(registry, "register", models["good"], "--name", "ur5", "--challenger")
    assert "ur5 v2: rigid-wls" in done.stdout
    listed = json.loads(called(registry, "list", "--json").stdout)["models"]
    assert listed == [
        {
            "name": "ur5",
            "versions": 2,
            "champion": None,
            "challenger": 2,
            "before": [],
            "problem": None,
        }
    ]
    assert "challenger" in called(registry, "show", "ur5").stdout
    shown = json.loads(called(registry, "show", "ur5", "v1").stdout)
    assert shown["facts"]["trained_on"] == ["1.mcap", "2.mcap", "3.mcap"]
    assert shown["facts"]["joint_names"] == list(nominal().joint_names)
    assert "1 names, 2 versions" in called(registry, "check").stdout


def test_an_empty_registry_says_how_to_begin(tmp_path: Path) -> None:
    assert "hil models register MODEL --name NAME" in called(tmp_path / "none", "list").stdout
