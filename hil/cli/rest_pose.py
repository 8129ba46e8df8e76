"""`hil rest-pose`: where an arm loads its brakes least."""

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
            f"--near {text!r} is no pose", hint="for example: --near 0,-90,0,-90,0,0 (degrees)"
        ) from None


def _print(report: "RestReport") -> None:
    load = "nothing" if report.payload.is_empty else str(report.payload)
    say(f"rest poses of {report.robot} by {Path(report.model).name}, with {load} mounted")
    clearance = f", {1e3 * report.clearance_m:.0f} mm clear" if report.clearance_m else ""
    say(f"around it: {report.around}{clearance}")
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
    print_table(("pose", "rms %", "most %", "clear mm", "without brakes it"), rows)


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
        rows.append(("friction spare", *(f"{spare:.2f}" for spare in pose.fail.spare)))
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
        say(f"not within limits, or too close: {' and '.join(pose.bodies)}", MARGIN)
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
