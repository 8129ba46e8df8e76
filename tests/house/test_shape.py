"""`make shape`: the packages in order, with files, lines, importers and import circles."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import grimp
import pytest

from tests.house import shape
from tests.support.paths import ROOT

FILES = {
    "hil/__init__.py": "from hil.robots import Robot\n",
    "hil/api.py": "from hil.core import errors\nfrom .robots._arm import Arm\n",
    "hil/core/__init__.py": "",
    "hil/core/errors.py": "import json\n\ndef raise_it():\n    from hil.core import hints\n",
    "hil/core/hints.py": "from . import errors\n",
    "hil/robots/__init__.py": "import lazy_loader\n",
    "hil/robots/__init__.pyi": "from ._arm import Arm as Robot\n",
    "hil/robots/_arm.py": """\
from typing import TYPE_CHECKING

from ..core import errors

if TYPE_CHECKING:
    from hil.robots import _joint


class Arm:
    def move(self) -> None:
        import torch

        from hil.robots import _plan
""",
    "hil/robots/_joint.py": "from hil.robots import _arm\n",
    "hil/robots/_plan.py": "from hil.robots import Robot\n",
}
CONTRACT = """
[[tool.importlinter.contracts]]
name = "order"
type = "layers"
containers = ["hil"]
layers = ["api", "robots | (other)", "core"]
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8")
    (tmp_path / "pyproject.toml").write_text("[project]\nname = 'hil'\n", "utf-8")
    return tmp_path


def printed(root: Path) -> str:
    command = [sys.executable, str(ROOT / "tests" / "house" / "shape.py"), str(root)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def rows(text: str) -> list[list[str]]:
    return [line.replace(" / ", "/").split() for line in text.splitlines() if line[:3] == "hil"]


def test_each_package_has_a_row_and_the_whole_has_one(checkout: Path) -> None:
    assert rows(printed(checkout)) == [
        # package, files, lines, median, imported by none/one/more, reached, functions, typing
        ["hil.core", "3", "5", "1", "1", "1", "1", "1", "1/0", "0"],
        ["hil.robots", "4", "17", "2", "0", "2", "2", "1", "1/1", "1"],
        ["hil.(root)", "2", "3", "2", "2", "0", "0", "0", "0/0", "0"],
        ["hil", "9", "25", "1", "3", "3", "3", "2", "2/1", "1"],
    ]


def test_packages_stand_in_the_order_of_the_layers(checkout: Path) -> None:
    (checkout / "hil" / "alone").mkdir()
    (checkout / "hil" / "alone" / "__init__.py").write_text("", "utf-8")
    with (checkout / "pyproject.toml").open("a") as file:
        file.write(CONTRACT)
    names = [row[0] for row in rows(printed(checkout))]
    assert names == ["hil.core", "hil.robots", "hil.alone", "hil.(root)", "hil"]


def test_circles_are_counted_by_when_they_are_imported(checkout: Path) -> None:
    text = printed(checkout).partition("import circles")[2].splitlines()
    assert [line[46:].split("  ")[-1].strip() for line in text[1:5]] == ["none"] * 4
    assert [line[46:62].strip() for line in text[1:5]] == [
        "none",
        "1, largest 2",
        "2, largest 3",
        "2, largest 4",
    ]
    assert "  3  hil.robots hil.robots._arm hil.robots._plan" in text


@pytest.mark.thorough
@pytest.mark.parametrize("with_typing", [True, False])
def test_the_graph_is_the_one_that_the_contracts_judge(with_typing: bool) -> None:
    modules = shape.read_modules(ROOT)
    whens = [shape.ALWAYS, shape.FUNCTION, *([shape.TYPING] if with_typing else [])]
    judged = grimp.build_graph(
        *shape.FOLDERS, cache_dir=None, exclude_type_checking_imports=not with_typing
    )
    imported = {name: judged.find_modules_directly_imported_by(name) for name in modules}
    assert shape.import_graph(modules, whens) == imported


@pytest.mark.thorough
def test_lines_fit_the_screen() -> None:
    assert max(map(len, printed(ROOT).splitlines())) <= shape.WIDTH
