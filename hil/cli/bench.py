"""`hil bench`: speed and memory as ratios to a peer program that is measured in the same run.

The benchmarks are in the folder `benchmarks/` of a checkout and are not part of the wheel. Each
benchmark is a file with a function `run(quick, …)` that returns `{name, figures, ratios}`. The
first line of a benchmark file describes the benchmark.
"""

import ast
import importlib.util
import inspect
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli.options import JsonFlag
from hil.cli.output import fold, print_json, print_table
from hil.core import PluginError, did_you_mean

app = typer.Typer()


@app.command()
def bench(
    name: Annotated[
        str, typer.Argument(help="Name of the benchmark; `list` shows all, `all` runs all.")
    ],
    quick: Annotated[bool, typer.Option("--quick", help="Run a smaller problem.")] = False,
    kills: Annotated[
        int | None, typer.Option("--kills", min=1, help="crash: number of kills.")
    ] = None,
    hours: Annotated[
        float | None, typer.Option("--hours", min=0.01, help="soak: simulated hours.")
    ] = None,
    mock: Annotated[
        bool,
        typer.Option(
            "--mock", help="soak: record a moving mock UR5e instead of random rows; slower."
        ),
    ] = False,
    seed: Annotated[
        list[int] | None,
        typer.Option(
            "--seed",
            min=0,
            help="Random seed; repeatable. It selects robots (static, mock_identification, "
            "lagrangian, networks), rows (lm) or start points (excite).",
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Run benchmarks; each compares hil with a peer in the same run."""
    if name == "list":
        described = {one: _description(one) for one in benchmarks()}
        if json:
            print_json([{"name": one, "description": text} for one, text in described.items()])
        else:
            print_table(("benchmark", "what"), described.items())
        return
    options = {"kills": kills, "hours": hours, "mock": mock, "seeds": seed}
    options = {option: value for option, value in options.items() if value}
    documents = [
        measure(one, quick=quick, **options) for one in (benchmarks() if name == "all" else [name])
    ]
    if json:
        print_json(documents if name == "all" else documents[0])
    else:
        for document in documents:
            _print(document)


TABLE_WIDTH = 100
"""Maximum width of the notes below tables [columns of the terminal]."""


def _print(document: dict[str, Any]) -> None:
    typer.echo(document["name"])
    for table in document.get("tables", ()):
        typer.echo(f"\n{table['title']}")
        print_table(table["header"], table["rows"])
        for note in table["notes"]:
            typer.echo(fold(f"  {note}", TABLE_WIDTH))
    for part in ("figures", "ratios"):
        rows = [(f"  {key}", f"{value:.4g}") for key, value in document[part].items()]
        if rows:
            print_table((f"  {part}", ""), rows)
    for peer, reason in document.get("skipped", {}).items():
        typer.echo(f"  {peer} not measured: {reason}")


FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


def benchmarks() -> list[str]:
    """Return the names of the benchmarks of this checkout.

    Raises:
        PluginError: The program `hil` is not running from a checkout.
    """
    if not FOLDER.is_dir():
        raise PluginError(
            "benchmarks exist only in a checkout, but hil is installed from a wheel",
            hint="clone the repository and run `hil bench` there",
        )
    return sorted(file.stem for file in FOLDER.glob("*.py") if not file.stem.startswith("_"))


def _description(name: str) -> str:
    """Return the first line of a benchmark's file, without importing the file."""
    text = ast.get_docstring(ast.parse((FOLDER / f"{name}.py").read_text("utf-8"))) or ""
    return text.partition("\n")[0]


def measure(name: str, *, quick: bool = False, **options: Any) -> dict[str, Any]:
    """Run one benchmark and return `{name, figures, ratios}`.

    Args:
        name: Name of the benchmark, one of `benchmarks`.
        quick: Whether to run the smaller problem of the benchmark, for tests.
        options: Further options of this benchmark by name, such as `kills` of `crash`.

    Raises:
        PluginError: The benchmark or one of its options is unknown.
    """
    if name not in benchmarks():
        raise PluginError(f"unknown benchmark {name!r}", hint=did_you_mean(name, benchmarks()))
    module_spec = importlib.util.spec_from_file_location(f"bench_{name}", FOLDER / f"{name}.py")
    assert module_spec is not None
    assert module_spec.loader is not None
    module = importlib.util.module_from_spec(module_spec)
    sys.modules[module_spec.name] = module  # dataclasses look their types up there
    if (root := str(FOLDER.parent)) not in sys.path:
        sys.path.append(root)  # a benchmark's own modules are `benchmarks.…`
    module_spec.loader.exec_module(module)
    known = inspect.signature(module.run).parameters
    if unknown := [option for option in options if option not in known]:
        raise PluginError(
            f"the benchmark {name} has no option {unknown[0]}",
            hint=f"its options are {', '.join(known)}",
        )
    document: dict[str, Any] = module.run(quick=quick, **options)
    return document
