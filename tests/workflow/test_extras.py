"""A missing extra is noticed before the robot moves, not by the fit after it."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import hil
from hil.cli.app import app
from hil.core import plugins
from hil.core.errors import PluginError

SPEC = """\
hil: 1
name: extras
robot: ur5
excitation: {kind: fourier, trajectories: 3}
weigh: false
"""
NETWORK = "fit: [{estimator: rigid-wls}, {estimator: lagrangian}]"
CORRECTED = "fit: [{estimator: residual, base: {estimator: rigid-lmi}}]"
TABLE = "study: [{study: inverse-dynamics}]"


@pytest.fixture(autouse=True)
def _without(monkeypatch: pytest.MonkeyPatch) -> None:
    def found(name: str) -> Any:
        return None if name in ("torch", "cvxpy") else find_spec(name)

    monkeypatch.setattr(plugins, "find_spec", found)


def validated(path: Path, *options: str) -> str:
    done = CliRunner().invoke(app, ["validate", str(path), *options])
    assert done.exit_code == 0, done.output
    return done.stdout


def written(root: Path, rest: str) -> Path:
    path = root / "spec.yaml"
    path.write_text(f"{SPEC}{rest}\n", "utf-8")
    return path


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("rest", "told", "extras"),
    [
        (NETWORK, "fit: lagrangian needs torch, which is not installed, to train", "learn"),
        (CORRECTED, "fit: residual needs cvxpy", "identify,learn"),
        (TABLE, "study: inverse-dynamics needs torch", "identify,learn"),
        ("study: [{study: inverse-dynamics, methods: [wls, delan]}]",
         "for its rows delan; methods: [wls] do without", "learn"),
    ],
)  # fmt: skip
def test_a_run_whose_fits_would_fail_moves_nothing(
    tmp_path: Path, rest: str, told: str, extras: str
) -> None:
    with pytest.raises(PluginError) as caught:
        hil.run(hil.load(written(tmp_path, rest)), runs=tmp_path / "runs")
    assert told in caught.value.message
    assert caught.value.hint == f'pip install "hil[{extras}]"'
    assert not (tmp_path / "runs").exists()


def test_a_fit_names_all_that_it_lacks_before_it_reads_a_recording(tmp_path: Path) -> None:
    with pytest.raises(PluginError) as caught:
        hil.fit(tmp_path / "none", estimator="residual")
    assert caught.value.message.splitlines() == [
        "residual needs cvxpy, which is not installed, by its base rigid-hysteresis for "
        "physically consistent links; not needed with consistent: false",
        "residual needs torch, which is not installed, to train its network",
    ]
    assert caught.value.hint == 'pip install "hil[identify,learn]"'


def test_a_base_that_does_without_needs_what_trains_alone(tmp_path: Path) -> None:
    base = {"estimator": "rigid-hysteresis", "consistent": False}
    with pytest.raises(PluginError) as caught:
        hil.fit(tmp_path / "none", estimator="residual", parameters={"base": base})
    assert caught.value.hint == 'pip install "hil[learn]"'


def test_validate_warns_since_another_computer_may_have_it(tmp_path: Path) -> None:
    path = written(tmp_path, NETWORK)
    assert "warning: fit: lagrangian needs torch" in validated(path)
    (warning,) = json.loads(validated(path, "--json"))["warnings"]
    assert warning.endswith('→ pip install "hil[learn]"')


def test_what_needs_no_extra_is_not_warned_of(tmp_path: Path) -> None:
    rest = "fit: [{estimator: rigid-wls}]\nstudy: [{study: inverse-dynamics, methods: [wls, irls]}]"
    assert json.loads(validated(written(tmp_path, rest), "--json"))["warnings"] == []


def test_nothing_of_a_series_is_run_if_a_later_experiment_lacks_something(tmp_path: Path) -> None:
    written(tmp_path, "fit: [{estimator: rigid-wls}]").rename(tmp_path / "first.yaml")
    written(tmp_path, NETWORK)
    series = tmp_path / "both.yaml"
    text = "hil_series: 1\nname: both\nseries: [{spec: first.yaml}, {spec: spec.yaml}]\n"
    series.write_text(text, "utf-8")
    assert "warning: fit: lagrangian needs torch" in validated(series)

    run = CliRunner().invoke(app, ["run", str(series), "--runs", str(tmp_path / "runs")])
    assert isinstance(run.exception, PluginError)
    assert not (tmp_path / "runs").exists()
