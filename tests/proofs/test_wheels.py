"""The wheel installed in fresh environments does its work: `make wheels` for every set."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from tests.proofs.install_matrix import PYTHONS, SETS, interpreter, matrix, only_cuda

pytestmark = pytest.mark.proof

HERE = f"{sys.version_info[0]}.{sys.version_info[1]}"


@pytest.mark.timeout(1800)
def test_the_wheel_works_without_and_with_every_small_extra(tmp_path: Path) -> None:
    sets = [name for name in SETS if name != "learn"]  # torch: gigabytes where it is not +cpu
    cells = matrix(sets, [HERE], tmp_path)
    told = {" ".join(of): cell.said for of, cell in cells.items() if cell.failed}
    assert not told, "\n".join(told.values())


@pytest.mark.parametrize(("version", "cuda"), [("2.13.0", True), ("2.13.0+cpu", False)])
def test_a_torch_with_cuda_is_told_from_one_without(
    version: str, cuda: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = {"install": [{"metadata": {"name": "torch", "version": version}}]}
    monkeypatch.setattr("tests.proofs.install_matrix._run", lambda command: json.dumps(report))
    assert only_cuda(sys.executable) is cuda


def test_an_interpreter_that_only_seems_to_be_there_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    false = tmp_path / "python3.12"
    false.write_text("#!/bin/sh\nexit 127\n")
    false.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert interpreter("3.12") is None
    assert "3.11" in PYTHONS
