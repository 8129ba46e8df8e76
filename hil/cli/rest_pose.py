"""`hil rest-pose`: find the pose with the smallest load on the brakes."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hil.cli.options import JsonFlag, ModelArgument, RunsOption
from hil.cli.output import out_width, print_json, print_table, say, table_lines
from hil.core import SpecError

if TYPE_CHECKING:
    from hil.control import RestPose, RestReport

app = typer.Typer()


@app.command("rest-pose")
def rest_pose(
    model: ModelArgument,
    station: Annotated[
        Path | None,
        typer.Option(
            "--station",
            help="Station with the bodies around the arm; default: $HIL_STATION, station.yaml in "
            "the current folder, or a table under the base.",
        ),
    ] = None,
    robot: Annotated[
        str,
        typer.Option(
            "--robot",
            help="Name of the robot in the station; default: the robot with the arm of the model.",
        ),
    ] = "",
    payload: Annotated[
        str, typer.Option("--payload", help="Mounted payload: MASS_KG or MASS_KG,X_M,Y_M,Z_M.")
    ] = "",
    clearance_mm: Annotated[
        float | None,
        typer.Option(
            "--clearance-mm",
            help="Smallest distance to every body [mm]; default: clearance_m of the station.",
        ),
    ] = None,
    near: Annotated[
        str,
        typer.Option(
            "--near",
            help="Search near this pose: joint angles [deg] as A,B,C,…",
        ),
    ] = "",
    unchecked: Annotated[
        bool,
        typer.Option(
            "--no-collision-check",
            help="Skip the collision check, for arms from a URDF without collision bodies.",
        ),
    ] = False,
    runs: RunsOption = Path("runs"),
    json: JsonFlag = False,
) -> None:
    """Find the pose with the lowest brake torque and simulate a brake failure."""
    from hil import api
    from hil.runs import find_model

    report = api.rest_poses(
        find_model(model, runs),
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
            f"--near {text!r} is not a pose", hint="for example: --near 0,-90,0,-90,0,0 (degrees)"
        ) from None


def _print(report: "RestReport") -> None:
    load = "no payload" if report.payload.is_empty else str(report.payload)
    say(f"rest poses of {report.robot} by {Path(report.model).name}, with {load} mounted")
    clearance = f", at least {1e3 * report.clearance_m:.0f} mm away" if report.clearance_m else ""
    say(f"surroundings: {report.around}{clearance}")
    typer.echo()
    poses = [(str(i), pose) for i, pose in enumerate(report.poses, 1)]
    poses += [(pose.label, pose) for pose in report.compared]
    _print_summary(poses)
    for name, pose in poses:
        typer.echo()
        _print_pose(report, name, pose)
    if report.notes:
        typer.echo()
    for note in report.notes:
        say(f"note: {note}")


def _print_summary(poses: "Iterable[tuple[str, RestPose]]") -> None:
    rows = [
        (
            name,
            f"{100 * pose.effort:.2f}",
            f"{100 * max(abs(pose.share)):.2f}",
            f"{1e3 * pose.clearance:.0f}" + ("" if pose.clear else " !"),
            "is held" if pose.fail.outcome == "held" else pose.fail.outcome,
        )
        for name, pose in poses
    ]
    print_table(("pose", "rms %", "max %", "clearance mm", "without brakes it"), rows)


MARGIN = "   "


def _print_pose(report: "RestReport", name: str, pose: "RestPose") -> None:
    import numpy as np

    say(f"{name}  {pose.label}" if name != pose.label else name)
    rows = [
        ("pose [deg]", *(f"{angle:.1f}" for angle in np.round(np.degrees(pose.q), 1) + 0.0)),
        ("torque [N·m]", *(f"{torque:.2f}" for torque in np.round(pose.torque, 2) + 0.0)),
        ("of limit [%]", *(f"{100 * abs(share):.2f}" for share in pose.share)),
    ]
    if report.friction is not None:
        rows.append(("friction margin", *(f"{spare:.2f}" for spare in pose.fail.spare)))
    joints = range(1, len(report.joint_names) + 1)
    width = out_width()
    lines = table_lines(
        ("", *(f"J{j}" for j in joints)),
        rows,
        right=joints,
        width=None if width is None else width - len(MARGIN),
    )
    for line in lines:
        typer.echo(f"{MARGIN}{line}")
    if not pose.clear:
        say(f"outside the limits, or too close: {' and '.join(pose.bodies)}", MARGIN)
    elif np.isfinite(pose.clearance):
        say(f"{1e3 * pose.clearance:.0f} mm between {' and '.join(pose.bodies)}", MARGIN)
    say(_without_brakes(report, pose), MARGIN)


def _without_brakes(report: "RestReport", pose: "RestPose") -> str:
    """Return a sentence about what happens when the brakes fail."""
    fail = pose.fail
    weakest = int(min(range(len(fail.spare)), key=lambda j: fail.spare[j]))
    first = report.joint_names[int(max(range(len(fail.way_down)), key=lambda j: fail.way_down[j]))]
    spare = abs(fail.spare[weakest])
    known = report.friction is not None
    return {
        "stays": "without brakes the arm stays: gravity causes no torque, and no pose is lower",
        "held": "without brakes half of the dry friction holds the arm, with a margin of "
        f"{spare:.2f} N·m in {report.joint_names[weakest]}"
        + (f"; if pushed, the arm tips over in {first}" if fail.unstable else ""),
        "tips": f"without brakes the arm tips over in {first}: its balance is unstable",
        "falls": f"without brakes the arm falls: {report.joint_names[weakest]} lacks "
        f"{spare:.2f} N·m of friction (half of the friction is counted)"
        if known
        else "without brakes the arm falls, unless friction holds the torque",
    }[fail.outcome]
