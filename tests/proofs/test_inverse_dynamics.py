"""Table II of the PINN paper from a series file, every row of it, in a minute of training."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.studies.inverse_methods import DEFAULT_KEYS, ROWS
from hil.studies.result import StudyResult, Table
from hil.studies.store import read_study, study_files
from tests.support.paths import EXPERIMENTS

STATION = EXPERIMENTS / "stations" / "mock_1khz.yaml"

pytestmark = pytest.mark.proof


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What `hil run --json` says of a series with the small program."""
    pytest.importorskip("torch", reason="torch is not installed")
    folder = tmp_path_factory.mktemp("series")
    entries = f"[{{spec: {EXPERIMENTS / 'pinn_smoke.yaml'}, station: {STATION}}}]"
    (folder / "all.yaml").write_text(f"hil_series: 1\nname: all\nseries: {entries}\n", "utf-8")
    command = ["run", str(folder / "all.yaml"), "--runs", str(folder / "runs"), "--json"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    document: dict[str, Any] = json.loads(done.stdout)
    return document


@pytest.fixture(scope="module")
def study(told: dict[str, Any]) -> StudyResult:
    (file,) = study_files(Path(told["runs"][0]["run"]))
    return read_study(file)


def table(study: StudyResult, key: str) -> Table:
    return next(t for part in study.parts for t in part.tables if t.key == key)


@pytest.mark.parametrize("key", ["paper", "honest"])
def test_every_method_has_finite_errors_of_every_joint(study: StudyResult, key: str) -> None:
    names = [ROWS[row].words_at(1000.0) for row in DEFAULT_KEYS]
    for name in (f"table-{key}", f"table-{key}-mep"):
        rows = {row[0]: row[1:8] for row in table(study, name).rows}
        assert set(names) <= set(rows)
        for method in names:
            assert all(isinstance(v, float) and math.isfinite(v) for v in rows[method]), method


def test_to_be_told_of_a_load_helps_every_model_of_the_arm(study: StudyResult) -> None:
    loads = table(study, "table-loads")
    assert loads.columns[-2:] == ("3 kg unaware", "3 kg aware")
    rows = {row[0]: row for row in loads.rows}
    for key in ("wls", "lmi", "irls", "ours"):
        unaware, aware = rows[ROWS[key].words][-2:]
        assert isinstance(aware, float)
        assert isinstance(unaware, float)
        assert aware < 0.5 * unaware


def test_no_method_was_left_out(study: StudyResult) -> None:
    assert study.warnings == ("4 trajectories; the paper has twelve",)


def test_the_overview_has_both_protocols(told: dict[str, Any]) -> None:
    page = Path(told["page"]).read_text("utf-8")
    assert "honest protocol" in page
    assert "paper protocol" in page
    assert "pinn-smoke (ur5)" in page
