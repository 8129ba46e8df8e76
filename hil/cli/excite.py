"""`hil excite`: what the trajectories of a spec are worth, and what they leave of every limit."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.cli.options import JsonFlag, SetOption, SpecArgument, StationOption, load_experiment
from hil.cli.output import print_json, print_table, say
from hil.report import duration

if TYPE_CHECKING:
    from hil.excitation import Information
    from hil.planning import ExcitationReport

app = typer.Typer()


@app.command()
def excite(
    spec: SpecArgument,
    station: StationOption = None,
    set_: SetOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", help="Where the page goes; by default NAME.excitation.html here."
        ),
    ] = None,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Optimise again what the cache has, and replace it.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Find the trajectories of a spec and show what they are worth; move nothing."""
    from hil.cli.progress import ExcitationLine
    from hil.report import write_excitation_page
    from hil.workflow import appraise_excitation

    experiment = load_experiment(spec, station, set_)
    with ExcitationLine() as line:
        report = appraise_excitation(experiment, fresh=fresh, watch=line)
    page = write_excitation_page(report, out or Path(f"{experiment.spec.name}.excitation.html"))
    if json:
        print_json({**report.to_dict(), "page": str(page)})
        return
    say(experiment.title)
    say(_origin(report))
    typer.echo()
    _print_conditions(report)
    typer.echo()
    _print_margins(report)
    typer.echo()
    for sentence in _sentences(report):
        say(sentence)
    typer.echo(f"page: {page}")


def _origin(report: "ExcitationReport") -> str:
    total = len(report.appraisal.trajectories)
    if report.spec.optimise is None:
        return f"{total} trajectories, drawn at random (excitation.optimise would optimise them)"
    if not report.computed:
        return f"{total} optimised trajectories, all from the cache"
    new = "all" if report.computed == total else f"{report.computed} of them"
    return f"{total} optimised trajectories, {new} found in {duration(report.seconds)}"


def _print_conditions(report: "ExcitationReport") -> None:
    rows = [
        (str(i), *_conditions(one.alone), *_conditions(one.jointly), _mm(one.closest.distance_m))
        for i, one in enumerate(report.appraisal.trajectories, 1)
    ]
    if (random := report.random) is not None:
        alone = [one.alone for one in random.trajectories]
        best = min(alone, key=lambda information: information.condition_scaled)
        closest = _mm(random.closest[1].distance_m)
        rows.append(("random", *_conditions(best), *_conditions(random.jointly), closest))
    say("condition number: scaled and raw, of each alone and with those before it")
    print_table(("", "scaled", "raw", "jointly", "raw", "clear mm"), rows)
    if random is not None:
        say("random: the best single one of as many random draws, and all of them jointly")


def _conditions(information: "Information") -> tuple[str, str]:
    return f"{information.condition_scaled:.2f}", f"{information.condition_raw:.1f}"


def _mm(distance_m: float) -> str:
    return f"{1e3 * distance_m:.1f}"


DEGREES = 180 / math.pi
MARGINS = {
    "position_rad": ("position °", DEGREES),
    "velocity_rad_s": ("speed °/s", DEGREES),
    "acceleration_rad_s2": ("accel. °/s²", DEGREES),
    "jerk_rad_s3": ("jerk °/s³", DEGREES),
    "effort_nm": ("torque N·m", 1.0),
}
"""Margins in the order of the table: heading, and factor to its unit."""


def _print_margins(report: "ExcitationReport") -> None:
    margins = report.appraisal.margins
    shown = [name for name in MARGINS if math.isfinite(margins[name].max())]
    say("margins: what all of them leave of each limit")
    rows = [
        (f"J{j + 1}", *(f"{MARGINS[name][1] * margins[name][j] + 0.0:.3g}" for name in shown))
        for j in range(len(report.appraisal.joint_names))
    ]
    print_table(("", *(MARGINS[name][0] for name in shown)), rows)


def _sentences(report: "ExcitationReport") -> Iterator[str]:
    number, closest = report.appraisal.closest
    clearance = 1e3 * report.appraisal.limits.clearance_m
    yield (
        f"closest: {_mm(closest.distance_m)} mm between {' and '.join(closest.bodies)}, "
        f"trajectory {number + 1} at {closest.at_s:.2f} s; {clearance:g} mm are kept"
    )
    if (errors := report.standard_errors()) is not None:
        ratios = sorted(errors.values())
        yield (
            f"standard errors of the parameters, random draws over these: "
            f"{ratios[len(ratios) // 2]:.2f} in the middle, {ratios[0]:.2f} to {ratios[-1]:.2f}"
        )
