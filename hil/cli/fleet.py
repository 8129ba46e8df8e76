"""`hil fleet`: many robots of one station."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.cli import fleet_models
from hil.cli.attended import OperatorOption, WaiveOption, YesFlag, waivers_of
from hil.cli.fleet_models import FolderArgument, WorkersOption
from hil.cli.output import JsonFlag, RunsOption, SpecPath, StationOption, print_json, print_table

if TYPE_CHECKING:
    from hil.maintenance import FleetReport, Manner
    from hil.recording import FleetGroup, Member
    from hil.workflow import Moves

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
        typer.Option(
            "--robots",
            help="Robot name pattern such as 'ur5-*', or a YAML file of real robots with their "
            "addresses; repeatable.",
            show_default=False,
        ),
    ],
    station: StationOption = None,
    workers: WorkersOption = 0,
    runs: RunsOption = Path("runs"),
    operator: OperatorOption = "",
    waive: WaiveOption = None,
    yes: YesFlag = False,
    json: JsonFlag = False,
) -> None:
    """Run an experiment on many robots of a station; its own `robot` is replaced by each."""
    from hil.core import cores
    from hil.maintenance import Manner, robots_like, robots_named, spec_for
    from hil.planning import find_station
    from hil.recording import FleetGroup
    from hil.workflow import confirm_together

    waived = waivers_of(waive or ())
    bench, _, where = find_station(spec.resolve().parent, station)
    text, (patterns, naming, named) = spec.read_text("utf-8"), robots_named(robots)
    specs = {name: spec_for(text, str(spec), name) for name in robots_like(bench, patterns, where)}
    file = where if Path(where).is_file() else ""
    moves = _moves(specs, spec, file, naming, named)
    confirmed = confirm_together(moves, who=operator, yes=yes)
    name = next(iter(moves.experiments.values())).spec.name
    fleet = FleetGroup.create(runs, name, specs, spec, file, robots=naming if named else None)
    _run(fleet, Manner(workers or cores(), operator, waived, confirmed), json)


@app.command()
def resume(
    folder: FolderArgument,
    workers: WorkersOption = 0,
    operator: OperatorOption = "",
    waive: WaiveOption = None,
    yes: YesFlag = False,
    json: JsonFlag = False,
) -> None:
    """Go on with a fleet: with runs that ended early, and robots that were not begun."""
    from hil.core import cores
    from hil.maintenance import Manner, robots_left, robots_named
    from hil.recording import FleetGroup
    from hil.workflow import confirm_together

    fleet = FleetGroup.open(folder)
    head, naming = fleet.head, fleet.head.get("robots")
    left = {name: fleet.spec_of(name).read_text("utf-8") for name in robots_left(fleet)}
    _, file, named = robots_named([naming] if naming else [])
    moves = _moves(left, Path(head["source"]), head["station"], file, named)
    confirmed = confirm_together(moves, who=operator, yes=yes)
    manner = Manner(workers or cores(), operator, waivers_of(waive or ()), confirmed)
    _run(fleet, manner, json)


def _moves(
    specs: Mapping[str, str], spec: Path, station: str, naming: Path, named: Mapping[str, str]
) -> "Moves":
    """Return what a fleet moves: the spec as each robot runs it, and the file that names robots."""
    from hil.maintenance import experiment_for
    from hil.workflow import Moves

    if not specs:
        return Moves(naming, named, {})
    at = Path(station) if station else None
    first = experiment_for(next(iter(specs.values())), spec.resolve().parent, at, spec)
    robots = first.station.robots  # the specs differ in nothing else: reading each takes too long
    members = {
        name: replace(first, spec=first.spec.model_copy(update={"robot": name}), robot=robots[name])
        for name in specs
        if name in robots
    }
    return Moves(naming, named, members)


def _run(fleet: "FleetGroup", manner: "Manner", json: bool) -> None:
    from hil.engine import ignore_from_now_on
    from hil.maintenance import run_fleet

    def tell(member: "Member", number: int, total: int) -> None:
        why = f": {member.error.message}" if member.error else ""
        typer.echo(f"{number} of {total}: {member.robot}: {member.word}{why}", err=True)

    with fleet.held():
        report = run_fleet(fleet, manner, tell)
    ignore_from_now_on()
    _tell(report, json)


def _tell(report: "FleetReport", json: bool) -> None:
    from hil.cli.runs import fail

    if json:
        print_json(report.to_dict())
    else:
        rows = [(one.robot, one.word, one.run.name if one.run else "") for one in report.members]
        rows += [(name, "not begun", "") for name in report.left]
        print_table(("robot", "result", "run"), rows)
        typer.echo(f"fleet: {report.folder}")
    if (error := report.error) is None:
        return
    if report.left or not all(one.measured for one in report.members):
        hint = f"when the cause is mended: hil fleet resume {report.folder}"
        error.hint = f"{error.hint}; {hint}" if error.hint else hint
    fail(error, json)
