"""Trial of a model in controllers on a simulated arm, with a report page."""

from __future__ import annotations

from collections.abc import Callable

from hil.arms import AnyPayload, payload_of
from hil.control import FRICTION_SHARE, MOST_SEED, Trial, run_trial, trial_place
from hil.core import AnyPath, SpecError, json_document, path_of, whole_number
from hil.export import require_new, write_folder
from hil.report import TRY_OUT_FILE, page_html, trial_page


def simulate(
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
    """Try a model in controllers on a simulated torque-controlled arm; write and return the result.

    Args:
        model: Path of the model folder.
        out: Folder that the function creates, with `report.html` and `try-out.json`.
        station: Station file with the simulated arm; by default the station that experiments in the
            working directory would use, or a mock of the arm that the model was fitted to.
        robot: Name of a robot in the station; by default the only robot in the station that fits
            the model.
        payload: Mounted payload, which the model knows: `MASS` or `MASS,X,Y,Z` [kg, m], a number
            [kg] or a `Payload`.
        seed: Seed of the test trajectory; an experiment with the same seed has a different
            trajectory.
        friction_share: Share of the dry friction that is compensated during hand guiding; must be
            below 1.
        progress: Callback that receives the name of the present step.

    Raises:
        SpecError: The robot is not a simulated arm with torque control, or its arm differs from
            that of the model; no station was named and the default station has no mock of the
            model's arm; or an argument is invalid.
        FitError: The model does not contain gravity, or does not predict torques.
        PlanError: There is no collision-free motion.
        RecordingError: The folder exists already, or cannot be written.
    """
    folder = path_of(out)
    require_new(folder)
    load, number = payload_of(payload), whole_number(seed, "seed", 0)
    if number > MOST_SEED:
        raise SpecError(
            f"the seed is {number}, but must be 0 to {MOST_SEED}", hint="choose a different --seed"
        )
    place = trial_place(path_of(model), path_of(station) if station else None, robot, load)
    trial = run_trial(place, number, friction_share, progress or (lambda text: None))
    document = json_document(trial.to_dict()).decode()
    write_folder({TRY_OUT_FILE: page_html(trial_page(trial)), "try-out.json": document}, folder)
    return trial
