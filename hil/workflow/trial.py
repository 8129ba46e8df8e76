"""[trying] A trial of a model on a simulated arm, and its page."""

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
