"""`hil validate`: check a YAML file and all files that it names before a robot moves."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from hil.cli.options import (
    JsonFlag,
    SetOption,
    SpecArgument,
    StationOption,
    load_experiment,
    refuse_set,
)
from hil.cli.output import print_json, print_warnings
from hil.cli.series import moves_of

if TYPE_CHECKING:
    from hil.core import Source
    from hil.planning import Experiment

app = typer.Typer()


@app.command()
def validate(
    spec: SpecArgument,
    station: StationOption = None,
    set_: SetOption = None,
    json: JsonFlag = False,
) -> None:
    """Check a spec, series or schedule and its station; report all problems with positions."""
    from hil.core import read_source
    from hil.spec import is_schedule, is_series

    source = read_source(spec)
    if is_schedule(source):
        refuse_set(set_, "a schedule")
        facts, lines = _schedule(source, station)
    elif is_series(source):
        refuse_set(set_, "a series")
        facts, lines = _series(source, station)
    else:
        facts, lines = _experiment(source, station, set_)
    if json:
        print_json(facts)
        return
    for line in lines:
        typer.echo(line)
    print_warnings(facts["warnings"])


def _experiment(
    source: "Source", station: Path | None, set_: Sequence[str] | None
) -> tuple[dict[str, Any], list[str]]:
    from hil.workflow import check_driver

    experiment = load_experiment(source, station, set_)
    check_driver(experiment)
    facts = {
        "spec": source.name,
        "name": experiment.spec.name,
        "station": experiment.station_source,
    }
    spec = experiment.spec
    return facts | _valid([experiment]), [
        f"{source.name}: valid ({spec.excitation.kind}, robot {spec.robot})",
        f"station: {experiment.station_source}",
    ]


def _series(source: "Source", station: Path | None) -> tuple[dict[str, Any], list[str]]:
    from hil.workflow import check_driver, load_series

    series = load_series(source, station)
    for experiment in series.experiments:
        check_driver(experiment)
    moves_of(series, series.experiments).real()
    facts = {"series": source.name, "name": series.spec.name, "runs": _runs(series.experiments)}
    first = f"{source.name}: valid ({len(series.experiments)} experiments)"
    return facts | _valid(series.experiments), [first, *_titles(series.experiments)]


def _schedule(source: "Source", station: Path | None) -> tuple[dict[str, Any], list[str]]:
    from hil.maintenance import bind_file

    bound = bind_file(source, station)
    facts = {
        "schedule": source.name,
        "name": bound.spec.name,
        "model": bound.name,
        "estimator": bound.fit.estimator,
        "runs": _runs(bound.experiments),
    }
    first = f"{source.name}: valid (models of {bound.name}, {bound.fit.estimator})"
    return facts | _valid(bound.experiments), [first, *_titles(bound.experiments)]


def _valid(experiments: Iterable["Experiment"]) -> dict[str, Any]:
    """Return the end of all documents: validity, and warnings about extras that fits need."""
    from hil.workflow import missing_extras

    warnings = dict.fromkeys(text for one in experiments for text in missing_extras(one.spec))
    return {"valid": True, "warnings": list(warnings)}


def _runs(experiments: Iterable["Experiment"]) -> list[dict[str, str]]:
    return [
        {"spec": one.spec_source, "name": one.spec.name, "station": one.station_source}
        for one in experiments
    ]


def _titles(experiments: Iterable["Experiment"]) -> list[str]:
    return [f"  {one.title}" for one in experiments]
