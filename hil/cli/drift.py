"""`hil drift`: test whether a robot has changed since its champion was fitted."""

from pathlib import Path
from typing import Annotated, Any

import typer

from hil.cli.options import REGISTRY, JsonFlag, NameArgument, RegistryOption, RunsOption
from hil.cli.output import print_json, print_table

app = typer.Typer()


@app.command()
def drift(
    name: NameArgument,
    probes: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[PROBE]...",
            help="Runs or MCAP files, oldest first; default: none, show the earlier results.",
            show_default=False,
        ),
    ] = None,
    false_alarm: Annotated[
        float,
        typer.Option(
            help="Largest probability that a probe of an unchanged robot is reported as changed."
        ),
    ] = 0.01,
    page: Annotated[
        Path | None,
        typer.Option(metavar="FILE.html", help="Also write an HTML page with plots of all probes."),
    ] = None,
    registry: RegistryOption = REGISTRY,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Report whether a robot has changed: compare recordings (probes) with its champion model."""
    from hil.models import Registry, assess, probes_of
    from hil.runs import find_source

    home = Registry(registry)
    if probes:
        sources = [find_source(probe, runs) for probe in probes]
        judged = [assess(home, name, source, false_alarm=false_alarm) for source in sources]
    else:
        home.aliases(name)  # raises if there is no such name
        judged = probes_of(home, name)
    if page is not None:
        from hil.report import write_drift_page

        write_drift_page(home, name, page)
    documents = [probe.to_dict() for probe in judged]
    if json:
        print_json({"name": name, "probes": documents})
        return
    if documents:
        header = ("recorded (UTC)", "probe", "champion", "changed", "result")
        print_table(header, [_row(document) for document in documents])
    else:
        typer.echo(f"no probes of {name} yet: hil drift {name} PROBE")
    if page is not None:
        typer.echo(f"page: {page}")


def _row(probe: dict[str, Any]) -> tuple[str, ...]:
    changed = "yes" if probe["changed"] else "no"
    name = Path(probe["source"]).name
    return probe["at"][:16], name, f"v{probe['champion']}", changed, probe["text"]
