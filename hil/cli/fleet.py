"""`hil fleet`: run, fit and compare many robots of one station.

The verbs `run` and `resume` move the robots; `fit`, `drift` and `report` only evaluate recordings.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.cli.options import (
    REGISTRY,
    JsonFlag,
    OperatorOption,
    ParametersOption,
    RegistryOption,
    RunsOption,
    SpecArgument,
    StationOption,
    WaiveOption,
    YesFlag,
    waivers_of,
)
from hil.cli.output import fail, ignore_from_now_on, print_json, print_table

if TYPE_CHECKING:
    from hil.maintenance import Manner
    from hil.models import RobotFit, RobotProbe
    from hil.recording import FleetGroup, Member
    from hil.workflow import Moves

FolderArgument = Annotated[
    Path, typer.Argument(help="Folder of the fleet: RUNS/DAY/fleet/NAME.", show_default=False)
]
WorkersOption = Annotated[
    int,
    typer.Option(
        "--workers",
        min=0,
        help="Number of robots processed in parallel; 0: one per core of this computer.",
    ),
]

app = typer.Typer(
    name="fleet",
    no_args_is_help=True,
    help="Run, fit and compare many robots of one station.",
)


@app.command()
def run(
    spec: SpecArgument,
    robots: Annotated[
        list[str],
        typer.Option(
            "--robots",
            help="Name pattern such as 'ur5-*', or a YAML file of real robots with their "
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
    """Run an experiment on many robots of a station."""
    from hil.core import cores
    from hil.maintenance import Manner, robots_like, robots_named, spec_for
    from hil.planning import find_station
    from hil.recording import FleetGroup
    from hil.workflow import confirm_together

    waivers = waivers_of(waive)
    bench, _, where = find_station(spec.resolve().parent, station)
    text, (patterns, naming, addresses) = spec.read_text("utf-8"), robots_named(robots)
    specs = {name: spec_for(text, str(spec), name) for name in robots_like(bench, patterns, where)}
    file = where if Path(where).is_file() else ""
    moves = _moves(specs, spec, file, naming, addresses)
    confirmed = confirm_together(moves, who=operator, yes=yes)
    name = next(iter(moves.experiments.values())).spec.name
    robots_file = naming if addresses else None
    fleet = FleetGroup.create(runs, name, specs, spec, file, robots=robots_file)
    _run(fleet, Manner(workers or cores(), operator, waivers, confirmed), json)


@app.command()
def resume(
    folder: FolderArgument,
    workers: WorkersOption = 0,
    operator: OperatorOption = "",
    waive: WaiveOption = None,
    yes: YesFlag = False,
    json: JsonFlag = False,
) -> None:
    """Complete the unfinished runs of a fleet and run the robots that were not started."""
    from hil.core import cores
    from hil.maintenance import Manner, robots_left, robots_named
    from hil.recording import FleetGroup
    from hil.workflow import confirm_together

    waivers = waivers_of(waive)
    fleet = FleetGroup.open(folder)
    head, naming = fleet.head, fleet.head.get("robots")
    left = {name: fleet.spec_of(name).read_text("utf-8") for name in robots_left(fleet)}
    _, file, addresses = robots_named([naming] if naming else [])
    moves = _moves(left, Path(head["source"]), head["station"], file, addresses)
    confirmed = confirm_together(moves, who=operator, yes=yes)
    _run(fleet, Manner(workers or cores(), operator, waivers, confirmed), json)


def _moves(
    specs: Mapping[str, str], spec: Path, station: str, naming: Path, addresses: Mapping[str, str]
) -> "Moves":
    """Return the motions of a fleet: the experiment of each robot, and the address file."""
    from hil.maintenance import experiment_for
    from hil.workflow import Moves

    if not specs:
        return Moves(naming, addresses, {})
    at = Path(station) if station else None
    first = experiment_for(next(iter(specs.values())), spec.resolve().parent, at, spec)
    robots = first.station.robots  # only the robots differ, so one spec is read
    members = {
        name: replace(first, spec=first.spec.model_copy(update={"robot": name}), robot=robots[name])
        for name in specs
        if name in robots
    }
    return Moves(naming, addresses, members)


def _run(fleet: "FleetGroup", manner: "Manner", json: bool) -> None:
    from hil.maintenance import run_fleet

    def tell(member: "Member", number: int, total: int) -> None:
        why = f": {member.error.message}" if member.error else ""
        typer.echo(f"{number} of {total}: {member.robot}: {member.word}{why}", err=True)

    with fleet.held():
        report = run_fleet(fleet, manner, tell)
    ignore_from_now_on()
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
        hint = f"after repairing the cause: hil fleet resume {report.folder}"
        error.hint = f"{error.hint}; {hint}" if error.hint else hint
    fail(error, json)


@app.command()
def fit(
    what: Annotated[
        list[str],
        typer.Argument(
            metavar="FOLDER|RUN...", help="Folder of a fleet, or runs.", show_default=False
        ),
    ],
    estimator: Annotated[
        str,
        typer.Option("--estimator", "-e", help="Name of the estimator; `hil plugins` lists all."),
    ],
    options: ParametersOption = None,
    workers: WorkersOption = 0,
    dask: Annotated[
        str,
        typer.Option(
            "--dask",
            help="Address of the scheduler of a Dask cluster, to use instead of local processes.",
        ),
    ] = "",
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            help="Folder for the models; default: `models` in the folder of the fleet.",
        ),
    ] = None,
    register: Annotated[
        bool,
        typer.Option(
            "--register",
            help="Register each model under the name of its robot, as "
            "challenger or first champion.",
        ),
    ] = False,
    registry: RegistryOption = REGISTRY,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Fit one model per robot, in processes of this computer or on a Dask cluster."""
    from hil import api
    from hil.cli.progress import MovingLine
    from hil.core import FitError, HilError, RegistryError, checked_address, cores
    from hil.models import FitSettings, Registry, fit_runs, register_fit, store_fits

    sources, home = _runs_of(what, runs)
    address = checked_address("--dask", dask or None)
    settings = FitSettings(estimator, api.parse_parameters(options or ()))
    with MovingLine() as line:
        results = fit_runs(
            sources,
            settings,
            workers=workers or cores(),
            dask=address,
            on_progress=lambda done: line.show(f"{done} of {len(sources)} fitted"),
        )
        line.end(keep=True)
    fits = store_fits(sources, results, out or home)
    unwritten = []
    if register:
        for i, one in enumerate(fits):
            try:
                fits[i] = register_fit(one, Registry(registry))
            except HilError as refused:  # the other robots must still be registered
                fits[i] = replace(one, refused=refused.message)
                unwritten.append(one.robot)
    if json:
        print_json({"fits": [one.to_dict() for one in fits]})
    else:
        print_table(("robot", "RMSE [raw]", "criteria", "role", "model"), map(_fit_row, fits))
    if failed := [one for one in fits if one.error]:
        lack = "are not registered" if register else "have no model"
        first = f"{failed[0].robot}: {failed[0].error}"
        kind = RegistryError if len(unwritten) == len(failed) else FitError
        error = kind(
            f"{len(failed)} of {len(fits)} robots {lack}; {first}",
            hint="see the robots named above; the others are fitted",
        )
        fail(error, json)


