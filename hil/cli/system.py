"""`hil mock`, `hil doctor`, `hil plugins`: the bench itself."""

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from hil.cli.output import JsonFlag, print_json, print_table
from hil.core import PluginError

USUAL_MODEL = "ur5"
"""Of mocks that do not say which arm they usually stand for (attribute `model`)."""


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command(context_settings={"ignore_unknown_options": True, "allow_extra_args": True})(mock)
    app.command()(doctor)
    app.command()(plugins)


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
    from hil.core import plugins as found

    chosen = None if name == "list" else found.load("hil.mocks", name)()
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
    from hil.core import plugins as found

    entries = [
        {"name": n, "description": found.load("hil.mocks", n).description}
        for n in found.names("hil.mocks")
    ]
    if json:
        print_json(entries)
    else:
        print_table(("mock", "what"), [(e["name"], e["description"]) for e in entries])


def doctor(
    station: Annotated[
        Path | None,
        typer.Option("--station", help="Also ask the robots of this station; none is moved."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Look at this computer, and with --station at its robots; exits 1 when something is bad."""
    from hil.doctor import examine

    findings = examine(station)
    if json:
        print_json([f.to_dict() for f in findings])
    else:
        print_table(("", "what", "finding"), [(f.mark, f.what, f.finding) for f in findings])
    if any(f.bad for f in findings):
        raise typer.Exit(1)


def plugins(json: JsonFlag = False) -> None:
    """List drivers, estimators, excitations, checks, interlocks and mocks; broken ones and why."""
    from hil.core import describe_all

    found = describe_all()
    if json:
        print_json([dataclasses.asdict(p) for p in found])
    else:
        print_table(
            ("group", "name", "from", "state"),
            [(p.group, p.name, p.distribution, p.error or "ok") for p in found],
        )
