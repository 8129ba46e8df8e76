"""`hil mock`: simulated robots and their true parameters."""

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import JsonFlag
from hil.cli.output import print_json, print_table
from hil.core import PluginError

USUAL_MODEL = "ur5"
"""Name of the arm of a mock that lacks the attribute `model`."""

app = typer.Typer()


@app.command(context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
def mock(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the mock; `list` shows all.")] = "list",
    model: Annotated[
        str | None,
        typer.Option(help="Built-in arm to simulate; default: the usual arm of the mock."),
    ] = None,
    seed: Annotated[
        int, typer.Option(help="Seed of the individual robot: its parameters vary with the seed.")
    ] = 0,
    profile: Annotated[
        str, typer.Option(help="Physics: `full` or `ideal` (no friction memory, noise or heat).")
    ] = "full",
    truth: Annotated[
        Path | None,
        typer.Option("--ground-truth", help="Write the true parameters of the mock to this file."),
    ] = None,
    help_: Annotated[
        bool,
        typer.Option("--help", "-h", help="Show this help, or the options of the mock NAME."),
    ] = False,
    json: JsonFlag = False,
) -> None:
    """List mock robots, start one, or write its ground truth for scoring.

    `hil mock ur --speed 10` runs a mock UR controller until Ctrl-C; `hil mock ur --help` lists
    its options.
    """
    from hil.core import plugins

    if "--truth" in context.args:
        context.fail("--truth is now --ground-truth.")
    chosen = None if name == "list" else plugins.load("hil.mocks", name)()
    if help_ and not hasattr(chosen, "serve"):
        typer.echo(context.get_help())
        return
    if chosen is None:
        _list_mocks(json)
        return
    if help_:
        raise typer.Exit(chosen.serve([*context.args, "--help"]))
    model = model or getattr(chosen, "model", USUAL_MODEL)
    same = ["--model", model, "--seed", str(seed), "--profile", profile]
    if hasattr(chosen, "serve") and truth is None:
        raise typer.Exit(chosen.serve([*same, *context.args]))
    if truth is None or context.args:
        raise PluginError(
            f"the {name} mock runs inside `hil run`; there is nothing to start"
            if truth is None
            else f"hil mock --ground-truth does not accept {' '.join(context.args)}",
            hint=f"write the true parameters: hil mock {name} --ground-truth truth.json",
        )
    chosen.write_truth(truth, model=model, seed=seed, profile=profile)
    if json:
        print_json({"truth": str(truth), "model": model, "seed": seed, "profile": profile})
    else:
        typer.echo(str(truth))


def _list_mocks(json: bool) -> None:
    from hil.core import plugins

    mocks = {
        name: plugins.load("hil.mocks", name).description for name in plugins.names("hil.mocks")
    }
    if json:
        print_json([{"name": name, "description": text} for name, text in mocks.items()])
    else:
        print_table(("mock", "what"), mocks.items())
