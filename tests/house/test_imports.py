"""Imports: light, at the top unless heavy, of names that exist, and told where missing."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from hil.core import plugins
from tests.support.paths import EXPERIMENTS, ROOT

# The core stays light: what `import hil` and `hil --help` may not load


NOT_AT_START = (
    "torch", "mujoco", "numba", "sklearn", "scipy", "plotly", "pinocchio", "rtde_control",
    "rtde_receive", "can", "canopen", "distributed", "mcap", "foxglove", "matplotlib",
    "starlette", "uvicorn", "playwright", "hil_mock_robot", "hil_drivers",
)  # fmt: skip


def loaded_after(code: str) -> set[str]:
    script = f"import sys\n{code}\nprint(*sys.modules, sep='\\n', file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return {name.split(".")[0] for name in done.stderr.split()}


@pytest.mark.thorough
@pytest.mark.parametrize(
    "code",
    [
        "import hil",
        "import hil.cli",
        "from typer.testing import CliRunner\nfrom hil.cli.app import app\n"
        "assert CliRunner().invoke(app, ['--help']).exit_code == 0",
    ],
    ids=["import hil", "import hil.cli", "hil --help"],
)
def test_nothing_heavy_is_loaded(code: str) -> None:
    assert loaded_after(code).isdisjoint(NOT_AT_START)


@pytest.mark.thorough
def test_pure_calculation_imports_nothing_that_only_posix_has() -> None:
    absent = "import sys\nfor n in ('fcntl', 'termios', 'resource', 'pwd'): sys.modules[n] = None\n"
    names = ("hil.arms.load_arm", "hil.dynamics.load_model", "hil.estimators.load_model_file",
             "hil.evaluation.evaluate", "hil.control.HandGuiding")  # fmt: skip
    code = "".join(f"from {n.rpartition('.')[0]} import {n.rpartition('.')[2]}\n" for n in names)
    assert "numpy" in loaded_after(f"{absent}{code}import hil.estimators.rigid_linear")


def test_the_api_appears_when_it_is_used() -> None:
    import hil

    assert callable(hil.load)
    assert "load" in dir(hil)
    with pytest.raises(AttributeError, match="frobnicate"):
        hil.frobnicate  # noqa: B018


# Imports stand at the top of a module, unless they load something heavy


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


# Every test module imports names that exist


OURS = ("hil", "hil_drivers", "hil_mock_robot")


def imported_names(file: Path) -> Iterator[tuple[str, str]]:
    """Module and name of each `from … import` of our packages, also inside functions."""
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in OURS:
            yield from ((str(node.module), alias.name) for alias in node.names)


def exists(module: str, name: str) -> bool:
    try:
        return hasattr(importlib.import_module(module), name) or bool(
            importlib.import_module(f"{module}.{name}")
        )
    except ModuleNotFoundError as error:
        # Tests of an extra that is not installed are skipped; only our own modules must be there.
        return (error.name or "").split(".")[0] not in OURS


@pytest.mark.thorough
def test_names_that_tests_import_exist() -> None:
    used: dict[tuple[str, str], str] = {}
    for file in sorted((ROOT / "tests").rglob("*.py")):
        used |= dict.fromkeys(imported_names(file), file.name)
    missing = [f"{file}: from {m} import {n}" for (m, n), file in used.items() if not exists(m, n)]
    assert missing == []


def test_no_test_file_imports_from_another() -> None:
    foreign = re.compile(r"from tests\.[a-z_.0-9]*\b(test_[a-z_0-9]+) import")
    found = [
        f"{file.name}: {name}"
        for file in sorted((ROOT / "tests").rglob("test_*.py"))
        for name in foreign.findall(file.read_text("utf-8"))
        if name != file.stem
    ]
    assert found == []


# Whatever is missing is told in one sentence, with the command that brings it; tried for real


CHILD = ROOT / "tests" / "house" / "missing_modules.py"
DWELL = EXPERIMENTS / "ci_dwell_12.yaml"
BAGS = EXPERIMENTS / "maps" / "ros2_joint_states.yaml"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("modules", "words", "told", "extra"),
    [
        ("uvicorn", ("serve", "--port", "0"), "the dashboard needs uvicorn, which is", "web"),
        ("starlette,uvicorn", ("serve",), "needs starlette and uvicorn, which are", "web"),
        ("numba", ("run", DWELL), "the mock robot needs numba, which is", "mock"),
        ("numba", ("mock", "ur", "--port", "0"), "the mock robot needs numba, which is", "mock"),
        ("foxglove", ("run", DWELL, "--live"), "the live view needs foxglove, which is", "live"),
        (
            "rosbags",
            ("import", EXPERIMENTS, "--map", BAGS, "-o", "x.mcap"),
            "reading ROS 2 bags needs rosbags, which is",
            "bags",
        ),
    ],
)
def test_a_verb_without_its_extra_says_so(
    modules: str, words: tuple[str | Path, ...], told: str, extra: str, tmp_path: Path
) -> None:
    command = [sys.executable, CHILD, modules, *words]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=100)
    assert f"{told} not installed\n" in done.stderr
    assert f'pip install "hil[{extra}]"' in done.stderr
    assert done.returncode not in (0, 1)


def test_one_module_is_and_several_are_not_installed() -> None:
    one = plugins.not_installed("this", ["torch"], "learn", purpose="to train")
    assert one.message == "this needs torch, which is not installed, to train"
    some = plugins.not_installed("this", ["a", "b", "c"], "x", "y", otherwise="do without")
    assert some.message == "this needs a, b and c, which are not installed"
    assert some.hint == 'pip install "hil[x,y]", or do without'
