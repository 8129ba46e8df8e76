"""`hil excite`: what the trajectories of a spec are worth, and what they leave of every limit."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.cli.output import (
    JsonFlag,
    SpecPath,
    StationOption,
    duration,
    fold,
    out_width,
    print_json,
    print_table,
)
from hil.cli.overriding import SetOption, load_with

if TYPE_CHECKING:
    from hil.excitation import Information
    from hil.planning import ExcitationReport

DEGREES = 180 / math.pi
MARGINS = {
    "position_rad": ("position °", DEGREES),
    "velocity_rad_s": ("speed °/s", DEGREES),
    "acceleration_rad_s2": ("accel. °/s²", DEGREES),
    "jerk_rad_s3": ("jerk °/s³", DEGREES),
    "effort_nm": ("torque N·m", 1.0),
}
"""Margins in the order of the table: heading, and factor to its unit."""


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command()(excite)


def excite(
    spec: SpecPath,
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

    experiment = load_with(spec, station, set_)
    with ExcitationLine() as line:
        report = appraise_excitation(experiment, fresh=fresh, watch=line)
    page = write_excitation_page(report, out or Path(f"{experiment.spec.name}.excitation.html"))
    if json:
        print_json({**report.to_dict(), "page": str(page)})
        return
    _say(experiment.title)
    _say(_origin(report))
    typer.echo()
    _print_conditions(report)
    typer.echo()
    _print_margins(report)
    typer.echo()
    for sentence in _sentences(report):
        _say(sentence)
    typer.echo(f"page: {page}")


def _origin(report: "ExcitationReport") -> str:
    total = len(report.appraisal.trajectories)
    if report.spec.optimise is None:
        return f"{total} trajectories, drawn at random (excitation.optimise would optimise them)"
    if not report.computed:
        return f"{total} optimised trajectories, all from the cache"
    found = "all" if report.computed == total else f"{report.computed} of them"
    return f"{total} optimised trajectories, {found} found in {duration(report.seconds)}"


def _print_conditions(report: "ExcitationReport") -> None:
    rows = []
    for number, one in enumerate(report.appraisal.trajectories, 1):
        least = f"{1e3 * one.closest.distance_m:.1f}"
        rows.append((str(number), *_conditions(one.alone), *_conditions(one.jointly), least))
    if report.random is not None:
        best = min(
            (one.alone for one in report.random.trajectories),
            key=lambda information: information.condition_scaled,
        )
        together = _conditions(report.random.jointly)
        rows.append(("random", *_conditions(best), *together, _least(report)))
    _say("condition number: scaled and raw, of each alone and with those before it")
    print_table(("", "scaled", "raw", "jointly", "raw", "clear mm"), rows)
    if report.random is not None:
        _say("random: the best single one of as many random draws, and all of them jointly")


def _least(report: "ExcitationReport") -> str:
    assert report.random is not None
    return f"{1e3 * report.random.closest[1].distance_m:.1f}"


def _conditions(information: "Information") -> tuple[str, str]:
    return f"{information.condition_scaled:.2f}", f"{information.condition_raw:.1f}"


def _print_margins(report: "ExcitationReport") -> None:
    margins = report.appraisal.margins
    shown = [name for name in MARGINS if math.isfinite(margins[name].max())]
    _say("margins: what all of them leave of each limit")
    rows = [
        (
            f"J{j + 1}",
            *(f"{MARGINS[name][1] * margins[name][j] + 0.0:.3g}" for name in shown),
        )
        for j in range(len(report.appraisal.joint_names))
    ]
    print_table(("", *(MARGINS[name][0] for name in shown)), rows)


def _sentences(report: "ExcitationReport") -> Iterator[str]:
    number, closest = report.appraisal.closest
    kept = 1e3 * report.appraisal.limits.clearance_m
    yield (
        f"closest: {1e3 * closest.distance_m:.1f} mm between {' and '.join(closest.bodies)}, "
        f"trajectory {number + 1} at {closest.at_s:.2f} s; {kept:g} mm are kept"
    )
    if (ratios := report.standard_errors()) is not None:
        yield _errors(list(ratios.values()))


def _errors(ratios: Sequence[float]) -> str:
    ordered = sorted(ratios)
    middle = ordered[len(ordered) // 2]
    return (
        f"standard errors of the parameters, random draws over these: {middle:.2f} in the middle, "
        f"{ordered[0]:.2f} to {ordered[-1]:.2f}"
    )


def _say(text: str) -> None:
    typer.echo(fold(text, out_width()))
