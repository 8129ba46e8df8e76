"""Which changes make the long runs worth running again."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.proofs import proof_inputs
from tests.support.paths import ROOT

MARK = "mark." + "proof"


@pytest.mark.parametrize(
    "name",
    [
        "hil/cli/app.py",
        "hil/arms/ur5.yaml",
        "hil/report/report.html.j2",
        "mock_robot/hil_mock_robot/ranges.yaml",
        "benchmarks/mock.py",
        "experiments/ur5_dwell_650.yaml",
        "experiments/maps/ur10e_columns.yaml",
        "experiments/stations/mock.yaml",
        "tests/support/plan_parts.py",
        "tests/proofs/test_mock.py",
        "tests/proofs/test_recording.py",
        "pyproject.toml",
        "constraints.txt",
    ],
)
def test_what_the_long_runs_depend_on_is_an_input(name: str) -> None:
    assert ROOT / name in proof_inputs.inputs()


def test_neither_caches_nor_other_tests_are_inputs() -> None:
    names = [path.relative_to(ROOT).as_posix() for path in proof_inputs.inputs()]
    assert not [name for name in names if "__pycache__" in name or name.endswith(".pyc")]
    proofs = {ROOT / name for name in proof_inputs.FILES if "/test_" in name}
    assert {
        ROOT / name for name in names if name.startswith("tests/") and "/test_" in name
    } == proofs
    marked = {
        path for path in (ROOT / "tests").rglob("test_*.py") if MARK in path.read_text("utf-8")
    }
    assert marked <= proofs


def test_a_changed_input_changes_the_hash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = tmp_path / "experiments" / "maps" / "new.yaml"
    spec.parent.mkdir(parents=True)
    monkeypatch.setattr(proof_inputs, "ROOT", tmp_path)
    before = proof_inputs.inputs_hash()
    spec.write_text("a: 1")
    assert proof_inputs.inputs_hash() != before
