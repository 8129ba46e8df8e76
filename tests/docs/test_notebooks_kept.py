"""The notebooks that ship were executed, in order, without errors; nothing of a machine in them."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path

import pytest

from tests.support.notebook_files import NAMES, NOTEBOOKS, code_cells, problems
from tests.support.paths import DOCS

PATHS = re.compile(r"/(?:work|tmp|home|root|Users|opt|private|mnt)/|[A-Z]:\\\\")
A_MIB = 1 << 20

each = pytest.mark.parametrize("path", NOTEBOOKS, ids=NAMES)


def test_there_is_one_per_paper_and_the_page_names_them() -> None:
    assert NAMES == ["friction_networks", "static_separation"]
    page = (DOCS / "how-to" / "lab-scripts.md").read_text("utf-8")
    assert all(f"(../../experiments/notebooks/{name}.ipynb)" in page for name in NAMES)


@each
def test_every_cell_was_executed_in_order_without_an_error(path: Path) -> None:
    cells = code_cells(path)
    assert problems(cells) == []
    assert sum(bool(cell["outputs"]) for cell in cells) >= 8
    images = [
        out for cell in cells for out in cell["outputs"] if "image/png" in out.get("data", {})
    ]
    assert len(images) >= 2


def test_what_is_wrong_with_a_notebook_is_found() -> None:
    cells = code_cells(NOTEBOOKS[0])[:2]
    twisted = [copy.deepcopy(cell) for cell in reversed(cells)]
    twisted[0]["outputs"] = [{"output_type": "error", "ename": "FitError"}]
    assert problems(twisted) == [
        "cell 1 was executed as 2", "cell 1: FitError", "cell 2 was executed as 1",
    ]  # fmt: skip


@each
def test_it_is_small_and_tells_nothing_of_a_machine(path: Path) -> None:
    text = path.read_text("utf-8")
    assert len(text) < A_MIB
    assert PATHS.findall(text) == []
    document = json.loads(text)
    assert document["metadata"].keys() == {"kernelspec", "language_info"}
    assert document["metadata"]["language_info"] == {"name": "python"}
    assert all(cell["metadata"] == {} for cell in document["cells"])


@each
def test_leaky_protocols_are_called_so(path: Path) -> None:
    cells = json.loads(path.read_text("utf-8"))["cells"]
    headings = [line for cell in cells for line in cell["source"] if line.startswith("## ")]
    assert any("**leaky**" in line for line in headings)
    assert any("**honest**" in line for line in headings)
