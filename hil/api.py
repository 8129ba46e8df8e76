"""The Python API: what the command line does with experiments, recordings and models.

>>> import hil
>>> experiment = hil.load("spec.yaml", "station.yaml")    # doctest: +SKIP
>>> report = hil.run(experiment, runs="runs")             # doctest: +SKIP
>>> report.verdict                                        # doctest: +SKIP
'passed'

Every function is in `hil` as well.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lazy_loader  # type: ignore[import-untyped]

from hil.arms import AnyPayload, payload_of
from hil.control import FRICTION_SHARE
from hil.core import AnyPath, SpecError, path_of, paths_of, sources_of, values_by_name, whole_number
from hil.engine import Observer
from hil.planning import Experiment, Plan, load_experiment
from hil.runs import describe_run, find_runs, list_runs
from hil.workflow import (
    Confirm,
    Desk,
    Granted,
    RunReport,
    Unconfirmed,
    console_desk,
)

if TYPE_CHECKING:
    from hil.control import Trial, rest_poses
    from hil.evaluation import FitReport, estimate_payload
    from hil.export import export_model
    from hil.importers import dataset, export_data, import_recording
    from hil.maintenance import reidentify
    from hil.models import registry
    from hil.networks import Watch
    from hil.report import figures
    from hil.studies import StudyResult

__getattr__, _, _ = lazy_loader.attach(
    "hil",
    submod_attrs={
        "control": ["rest_poses"],
        "evaluation": ["estimate_payload"],
        "export": ["export_model"],
        "importers": ["dataset", "export_data", "import_recording"],
        "maintenance": ["reidentify"],
        "models": ["registry"],
        "report": ["figures"],
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


def load(
    spec: AnyPath,
    station: AnyPath | None = None,
    *,
    overrides: Mapping[str, object] | None = None,
) -> Experiment:
    """Load and check an experiment spec and its station.

    Args:
        spec: The spec's file.
        station: The station's file; by default as with `hil run`.
        overrides: Other values in the spec by dotted path (`excitation.waypoints`); texts are YAML,
            as those of `--set`.

    Raises:
        SpecError: With every problem of both files.
    """
    texts = {
        key: value if isinstance(value, str) else json.dumps(value, default=_plain)
        for key, value in values_by_name(overrides, "overrides", "{'excitation.seed': 3}").items()
    }
    return load_experiment(path_of(spec), path_of(station) if station else None, texts)


def _loaded(experiment: Experiment) -> Experiment:
    """What `load` gives.

    Raises:
        SpecError: It is something else.
    """
    if isinstance(experiment, Experiment):
        return experiment
    raise SpecError(
        f"{experiment!r:.80} is no experiment", hint="load it first: hil.load('spec.yaml')"
    )


def _plain(value: object) -> object:
    """A number or list of numpy's as Python's own."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise SpecError(
        f"overrides: {value!r} is nothing that YAML has",
        hint="give numbers, texts, lists and mappings",
    )


def plan(experiment: Experiment, *, connect: bool = False) -> Plan:
    """What the robot would do; nothing moves.

    A robot on a virtual clock is asked where it stands. One in wall time is not connected to: its
    plan begins in the roomiest pose of its range.

    Args:
        experiment: From `load`.
        connect: Plan from where a robot in wall time stands now, too.

    Raises:
        PlanError: No safe plan follows from the spec.
        RobotError: The robot cannot be asked where it stands, or another process holds it.
    """
    from hil.workflow import planned

    with planned(_loaded(experiment), connect=connect) as (_, made, _):
        return made


def run(
    experiment: Experiment,
    *,
    runs: AnyPath = "runs",
    operator: str = "",
    observers: Sequence[Observer] = (),
    waivers: Mapping[str, str] | None = None,
    desk: Desk | None = None,
    robot: str | None = None,
) -> RunReport:
    """Plan, run, record, fit, judge and report.

    Args:
        experiment: From `load`.
        runs: Where run directories are kept.
        operator: Who is at the robot; by default the user of this process.
        observers: Receive progress events, each on its own thread.
        waivers: Preflight check → why its failure is accepted; recorded.
        desk: Where prompts are answered and pauses are ended; by default the console.
        robot: Name of the experiment's robot, which confirms that it may move; a real robot does
            not move without it.

    Returns:
        The report; a run that ended early says so in `outcome` and `error` and is not raised.

    Raises:
        NotConfirmed: The robot is real and was not named.
        SpecError: `robot` is not the robot of the experiment.
        HilError: What else went wrong before there was a run directory.
    """
    if robot not in (None, _loaded(experiment).spec.robot):
        raise SpecError(
            f"robot={robot!r} is not the robot of {experiment.spec.name}",
            hint=f"its robot is {experiment.spec.robot!r} of {experiment.station_source}",
        )
    from hil.workflow import run_experiment

    return run_experiment(
        experiment,
        runs=path_of(runs),
        operator=operator,
        observers=observers,
        waivers=_waivers_of(waivers),
        desk=_confirming(desk, robot, operator),
    )


