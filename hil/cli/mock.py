"""`hil mock`: simulated robots, and the truth about them."""

from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import JsonFlag
from hil.cli.output import print_json, print_table
from hil.core import PluginError

USUAL_MODEL = "ur5"
"""Of mocks that do not say which arm they usually stand for (attribute `model`)."""

app = typer.Typer()


@app.command(context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
def mock(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Which mock; `list` names them.")] = "list",
    model: Annotated[
        str | None,
        typer.Option(help="Built-in arm the mock stands for; without, the mock's usual one."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Which individual robot it is.")] = 0,
    profile: Annotated[str, typer.Option(help="`full` or `ideal` physics.")] = "full",
    truth: Annotated[
        Path | None, typer.Option("--truth", help="Write every true parameter to this file.")
    ] = None,
    help_: Annotated[
        bool,
        typer.Option("--help", "-h", help="Show this, or what the mock NAME is started with."),
    ] = False,
    json: JsonFlag = False,
) -> None:
    """List mock robots, start one, or write the truth of one, for scoring what was identified.

    `hil mock ur --speed 10` runs a UR controller until Ctrl-C; `hil mock ur --help` has the rest.
    """
    from hil.core import plugins

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
            else f"hil mock --truth takes no {' '.join(context.args)}",
            hint=f"to write its true parameters: hil mock {name} --truth truth.json",
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
