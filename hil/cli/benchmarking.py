"""Find and run the benchmarks, which live in `benchmarks/` of a checkout and not in the wheel."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import sys
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from hil.core import PluginError

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


def names() -> list[str]:
    """Names of the benchmarks of this checkout.

    Raises:
        PluginError: `hil` is not running from a checkout.
    """
    if not FOLDER.is_dir():
        raise PluginError(
            "benchmarks are part of a checkout and this is an installed wheel",
            hint="clone the repository and run `hil bench` there",
        )
    return sorted(f.stem for f in FOLDER.glob("*.py") if not f.stem.startswith("_"))


def describe() -> dict[str, str]:
    """What each benchmark measures, in one line: the first of its file. Nothing is imported."""
    return {name: _first_line(FOLDER / f"{name}.py") for name in names()}


def _first_line(file: Path) -> str:
    told = ast.get_docstring(ast.parse(file.read_text("utf-8"))) or ""
    return told.partition("\n")[0]


def measure(name: str, *, quick: bool = False, **options: Any) -> dict[str, Any]:
    """Run one benchmark and return `{name, figures, ratios}`.

    Args:
        name: As listed by `names`.
        quick: Use the smaller problem, for tests.
        options: What else this benchmark can be told, such as `kills` of `crash`.

    Raises:
        PluginError: There is no such benchmark, or it has no such option.
    """
    if name not in names():
        close = get_close_matches(name, names(), n=1)
        did_you_mean = f"did you mean {close[0]!r}? " if close else ""
        raise PluginError(
            f"there is no benchmark {name!r}",
            hint=f"{did_you_mean}there are {', '.join(names())}",
        )
    module_spec = importlib.util.spec_from_file_location(f"bench_{name}", FOLDER / f"{name}.py")
    assert module_spec is not None
    assert module_spec.loader is not None
    module = importlib.util.module_from_spec(module_spec)
    sys.modules[module_spec.name] = module  # where dataclasses look their types up
    if (root := str(FOLDER.parent)) not in sys.path:
        sys.path.append(root)  # a benchmark's own modules are `benchmarks.…`
    module_spec.loader.exec_module(module)
    known = inspect.signature(module.run).parameters
    if unknown := [option for option in options if option not in known]:
        raise PluginError(
            f"the benchmark {name} has no option {unknown[0]}",
            hint=f"it has {', '.join(known)}",
        )
    document: dict[str, Any] = module.run(quick=quick, **options)
    return document