def _confirming(desk: Desk | None, robot: str | None, operator: str) -> Desk:
    """Return the desk; the motion counts as confirmed if the call names the robot."""
    confirm: Confirm = Unconfirmed() if desk is None else desk.confirm
    if robot is not None:
        confirm = Granted("robot=", operator, {"robot": robot})
    return replace(desk or console_desk(operator), confirm=confirm)


def resume(
    run: AnyPath,
    *,
    operator: str = "",
    observers: Sequence[Observer] = (),
    waivers: Mapping[str, str] | None = None,
    desk: Desk | None = None,
    robot: str | None = None,
) -> RunReport:
    """Go on with a run that ended early: what is whole stays, the rest is measured and judged.

    Args:
        run: The run directory.
        operator: Who is at the robot; by default the user of this process.
        observers: Receive progress events, each on its own thread.
        waivers: Preflight check → why its failure is accepted; recorded.
        desk: Where prompts are answered and pauses are ended; by default the console.
        robot: Name of the run's robot, which confirms that it may move; needed for a real robot
            unless address, payload and all of the motion were confirmed when the run began.

    Returns:
        The report over all attempts.

    Raises:
        DataError: The run has nothing left to do, or its plan or spec was changed.
        PreflightFailed: It is another robot.
        NotConfirmed: Address or payload of a real robot changed, or the arm stands where the way
            back sweeps more than was confirmed, and `robot` does not name it.
        HilError: What else keeps the run from going on.
    """
    from hil.workflow import resume_experiment

    return resume_experiment(
        path_of(run), operator=operator, observers=observers,
        desk=_confirming(desk, robot, operator), waivers=_waivers_of(waivers),
    )  # fmt: skip


def study(
    run: AnyPath,
    name: str | None = None,
    *,
    parameters: dict[str, Any] | None = None,
    watch: Callable[[str, str, int, int], None] | None = None,
) -> tuple[StudyResult, ...]:
    """Make the studies of a run's spec again, or another one; also refreshes its report.

    Args:
        run: The run directory.
        name: Name in `hil.studies`; by default all that the run's spec names.
        parameters: The study's own parameters, over those in the spec.
        watch: Told the study, what it is doing, and how many of how many steps of that are done.

    Returns:
        What they found, as it was written into the run directory.

    Raises:
        SpecError, PluginError: There is no such study or parameter.
        DataError, FitError: The run does not allow it; studies beside it have been made.
    """
    from hil.report import render_report
    from hil.workflow import entries_for, run_studies, unwatched

    folder = path_of(run)
    given = values_by_name(parameters, "parameters", "{'seed': 3}")
    found = run_studies(folder, entries_for(folder, name, given), watch or unwatched)
    render_report(folder)
    if found.error is not None:
        raise found.error
    return tuple(result for _, result in found.made)


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


def _waivers_of(given: Mapping[str, str] | None) -> dict[str, str]:
    """Why which check's failure is accepted; a waiver without a reason is none.

    Raises:
        SpecError: They are no reasons by check.
    """
    example = "{'disk': 'another disk comes on Monday'}"
    waivers = values_by_name(given, "waivers", example)
    for check, reason in waivers.items():
        if not (isinstance(reason, str) and reason.strip()):
            raise SpecError(
                f"the waiver of {check!r} gives no reason", hint=f"for example: waivers={example}"
            )
    return {check: reason.strip() for check, reason in waivers.items()}


def parse_parameters(texts: Iterable[str]) -> dict[str, Any]:
    """`name=value` texts to a dict; values are read as YAML scalars."""
    from hil.core import scalar

    pairs = [text.partition("=") for text in texts]
    for name, equals, _ in pairs:
        if not (name and equals):
            raise SpecError(f"--set {name!r} is not NAME=VALUE", hint="for example: --set seed=3")
    return {name: scalar(value) for name, _, value in pairs}
