"""`hil fleet fit`, `drift`, `report`: functions of what a fleet has measured."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.cli.output import JsonFlag, RunsOption, print_json, print_table
from hil.cli.registry import HERE, RegistryOption

if TYPE_CHECKING:
    from hil.models import RobotFit, RobotProbe

FolderArgument = Annotated[
    Path, typer.Argument(help="Folder of the fleet: RUNS/DAY/fleet/NAME.", show_default=False)
]
WorkersOption = Annotated[
    int, typer.Option("--workers", min=0, help="At a time; 0: one per core of this computer.")
]


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command()(fit)
    app.command()(drift)
    app.command()(report)


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
    from hil.core import FitError, checked_address, cores
    from hil.models import FitSettings, Registry, fit_runs, register_fit, store_fits

    sources, home = _runs_of(what, runs)
    address = checked_address("--dask", dask or None)
    settings = FitSettings(estimator, api.parse_parameters(options or ()))
    bar = _Count(len(sources), "fitted")
    results = fit_runs(sources, settings, workers=workers or cores(), dask=address, tell=bar)
    fits = store_fits(sources, results, out or home)
    if register:
        fits = [register_fit(one, Registry(registry)) for one in fits]
    if json:
        print_json({"fits": [one.to_dict() for one in fits]})
    else:
        print_table(("robot", "RMSE [raw]", "criteria", "is", "model"), map(_fit_row, fits))
    if failed := [one for one in fits if one.error]:
        lack = "are not registered" if register else "have no model"
        first = f"{failed[0].robot}: {failed[0].error}"
        fail(
            FitError(
                f"{len(failed)} of {len(fits)} robots {lack}; {first}",
                hint="see the robots named above; the others are fitted",
            ),
            json,
        )


def drift(
    folder: FolderArgument,
    false_alarm: Annotated[
        float,
        typer.Option(
            help="Nominal probability with which any of the robots is called changed, if none is."
        ),
    ] = 0.01,
    registry: RegistryOption = HERE,
    json: JsonFlag = False,
) -> None:
    """Judge the runs of a fleet as probes, each against its robot's champion."""
    from hil.cli.runs import fail
    from hil.core import DataError
    from hil.models import Registry, probe_fleet

    told = probe_fleet(folder, Registry(registry), false_alarm)
    if json:
        print_json({"probes": [one.to_dict() for one in told]})
    else:
        print_table(("robot", "changed", "what"), map(_drift_row, told))
    if failed := [one for one in told if one.error]:
        first = f"{failed[0].robot}: {failed[0].error}"
        fail(
            DataError(
                f"{len(failed)} of {len(told)} robots are not judged; {first}",
                hint="see the robots named above; the others are judged",
            ),
            json,
        )


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
        typer.echo(f"nobody of {len(survey.robots)} robots has drifted or stands out")
    typer.echo(f"page: {page}")


def _fit_row(fit: "RobotFit") -> tuple[str, ...]:
    rmse = fit.result.rmse
    mean = f"{sum(rmse) / len(rmse):.4f}" if rmse else ""
    word = {True: "met", False: "missed", None: ""}[fit.result.passed]
    run = "run rejected" if fit.verdict == "rejected" else ""
    role = " ".join(filter(None, (fit.registered, fit.role)))
    return fit.robot, mean, ", ".join(filter(None, (word, run))), role, fit.error or str(fit.model)


def _drift_row(one: "RobotProbe") -> tuple[str, ...]:
    if one.probe is None:
        return one.robot, "?", one.error
    what = "; ".join(filter(None, (one.probe.text, one.note)))
    return one.robot, "yes" if one.probe.changed else "no", what


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
    from hil.core import DataError
    from hil.recording import FleetGroup, RunDirectory

    if len(what) == 1 and FleetGroup.is_at(Path(what[0])):
        fleet = FleetGroup.open(Path(what[0]))
        if not (done := fleet.completed()):
            raise DataError(
                f"no robot of {fleet.path} has been measured",
                hint=f"hil fleet resume {fleet.path}",
            )
        return done, fleet.models
    return [RunDirectory.open(one).path for one in found(what, runs)], Path("models")
