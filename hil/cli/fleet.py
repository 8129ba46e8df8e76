"""`hil fleet`: many robots of one station."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hil.cli.output import JsonFlag, RunsOption, SpecPath, StationOption, print_json, print_table
from hil.cli.registry import HERE, RegistryOption
from hil.cli.running import OperatorOption, WaiveOption

if TYPE_CHECKING:
    from hil.campaign.series import Ended
    from hil.fleet.fitting import RobotFit
    from hil.fleet.folder import FleetFolder
    from hil.fleet.run import FleetReport

FolderArgument = Annotated[
    Path, typer.Argument(help="Folder of the fleet: RUNS/DAY/fleet/NAME.", show_default=False)
]
WorkersOption = Annotated[
    int, typer.Option("--workers", min=0, help="At a time; 0: one per core of this computer.")
]

app = typer.Typer(
    no_args_is_help=True,
    help="Many robots of one station: run, fit, report.",
)


def register(parent: typer.Typer) -> None:
    """Add this group's verbs."""
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
    specs = {name: spec_for(text, str(spec), name) for name in robots_like(bench, robots)}
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


@app.command()
def fit(
    what: Annotated[
        list[str],
        typer.Argument(metavar="FOLDER|RUN...", help="A fleet, or runs.", show_default=False),
    ],
    estimator: Annotated[str, typer.Option("--estimator", "-e", help="Name of the estimator.")],
    options: Annotated[
        list[str] | None,
        typer.Option("--set", help="Estimator parameter as NAME=VALUE (YAML value)."),
    ] = None,
    workers: WorkersOption = 0,
    dask: Annotated[
        str, typer.Option("--dask", help="Scheduler of a Dask cluster, in place of processes.")
    ] = "",
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Where models go; by default `models` of the fleet."),
    ] = None,
    register: Annotated[
        bool,
        typer.Option("--register", help="As challenger of the robot's name, or first champion."),
    ] = False,
    registry: RegistryOption = HERE,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Fit every robot by itself, on processes of this computer or a Dask cluster."""
    from hil import api
    from hil.cli.runs import fail
    from hil.dask_cluster import checked_address
    from hil.errors import FitError
    from hil.executor import cores
    from hil.fleet.fit_task import How
    from hil.fleet.fitting import fit_runs, kept, registered
    from hil.registry.registry import Registry

    sources, home = _runs_of(what, runs)
    address = checked_address("--dask", dask or None)
    how = How(estimator, api.parse_parameters(options or ()))
    bar = _Count(len(sources), "fitted")
    results = fit_runs(sources, how, workers=workers or cores(), dask=address, tell=bar)
    fits = kept(sources, results, out or home)
    if register:
        fits = [registered(one, Registry(registry)) for one in fits]
    if json:
        print_json({"fits": [one.to_dict() for one in fits]})
    else:
        print_table(("robot", "RMSE [raw]", "criteria", "is", "model"), map(_fit_row, fits))
    failed = [one for one in fits if one.result.error]
    if failed:
        first = f"{failed[0].robot}: {failed[0].result.error}"
        fail(FitError(f"{len(failed)} of {len(fits)} robots have no model; {first}"), json)


@app.command()
def drift(
    folder: FolderArgument,
    false_alarm: Annotated[
        float,
        typer.Option(
            help="Probability with which any of the robots is called changed, if none is."
        ),
    ] = 0.01,
    registry: RegistryOption = HERE,
    json: JsonFlag = False,
) -> None:
    """Judge the runs of a fleet as probes, each against its robot's champion."""
    from hil.fleet.survey import probe_fleet
    from hil.registry.registry import Registry

    told = probe_fleet(folder, Registry(registry), false_alarm)
    if json:
        print_json({"probes": [{"robot": robot, **probe.to_dict()} for robot, probe in told]})
        return
    rows = [(robot, "yes" if one.changed else "no", one.text) for robot, one in told]
    print_table(("robot", "changed", "what"), rows)


@app.command()
def report(
    folder: FolderArgument,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="The page; by default in the folder.")
    ] = None,
    workers: WorkersOption = 0,
    registry: RegistryOption = HERE,
    json: JsonFlag = False,
) -> None:
    """Which robots have drifted or stand out; friction over age and temperature."""
    from hil.executor import cores
    from hil.fleet.folder import PAGE
    from hil.fleet.survey import survey_fleet
    from hil.registry.registry import Registry
    from hil.report.fleet_page import render_fleet, standing_out

    survey = survey_fleet(folder, Registry(registry), workers=workers or cores())
    page = render_fleet(survey, out or folder / PAGE)
    if json:
        print_json({**survey.to_dict(), "page": str(page)})
        return
    rows = [(one.robot, f"{one.age:.1f}", why) for one, why in standing_out(survey)]
    if rows:
        print_table(("robot", "years", "why"), rows)
    else:
        typer.echo(f"nobody of {len(survey.robots)} robots has drifted or stands out")
    typer.echo(f"page: {page}")


def _fit_row(fit: RobotFit) -> tuple[str, ...]:
    rmse = fit.result.rmse
    mean = f"{sum(rmse) / len(rmse):.4f}" if rmse else ""
    word = {True: "met", False: "missed", None: ""}[fit.result.passed]
    role = " ".join(filter(None, (fit.registered, fit.role)))
    return fit.robot, mean, word, role, fit.result.error or str(fit.model)


class _Count:
    """How many are done, on a terminal."""

    def __init__(self, total: int, what: str) -> None:
        self._total, self._what = total, what

    def __call__(self, done: int) -> None:
        if sys.stderr.isatty():
            end = "\n" if done == self._total else ""
            typer.echo(f"\r{done} of {self._total} {self._what}{end}", err=True, nl=False)


def _runs_of(what: list[str], runs: Path) -> tuple[list[Path], Path]:
    """The runs of a fleet's folder, or runs by path, name or number; and where models go."""
    from hil.cli.models import found
    from hil.errors import DataError
    from hil.fleet.folder import MODELS, FleetFolder, is_fleet_folder
    from hil.record.rundir import RunDirectory

    if len(what) == 1 and is_fleet_folder(Path(what[0])):
        folder, members = FleetFolder.open(Path(what[0]))
        done = [Path(one["run"]) for one in members if one.get("outcome") == "completed"]
        if not done:
            raise DataError(
                f"no robot of {folder.path} has been measured",
                hint=f"hil fleet resume {folder.path}",
            )
        return done, folder.path / MODELS
    return [RunDirectory.open(one).path for one in found(what, runs)], Path("models")


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
    from hil.fleet.run import Manner, run_fleet

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
