"""`hil rest-pose`: where an arm loads its brakes least."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.cli.models import ModelArgument, found_model
from hil.cli.output import JsonFlag, RunsOption, fold, out_width, print_json, print_table
from hil.core import SpecError

if TYPE_CHECKING:
    from hil.control import RestPose, RestReport

LABEL_WIDTH = 15
NUMBER_WIDTH = 7
INDENT = "   "


def register(app: typer.Typer) -> None:
    """Add this group's verbs."""
    app.command("rest-pose")(rest_pose)


def rest_pose(
    model: ModelArgument,
    station: Annotated[
        Path | None,
        typer.Option(
            "--station",
            help="What stands around the arm; by default $HIL_STATION, station.yaml here, or a "
            "table at its base.",
        ),
    ] = None,
    robot: Annotated[
        str, typer.Option("--robot", help="Name in the station; by default the one that fits.")
    ] = "",
    payload: Annotated[
        str, typer.Option("--payload", help="What is mounted: MASS_KG or MASS_KG,X_M,Y_M,Z_M.")
    ] = "",
    clearance_mm: Annotated[
        float | None,
        typer.Option("--clearance-mm", help="Distance that is kept; by default the station's."),
    ] = None,
    near: Annotated[
        str,
        typer.Option(
            "--near",
            help="Joint angles in degrees, A,B,C,…: where the arm stands now, or would rather be.",
        ),
    ] = "",
    unchecked: Annotated[
        bool, typer.Option("--unchecked", help="Do not check clearance; for arms from a URDF.")
    ] = False,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Find the pose in which the brakes hold least, and say what happens when they fail."""
    from hil import api

    report = api.rest_poses(
        found_model(model, runs),
        station=station,
        robot=robot or None,
        payload=payload or None,
        clearance_mm=clearance_mm,
        near_deg=_angles(near) if near else None,
        unchecked=unchecked,
    )
    if json:
        print_json(report.to_dict())
    else:
        _print(report)


def _angles(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise SpecError(
            f"--near {text!r} is no pose", hint="for example: --near 0,-90,0,-90,0,0 (degrees)"
        ) from None


def _print(report: "RestReport") -> None:
    load = "nothing" if report.payload.is_empty else str(report.payload)
    _say(f"rest poses of {report.robot} by {Path(report.model).name}, with {load} mounted")
    kept = f", {1e3 * report.clearance_m:.0f} mm clear" if report.clearance_m else ""
    _say(f"around it: {report.around}{kept}")
    typer.echo()
    named = [*((str(i), pose) for i, pose in enumerate(report.poses, 1))]
    named += [(pose.label, pose) for pose in report.compared]
    _print_summary(named)
    for name, pose in named:
        typer.echo()
        _print_pose(report, name, pose)
    if report.notes:
        typer.echo()
    for note in report.notes:
        _say(f"note: {note}")


def _print_summary(named: "Iterable[tuple[str, RestPose]]") -> None:
    print_table(
        ("pose", "rms %", "most %", "clear mm", "without brakes it"),
        [
            (
                name,
                f"{100 * pose.effort:.2f}",
                f"{100 * max(abs(pose.share)):.2f}",
                f"{1e3 * pose.clearance:.0f}" + ("" if pose.clear else " !"),
                {"held": "is held"}.get(pose.fail.outcome, pose.fail.outcome),
            )
            for name, pose in named
        ],
    )


def _print_pose(report: "RestReport", name: str, pose: "RestPose") -> None:
    import numpy as np

    _say(f"{name}  {pose.label}" if name != pose.label else name)
    rows = [
        ("pose [deg]", [f"{angle:.1f}" for angle in np.round(np.degrees(pose.q), 1) + 0.0]),
        ("torque [N·m]", [f"{torque:.2f}" for torque in np.round(pose.torque, 2) + 0.0]),
        ("of limit [%]", [f"{100 * abs(share):.2f}" for share in pose.share]),
    ]
    if report.friction is not None:
        rows.append(("friction spare", [f"{spare:.2f}" for spare in pose.fail.spare]))
    _print_joints(rows, len(report.joint_names))
    if not pose.clear:
        _say(f"not within limits, or too close: {' and '.join(pose.bodies)}", INDENT)
    elif np.isfinite(pose.clearance):
        _say(f"{1e3 * pose.clearance:.0f} mm between {' and '.join(pose.bodies)}", INDENT)
    _say(_ending(report, pose), INDENT)


def _print_joints(rows: list[tuple[str, list[str]]], joints: int) -> None:
    """Numbers joint by joint, in as many blocks as a terminal needs."""
    width = out_width() or 10_000
    most = max(1, (width - LABEL_WIDTH - len(INDENT)) // NUMBER_WIDTH)
    for start in range(0, joints, most):
        block = range(start, min(start + most, joints))
        head = "".join(f"J{j + 1}".rjust(NUMBER_WIDTH) for j in block)
        typer.echo(f"{INDENT}{'':{LABEL_WIDTH}}{head}")
        for label, cells in rows:
            numbers = "".join(cells[j].rjust(NUMBER_WIDTH) for j in block)
            typer.echo(f"{INDENT}{label:{LABEL_WIDTH}}{numbers}")


def _ending(report: "RestReport", pose: "RestPose") -> str:
    """What happens when the brakes fail, in words."""
    fail = pose.fail
    weakest = int(min(range(len(fail.spare)), key=lambda j: fail.spare[j]))
    first = report.joint_names[int(max(range(len(fail.way_down)), key=lambda j: fail.way_down[j]))]
    spare = abs(fail.spare[weakest])
    known = report.friction is not None
    return {
        "stays": "without brakes it stays: no torque, and no way down",
        "held": f"without brakes half of its dry friction holds it, {spare:.2f} N·m are left in "
        f"{report.joint_names[weakest]}"
        + (f"; pushed, it tips over by {first}" if fail.unstable else ""),
        "tips": f"without brakes it tips over by {first}: balanced, but unstable",
        "falls": f"without brakes it falls: {report.joint_names[weakest]} lacks {spare:.2f} N·m "
        "of friction (half of it counted)"
        if known
        else "without brakes it falls, unless its friction holds the torque",
    }[fail.outcome]


def _say(text: str, indent: str = "") -> None:
    width = out_width()
    folded = fold(text, None if width is None else width - len(indent))
    typer.echo("\n".join(indent + line for line in folded.splitlines()))
