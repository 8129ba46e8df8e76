"""The Python API: what the command line does with experiments, recordings and models.

>>> import hil
>>> experiment = hil.load("spec.yaml", "station.yaml")    # doctest: +SKIP
>>> report = hil.run(experiment, runs="runs")             # doctest: +SKIP
>>> report.verdict                                        # doctest: +SKIP
'passed'

Every function is in `hil` as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lazy_loader  # type: ignore[import-untyped]

from hil.arms import AnyPayload, payload_of
from hil.control import FRICTION_SHARE
from hil.core import AnyPath, SpecError, path_of, paths_of, sources_of, values_by_name, whole_number

if TYPE_CHECKING:
    from hil.control import Trial, rest_poses
    from hil.core import parse_parameters
    from hil.evaluation import FitReport, estimate_payload
    from hil.export import export_model
    from hil.importers import dataset, export_data, import_recording
    from hil.maintenance import reidentify
    from hil.models import registry
    from hil.networks import Watch
    from hil.planning import Experiment, load
    from hil.report import figures
    from hil.runs import describe_run, find_runs, list_runs
    from hil.workflow import RunReport, plan, resume, run, study

__getattr__, _, _ = lazy_loader.attach(
    "hil",
    submod_attrs={
        "control": ["rest_poses"],
        "core": ["parse_parameters"],
        "evaluation": ["estimate_payload"],
        "export": ["export_model"],
        "importers": ["dataset", "export_data", "import_recording"],
        "maintenance": ["reidentify"],
        "models": ["registry"],
        "planning": ["Experiment", "load"],
        "report": ["figures"],
        "runs": ["describe_run", "find_runs", "list_runs"],
        "workflow": ["RunReport", "plan", "resume", "run", "study"],
    },
)

__all__ = [
    "AnyPath",
    "Experiment",
    "RunReport",
    "dataset",
    "describe_run",
    "estimate_payload",
    "evaluate",
    "export_data",
    "export_model",
    "figures",
    "find_runs",
    "fit",
    "import_recording",
    "list_runs",
    "load",
    "parse_parameters",
    "plan",
    "registry",
    "reidentify",
    "rest_poses",
    "resume",
    "run",
    "study",
    "try_out",
]


def fit(
    sources: AnyPath | Iterable[AnyPath],
    *,
    estimator: str,
    robot: str | None = None,
    payload: AnyPayload | None = None,
    gains: AnyPath | None = None,
    validate: AnyPath | Iterable[AnyPath] = (),
    parameters: dict[str, Any] | None = None,
    out: AnyPath = "models",
    page: AnyPath | None = None,
    checkpoints: AnyPath | None = None,
    watch: Watch | None = None,
) -> FitReport:
    """Fit an estimator to recordings and judge it on others.

    Args:
        sources: Run directories or MCAP files to fit on, or just one.
        estimator: Name in `hil.estimators`.
        robot: Built-in arm or URDF; by default what the data says.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m], a number [kg] or a `Payload`; 0 for nothing
            mounted; by default what the data says.
        gains: File with `drive_gains_nm_a`; by default what the data says.
        validate: Held-out sources, or just one.
        parameters: The estimator's own parameters.
        out: Folder in which the model's folder is made.
        page: Also write an HTML report about the held-out sources here.
        checkpoints: Folder in which estimators that train networks keep their training, and from
            which they take it up again.
        watch: Told every epoch of such a training.
    """
    from hil.estimators import read_gains
    from hil.evaluation import fit_sources

    held_out = paths_of(validate)
    given = values_by_name(parameters, "parameters", "{'weighted': True}")
    if taken := sorted(given.keys() & signature(fit_sources).parameters.keys()):
        raise SpecError(
            f"{taken[0]} is no parameter of an estimator", hint=f"hil.fit(…, {taken[0]}=…)"
        )
    if page is not None and not held_out:
        raise SpecError(
            "a page shows how a model does on held-out recordings, and none was given",
            hint="name one: hil.fit(…, validate=…)",
        )
    result = fit_sources(
        sources_of(sources),
        estimator=estimator,
        robot=robot,
        payload=payload_of(payload),
        gains=read_gains(path_of(gains)) if gains else None,
        validate=held_out,
        out=path_of(out),
        watch=watch,
        checkpoints=None if checkpoints is None else path_of(checkpoints),
        **given,
    )
    if page is not None:
        _fit_page(result, held_out, path_of(page))
    return result


def _fit_page(result: FitReport, held_out: Iterable[Path], page: Path) -> None:
    from hil.evaluation import usable_part
    from hil.importers import load_source
    from hil.report import render_fit_report

    model = result.fitted.model
    data = {str(source): usable_part(load_source(source), model) for source in held_out}
    render_fit_report(result.fitted.folder, data, page)


def evaluate(model: AnyPath, sources: AnyPath | Iterable[AnyPath]) -> list[dict[str, Any]]:
    """Judge a saved model; one entry per source, with the keys of `FitReport.to_dict`.

    Raises:
        DataError: A source cannot be read, or was among the model's training data.
    """
    from hil.evaluation import evaluate_sources

    return evaluate_sources(path_of(model), sources_of(sources))


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
    from hil.control import run_trial
    from hil.estimators import json_bytes
    from hil.export import require_new, write_folder
    from hil.report import TRY_OUT_FILE, page_html, trial_page

    folder = path_of(out)
    require_new(folder)
    trial = run_trial(
        path_of(model),
        station=path_of(station) if station else None,
        robot=robot,
        payload=payload_of(payload),
        seed=whole_number(seed, "seed", 0),
        friction_share=friction_share,
        progress=progress or (lambda text: None),
    )
    document = json_bytes(trial.to_dict()).decode()
    write_folder({TRY_OUT_FILE: page_html(trial_page(trial)), "try-out.json": document}, folder)
    return trial
