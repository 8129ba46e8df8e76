"""A trial of a model on a simulated arm, and its page."""

from __future__ import annotations

from collections.abc import Callable

from hil.arms import AnyPayload, payload_of
from hil.control import FRICTION_SHARE, MOST_SEED, Trial, run_trial, trial_place
from hil.core import AnyPath, SpecError, json_document, path_of, whole_number
from hil.export import require_new, write_folder
from hil.report import TRY_OUT_FILE, page_html, trial_page


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
    """Try a model in controllers, on a simulated arm driven by torque; write and return the result.

    Args:
        model: Its folder.
        out: Folder to make, with `report.html` and `try-out.json`.
        station: With the simulated arm the model was fitted on; by default the station that
            experiments here would use, or a mock of that arm.
        robot: Name in the station; by default its only robot that is the model's.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a `Payload` that is mounted and
            that the model knows of.
        seed: Of the trajectory; another one than that of an experiment with the same seed.
        friction_share: Share of the dry friction that is compensated while the arm is guided by
            hand; below 1.
        progress: Called with what is being run.

    Raises:
        SpecError: The robot is no simulated one with torque control, or is another arm; no station
            was named, and the default one has no mock of the model's arm; an argument is invalid.
        FitError: The model has no gravity, or predicts no torques.
        PlanError: There is no motion clear of collisions.
        RecordingError: The folder exists, or cannot be written.
    """
    folder = path_of(out)
    require_new(folder)
    load, number = payload_of(payload), whole_number(seed, "seed", 0)
    if number > MOST_SEED:
        raise SpecError(
            f"the seed is {number}, but must be 0 to {MOST_SEED}", hint="choose another --seed"
        )
    place = trial_place(path_of(model), path_of(station) if station else None, robot, load)
    trial = run_trial(place, number, friction_share, progress or (lambda text: None))
    document = json_document(trial.to_dict()).decode()
    write_folder({TRY_OUT_FILE: page_html(trial_page(trial)), "try-out.json": document}, folder)
    return trial
