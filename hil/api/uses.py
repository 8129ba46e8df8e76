"""What a model is good for: other programs, poses to rest in, a controller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from hil.api.arguments import AnyPath, AnyPayload, path, payload_of, whole
from hil.control.trial.settings import FRICTION_SHARE

if TYPE_CHECKING:
    from hil.control.rest_report import RestReport
    from hil.control.trial.result import Trial
    from hil.export.targets import Written


def export_model(
    model: AnyPath,
    out: AnyPath,
    *,
    to: str = "c",
    prefix: str | None = None,
    unchecked: bool | None = None,
) -> Written:
    """Write a saved model for other programs, compared with the model in Python first.

    Args:
        model: Its folder.
        out: The file or folder to be made.
        to: `c` and the other targets of `hil.export.targets`.
        prefix: What files and symbols of C begin with; by default `hil`.
        unchecked: Write C without a compiler to check it with, or a URDF however far off it is.

    Raises:
        DataError: The model cannot be read.
        FitError: It is of a kind that cannot be written so, or what was written does not agree.
        PluginError: Something it takes is not installed, such as a C compiler or cvxpy.
        RecordingError: The file or folder exists already.
        SpecError: There is no such target, or an option is none of it.
    """
    from hil.estimators.model_file import load_model_file
    from hil.export.targets import export_model as export

    stored = load_model_file(path(model))
    return export(stored, path(out), to, prefix=prefix, unchecked=unchecked)


def rest_poses(
    model: AnyPath,
    *,
    station: AnyPath | None = None,
    robot: str | None = None,
    payload: AnyPayload | None = None,
    clearance_mm: float | None = None,
    near_deg: Sequence[float] | None = None,
    count: int = 3,
    seed: int = 0,
    unchecked: bool = False,
) -> RestReport:
    """The poses in which a model's arm loads its brakes least.

    Args:
        model: Its folder.
        station: Says what stands around the arm; by default the one experiments here would use,
            or a table at its base.
        robot: Name in the station; by default its only robot that is the model's.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a `Payload` that is mounted.
        clearance_mm: Distance that is kept; by default the station's.
        near_deg: Where the arm stands now, or would rather be [°].
        count: How many poses.
        seed: Of the search.
        unchecked: Leave clearance out, the only way for an arm without collision bodies.

    Raises:
        FitError: The model has no gravity, or cannot tell torques.
        SpecError: The robot is another arm, or an argument cannot be.
        PlanError: No pose is within limits and clear.
    """
    from hil.control.rest_report import find_rest_poses

    return find_rest_poses(
        path(model),
        station=path(station) if station else None,
        robot=robot,
        payload=payload_of(payload),
        clearance_mm=clearance_mm,
        near_deg=near_deg,
        count=whole(count, "count", 1),
        seed=whole(seed, "seed", 0),
        unchecked=unchecked,
    )


def try_out(
    model: AnyPath,
    out: AnyPath,
    *,
    station: AnyPath | None = None,
    robot: str | None = None,
    payload: AnyPayload | None = None,
    seed: int = 0,
    friction_share: float = FRICTION_SHARE,
    progress: Callable[[str], object] | None = None,
) -> Trial:
    """What a model is worth to a controller, on a simulated arm driven by torque.

    Args:
        model: Its folder.
        out: Folder to make, with `report.html` and `try-out.json`.
        station: Has the simulated arm the model was fitted on; by default the station experiments
            here would use, or a mock of its kind.
        robot: Name in the station; by default its only robot that is the model's.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a `Payload` that is mounted and
            told to the model.
        seed: Of the trajectory; counted apart from those of experiments.
        friction_share: Of the dry friction, compensated while a hand leads the arm; below 1.
        progress: Is told what is being run.

    Raises:
        SpecError: The robot is no simulated one with torque control, or is another arm; nobody
            named a station, and the mock there is otherwise is not the model's; an argument
            cannot be.
        FitError: The model has no gravity, or cannot tell torques.
        PlanError: There is no clear motion.
        RecordingError: The folder exists, or cannot be written.
    """
    from hil.control.trial.trial import run_trial
    from hil.estimators.model_file import json_bytes
    from hil.export.exported import require_new, write_folder
    from hil.report.render import page_html
    from hil.report.trial_page import REPORT_FILE, trial_page

    folder = path(out)
    require_new(folder)
    trial = run_trial(
        path(model),
        station=path(station) if station else None,
        robot=robot,
        payload=payload_of(payload),
        seed=whole(seed, "seed", 0),
        friction_share=friction_share,
        progress=progress or (lambda text: None),
    )
    document = json_bytes(trial.to_dict()).decode()
    write_folder({REPORT_FILE: page_html(trial_page(trial)), "try-out.json": document}, folder)
    return trial
