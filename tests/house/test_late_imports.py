"""Imports stand at the top of a module, unless they load something heavy.

An import inside a function hides a circle. It is allowed in the faces that have to start fast, and
where it brings in a heavy package that the module has not loaded already.
"""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.support.paths import ROOT

ROOTS = ("hil", "drivers/hil_drivers", "mock_robot/hil_mock_robot")
HEAVY = {
    "apscheduler", "can", "canopen", "clarabel", "cvxpy", "distributed", "filelock", "foxglove",
    "jinja2", "markupsafe", "matplotlib", "mcap", "mujoco", "numba", "onnx", "onnxruntime",
    "onnxscript", "pinocchio", "plotly", "pyads", "pyarrow", "rosbags", "rtde_control",
    "rtde_receive", "ruckig", "safetensors", "scipy", "sklearn", "sse_starlette", "starlette",
    "threadpoolctl", "torch", "uvicorn", "yaml",
}  # fmt: skip
START_FAST = ("hil.cli.", "hil.testing.plugin.")

Import = ast.Import | ast.ImportFrom


@cache
def modules() -> dict[str, Path]:
    """Every module of the product, by its dotted name."""
    found = {}
    for root in ROOTS:
        for path in (ROOT / root).rglob("*.py"):
            parts = (Path(root).name, *path.relative_to(ROOT / root).with_suffix("").parts)
            found[".".join(parts).removesuffix(".__init__")] = path
    return found


@cache
def face(package: str) -> dict[str, str]:
    """Names that a package hands out, and the modules they are from."""
    stub = modules()[package].with_suffix(".pyi") if package in modules() else Path("none")
    if not stub.is_file():
        return {}
    tree = ast.parse(stub.read_text("utf-8"))
    lines = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return {a.name: f"{package}.{line.module or a.name}" for line in lines for a in line.names}


def targets(node: Import) -> Iterator[str]:
    """Modules that an import loads, those behind a face included."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
        return
    module = node.module or ""
    for alias in node.names:
        whole = f"{module}.{alias.name}"
        yield whole if whole in modules() else face(module).get(alias.name, module)


def top_imports(body: list[ast.stmt]) -> Iterator[Import]:
    """Imports that run when a module is loaded."""
    for node in body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif isinstance(node, ast.Try | ast.If) and "TYPE_CHECKING" not in ast.unparse(node):
            yield from top_imports(node.body)


@cache
def tree(module: str) -> ast.Module:
    return ast.parse(modules()[module].read_text("utf-8"))


@cache
def loaded_by(module: str) -> frozenset[str]:
    """Heavy packages that importing a module loads."""
    seen, open_, heavy = {module}, [module], set[str]()
    while open_:
        name = open_.pop()
        heavy |= {name.partition(".")[0]} & HEAVY
        if name not in modules():
            continue
        further = {t for node in top_imports(tree(name).body) for t in targets(node)} - seen
        seen |= further
        open_ += further
    return frozenset(heavy)


def late_imports(module: str) -> Iterator[Import]:
    """Imports inside the functions of a module."""
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield from (n for n in ast.walk(node) if isinstance(n, ast.Import | ast.ImportFrom))


def is_excused(module: str, node: Import) -> bool:
    """Whether an import inside a function is of a heavy package, or brings one in."""
    if {target.partition(".")[0] for target in targets(node)} & HEAVY:
        return True
    return bool(frozenset().union(*map(loaded_by, targets(node))) - loaded_by(module))


@pytest.mark.thorough
def test_imports_inside_functions_load_something_heavy() -> None:
    late = defaultdict(set)
    for module in modules():
        if not f"{module}.".startswith(START_FAST) and module != "hil":
            for node in late_imports(module):
                if not is_excused(module, node):
                    late[str(modules()[module].relative_to(ROOT))].add(node.lineno)
    assert not late


@pytest.mark.parametrize(
    ("text", "excused"), [("import torch", True), ("from hil.core import HilError", False)]
)
def test_the_rule_tells_heavy_from_light(text: str, excused: bool) -> None:
    (node,) = ast.parse(text).body
    assert isinstance(node, ast.Import | ast.ImportFrom)
    assert is_excused("hil.core.errors", node) is excused


def test_every_folder_of_the_product_is_a_package_that_the_walls_see() -> None:
    for root in ROOTS:
        folders = {path.parent for path in (ROOT / root).rglob("*.py")}
        assert not {folder for folder in folders if not (folder / "__init__.py").is_file()}


@pytest.mark.thorough
def test_no_name_of_a_private_module_stands_in_a_string_of_another_package() -> None:
    """What an import contract cannot see; entry points and lists within a package are fine."""
    named = re.compile(r"^(hil\.\w+)\.\w[\w.]*$")
    found = {
        (module, node.value)
        for module in modules()
        for node in ast.walk(tree(module))
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and (match := named.match(node.value))
        and node.value in modules()
        and not f"{module}.".startswith(f"{match[1]}.")
    }
    assert not found