def _runs_of(what: list[str], runs: Path) -> tuple[list[Path], Path]:
    """Return the runs of a fleet or the named runs, and the folder for the fitted models."""
    from hil.core import DataError
    from hil.recording import FleetGroup, RunDirectory
    from hil.runs import find_source

    if len(what) == 1 and FleetGroup.is_at(Path(what[0])):
        fleet = FleetGroup.open(Path(what[0]))
        if not (done := fleet.completed()):
            raise DataError(
                f"no robot of {fleet.path} has been measured",
                hint=f"hil fleet resume {fleet.path}",
            )
        return done, fleet.models
    return [RunDirectory.open(find_source(one, runs)).path for one in what], Path("models")


def _fit_row(fit: "RobotFit") -> tuple[str, ...]:
    rmse = fit.result.rmse
    mean = f"{sum(rmse) / len(rmse):.4f}" if rmse else ""
    word = {True: "met", False: "missed", None: ""}[fit.result.passed]
    run = "run rejected" if fit.verdict == "rejected" else ""
    role = " ".join(filter(None, (fit.registered, fit.role)))
    return fit.robot, mean, ", ".join(filter(None, (word, run))), role, fit.error or str(fit.model)


@app.command()
def drift(
    folder: FolderArgument,
    false_alarm: Annotated[
        float,
        typer.Option(
            help="Nominal probability that any robot is reported as changed if no robot has "
            "changed."
        ),
    ] = 0.01,
    registry: RegistryOption = REGISTRY,
    json: JsonFlag = False,
) -> None:
    """Test the runs of a fleet for drift, each against the champion of its robot."""
    from hil.core import DataError
    from hil.models import Registry, probe_fleet

    probes = probe_fleet(folder, Registry(registry), false_alarm)
    if json:
        print_json({"probes": [one.to_dict() for one in probes]})
    else:
        print_table(("robot", "changed", "result"), map(_drift_row, probes))
    if failed := [one for one in probes if one.error]:
        first = f"{failed[0].robot}: {failed[0].error}"
        error = DataError(
            f"{len(failed)} of {len(probes)} robots were not evaluated; {first}",
            hint="see the robots named above; the others were evaluated",
        )
        fail(error, json)


def _drift_row(one: "RobotProbe") -> tuple[str, ...]:
    if one.probe is None:
        return one.robot, "?", one.error
    what = "; ".join(filter(None, (one.probe.text, one.note)))
    return one.robot, "yes" if one.probe.changed else "no", what


@app.command()
def report(
    folder: FolderArgument,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="HTML page; default: in the folder of the fleet."),
    ] = None,
    workers: WorkersOption = 0,
    registry: RegistryOption = REGISTRY,
    json: JsonFlag = False,
) -> None:
    """Report drifted and outlying robots, and friction as a function of age and temperature."""
    from hil.core import cores
    from hil.models import Registry, survey_fleet
    from hil.recording import FleetGroup
    from hil.report import render_fleet, standing_out

    survey = survey_fleet(folder, Registry(registry), workers=workers or cores())
    page = render_fleet(survey, out or FleetGroup.page_in(folder))
    if json:
        print_json({**survey.to_dict(), "page": str(page)})
        return
    rows = [(one.robot, f"{one.age:.1f}", why) for one, why in standing_out(survey)]
    if rows:
        print_table(("robot", "years", "why"), rows)
    else:
        typer.echo(f"no drift and no outlier among {len(survey.robots)} robots")
    typer.echo(f"page: {page}")
