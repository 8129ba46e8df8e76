"""Registries that know runs are found wherever they are, and nothing goes where they are not."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import RegistryError
from hil.estimators import estimator
from hil.models.model_registry import Registry, facts_of
from hil.models.registries_file import FILE, known_registries, note_registry, registries_of
from tests.support.catalogue_runs import settle, write_run
from tests.support.synthetic_motion import moving, nominal


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cwd").mkdir()
    monkeypatch.chdir(tmp_path / "cwd")
    monkeypatch.delenv("HIL_REGISTRY", raising=False)


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for number in (1, 2):
        write_run(tmp_path / "data" / "runs", number, day=f"2026-11-1{number}")
    return tmp_path / "data" / "runs"


@pytest.fixture
def registry(runs: Path, tmp_path: Path) -> Path:
    """In a place nobody would look at, with the model of the first run."""
    model = run_of(runs, 1) / "fit" / "rigid-wls-0"
    estimator("rigid-wls").fit(moving(1, 2, 3), nominal()).save(model)
    Registry(tmp_path / "lab" / "registry").register("ur5", model, facts_of(model))
    settle(run_of(runs, 1))
    return tmp_path / "lab" / "registry"


def run_of(runs: Path, number: int) -> Path:
    (found,) = runs.glob(f"*/*/{number:04d}-*")
    return found


def prune(runs: Path, *more: str) -> BaseException | None:
    arguments = ["prune", "--older-than", "1d", "--yes", "--runs", str(runs), *more]
    return CliRunner().invoke(app, arguments).exception


def test_a_registry_is_noted_where_the_runs_of_its_models_are(runs: Path, registry: Path) -> None:
    assert known_registries(runs, []) == [registry]
    assert prune(runs) is None
    assert run_of(runs, 1).exists()
    again = run_of(runs, 1) / "fit" / "rigid-wls-0"
    Registry(registry).register("ur5", again, facts_of(again))
    assert (runs / FILE).read_text() == json.dumps(str(registry)) + "\n"


@pytest.mark.thorough
def test_runs_that_are_only_named_count_too(runs: Path, tmp_path: Path) -> None:
    model = tmp_path / "models" / "rigid-wls-0"
    estimator("rigid-wls").fit(moving(1, 2, 3), nominal()).save(model)
    data = [run_of(runs, 1), run_of(runs, 2) / "recording" / "00.mcap"]
    Registry(tmp_path / "lab").register("ur5", model, facts_of(model, data[1:]))
    assert registries_of(runs) == [tmp_path / "lab"]
    Registry(tmp_path / "lab").register("ur5-2", model, facts_of(model, data))
    assert registries_of(runs) == [tmp_path / "lab"]


@pytest.mark.thorough
@pytest.mark.parametrize("spoilt", ["moved", "unmounted", "garbled"])
def test_a_registry_that_is_noted_and_not_there_keeps_everything(
    spoilt: str, runs: Path, registry: Path
) -> None:
    if spoilt == "garbled":
        (runs / FILE).write_text('"/lab/reg')
    else:
        shutil.move(registry, registry.with_name("moved"))
    if spoilt == "unmounted":
        registry.mkdir()
    for more in ((), ("--no-registry",)):
        refused = prune(runs, *more)
        assert isinstance(refused, RegistryError)
        assert FILE in refused.message
    assert len(list(runs.glob("*/*/*"))) == 2


def test_without_any_registry_nothing_goes_unless_that_is_said(runs: Path) -> None:
    refused = prune(runs)
    assert isinstance(refused, RegistryError)
    assert "--no-registry" in refused.hint
    assert len(list(runs.glob("*/*/*"))) == 2
    assert prune(runs, "--no-registry") is None
    assert list(runs.glob("*/*/*")) == []


def test_only_folders_of_runs_are_noted_in(runs: Path, tmp_path: Path) -> None:
    alone = tmp_path / "desk" / "a" / "b" / "run"
    shutil.copytree(run_of(runs, 1), alone)
    note_registry(tmp_path / "lab", [alone, tmp_path / "no" / "such", tmp_path])
    assert not list(tmp_path.rglob(FILE))
