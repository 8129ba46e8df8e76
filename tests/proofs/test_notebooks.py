"""The notebooks run from beginning to end, and say so where recorded data are missing."""

from __future__ import annotations

import time
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from tests.support.notebook_files import NAMES, NOTEBOOKS, problems
from tests.support.paths import EXPERIMENTS

pytestmark = [pytest.mark.proof, pytest.mark.timeout(900)]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=NAMES)
def test_it_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HIL_DATA", str(tmp_path / "none"))
    monkeypatch.delenv("HIL_STATION", raising=False)
    (tmp_path / "experiments").symlink_to(EXPERIMENTS)
    notebook = nbformat.read(path, as_version=4)
    begun = time.monotonic()
    client = NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    print(f"{path.stem}: {time.monotonic() - begun:.0f} s")  # noqa: T201
    assert problems([cell for cell in notebook.cells if cell.cell_type == "code"]) == []
    text = "".join(cell.source for cell in notebook.cells)
    if "HIL_DATA" in text:
        told = [out.text for cell in notebook.cells for out in cell.get("outputs", [])
                if out.output_type == "stream"]  # fmt: skip
        assert any(line.startswith("left out: ") for line in told)
    assert [one.name for one in tmp_path.iterdir()] == ["experiments"]
