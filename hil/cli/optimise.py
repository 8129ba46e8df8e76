"""`hil optimise`: condition number and margins of the trajectories of a spec."""

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
def optimise(
    spec: SpecArgument,
    station: StationOption = None,
    set_: SetOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", help="HTML report; default: NAME.excitation.html in the current folder."
        ),
    ] = None,
    fresh: Annotated[
        bool,
        typer.Option("--fresh", help="Ignore the cached result, optimise again and replace it."),
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Optimise the excitation of a spec; report its condition number and margins."""
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
        return f"{total} random trajectories (set excitation.optimise to optimise them)"
    if not report.computed:
        return f"{total} optimised trajectories, all from the cache"
    new = "all" if report.computed == total else f"{report.computed} of them"
    return f"{total} optimised trajectories, {new} computed in {duration(report.seconds)}"


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
    say("condition number, scaled and raw: each trajectory alone, and jointly with earlier ones")
    print_table(("", "scaled", "raw", "jointly", "raw", "clearance mm"), rows)
    if random is not None:
        say("random: the best of as many random trajectories, and all of them jointly")


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
"""Heading of each margin, and the factor that converts the margin to the displayed unit, in the
order of the table."""


def _print_margins(report: "ExcitationReport") -> None:
    margins = report.appraisal.margins
    shown = [name for name in MARGINS if math.isfinite(margins[name].max())]
    say("margins: smallest distance of all trajectories to each limit")
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
        f"trajectory {number + 1} at {closest.at_s:.2f} s; at least {clearance:g} mm are required"
    )
    if (errors := report.standard_errors()) is not None:
        ratios = sorted(errors.values())
        yield (
            f"standard errors of the parameters, ratio of random to these trajectories: "
            f"median {ratios[len(ratios) // 2]:.2f}, range {ratios[0]:.2f} to {ratios[-1]:.2f}"
        )
