"""The notebooks of experiments/notebooks, for tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.support.paths import EXPERIMENTS

NOTEBOOKS = sorted((EXPERIMENTS / "notebooks").glob("*.ipynb"))
NAMES = [path.stem for path in NOTEBOOKS]


def code_cells(path: Path) -> list[dict[str, Any]]:
    """Those with code, as they are in the file."""
    cells: list[dict[str, Any]] = json.loads(path.read_text("utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def problems(cells: list[dict[str, Any]]) -> list[str]:
    """Cells that were not executed in order, or that said something went wrong."""
    found = []
    for k, cell in enumerate(cells, 1):
        if cell["execution_count"] != k:
            found.append(f"cell {k} was executed as {cell['execution_count']}")
        for output in cell["outputs"]:
            if output["output_type"] == "error" or output.get("name") == "stderr":
                found.append(f"cell {k}: {output.get('ename') or output['text']}")
    return found
