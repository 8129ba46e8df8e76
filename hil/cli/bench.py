"""`hil bench`: speed and memory as ratios against a peer measured in the same run."""

from typing import Annotated, Any

import typer

from hil.cli.output import JsonFlag, fold, print_json, print_table

TABLE_WIDTH = 100


def register(app: typer.Typer) -> None:
    """Add this group's verb."""
    app.command()(bench)


def bench(
    name: Annotated[str, typer.Argument(help="Benchmark; `list` names them, `all` runs all.")],
    quick: Annotated[bool, typer.Option("--quick", help="A smaller problem.")] = False,
    kills: Annotated[
        int | None, typer.Option("--kills", min=1, help="crash: how often to kill.")
    ] = None,
    hours: Annotated[
        float | None, typer.Option("--hours", min=0.01, help="soak: how much to simulate.")
    ] = None,
    mock: Annotated[
        bool, typer.Option("--mock", help="soak: rows of a moving mock UR5e; takes longer.")
    ] = False,
    seed: Annotated[
        list[int] | None,
        typer.Option(
            "--seed",
            min=0,
            help="static, mock_identification, lagrangian, networks: robots; lm: rows; excite: "
            "starts. Repeatable.",
        ),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Measure; every ratio is against its peer in the same run."""
    from hil.cli import benchmarking

    if name == "list":
        _list(benchmarking.describe(), json)
        return
    given = {"kills": kills, "hours": hours, "mock": mock, "seeds": seed}
    options = {option: value for option, value in given.items() if value}
    chosen = benchmarking.names() if name == "all" else [name]
    documents = [benchmarking.measure(one, quick=quick, **options) for one in chosen]
    if json:
        print_json(documents if name == "all" else documents[0])
    else:
        for document in documents:
            _print(document)


def _list(known: dict[str, str], json: bool) -> None:
    if json:
        print_json([{"name": name, "description": told} for name, told in known.items()])
    else:
        print_table(("benchmark", "what"), list(known.items()))


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
        typer.echo(f"  {peer} left out: {reason}")
