"""`hil fleet`: many robots of one station."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli import fleet_models
from hil.cli.fleet_models import FolderArgument, WorkersOption
from hil.cli.output import JsonFlag, RunsOption, SpecPath, StationOption, print_json, print_table
from hil.cli.running import OperatorOption, WaiveOption

if TYPE_CHECKING:
    from hil.campaign.series import Ended
    from hil.fleet.folder import FleetFolder
    from hil.fleet.run import FleetReport

app = typer.Typer(
    no_args_is_help=True,
    help="Many robots of one station: run, fit, report.",
)


def register(parent: typer.Typer) -> None:
    """Add this group's verbs."""
    fleet_models.register(app)
    parent.add_typer(app, name="fleet")


@app.command()
def run(
    spec: SpecPath,
    robots: Annotated[
        list[str],
        typer.Option("--robots", help="Such as 'ur5-*'; repeat for several.", show_default=False),
    ],
    station: StationOption = None,
    workers: WorkersOption = 0,
    runs: RunsOption = Path("runs"),
    operator: OperatorOption = "",
    waive: WaiveOption = None,
    json: JsonFlag = False,
) -> None:
    """Run an experiment on many robots of a station; its own `robot` is replaced by each."""
    from hil.campaign.experiment import find_station
    from hil.fleet.folder import FleetFolder
    from hil.fleet.members import experiment_for, robots_like, spec_for

    bench, _, where = find_station(spec.resolve().parent, station)
    text = spec.read_text("utf-8")
    specs = {name: spec_for(text, str(spec), name) for name in robots_like(bench, robots, where)}
    file = where if Path(where).is_file() else ""
    first = next(iter(specs.values()))
    named = Path(file) if file else None
    experiment = experiment_for(first, spec.resolve().parent, named, spec)
    folder = FleetFolder.create(runs, experiment.spec.name, specs, spec, file)
    _run(folder, [{"robot": name} for name in specs], workers, operator, waive, json)


@app.command()
def resume(
    folder: FolderArgument,
    workers: WorkersOption = 0,
    operator: OperatorOption = "",
    waive: WaiveOption = None,
    json: JsonFlag = False,
) -> None:
    """Go on with a fleet: with runs that ended early, and robots that were not begun."""
    from hil.fleet.folder import FleetFolder

    opened, members = FleetFolder.open(folder)
    _run(opened, members, workers, operator, waive, json)


def _run(
    folder: FleetFolder,
    members: list[dict[str, Any]],
    workers: int,
    operator: str,
    waive: list[str] | None,
    json: bool,
) -> None:
    from hil.cli.attended import waivers_of
    from hil.engine.signals import ignore_from_now_on
    from hil.executor import cores
    from hil.fleet.run import run_fleet
    from hil.fleet.workers import Manner

    def tell(ended: Ended, number: int, total: int) -> None:
        why = f": {ended.error.message}" if ended.error else ""
        typer.echo(f"{number} of {total}: {ended.robot}: {ended.word}{why}", err=True)

    manner = Manner(workers or cores(), operator, waivers_of(waive or ()))
    with folder.held():
        report = run_fleet(folder, members, manner, tell)
    ignore_from_now_on()
    _tell(report, json)


def _tell(report: FleetReport, json: bool) -> None:
    from hil.cli.runs import fail

    if json:
        print_json(report.to_dict())
    else:
        rows = [(one.robot, one.word, Path(one.report.get("run", "")).name) for one in report.ended]
        rows += [(name, "not begun", "") for name in report.left]
        print_table(("robot", "came of it", "run"), rows)
        typer.echo(f"fleet: {report.folder}")
    if (error := report.error) is None:
        return
    if report.left or not all(one.measured for one in report.ended):
        hint = f"when the cause is mended: hil fleet resume {report.folder}"
        error.hint = f"{error.hint}; {hint}" if error.hint else hint
    fail(error, json)
