"""The Python API: what the command line does, for scripts and notebooks.

>>> import hil
>>> experiment = hil.load("spec.yaml", "station.yaml")    # doctest: +SKIP
>>> report = hil.run(experiment, runs="runs")             # doctest: +SKIP
>>> report.verdict                                        # doctest: +SKIP
'passed'
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.campaign.desk import Desk
from hil.campaign.experiment import Experiment, load_experiment
from hil.campaign.run import RunReport, resume_experiment, run_experiment
from hil.campaign.view import describe_run, list_runs
from hil.catalogue.view import find_runs
from hil.data.dataset import Dataset
from hil.engine import Observer
from hil.plan.plan import Plan
from hil.trial.settings import FRICTION_SHARE

if TYPE_CHECKING:
    from hil.deploy.export.targets import Written
    from hil.fitting import FitReport
    from hil.identify.payload_estimate import PayloadEstimate
    from hil.identify.training_loop.problem import Watch
    from hil.rest_report import RestReport
    from hil.study.result import StudyResult
    from hil.trial.result import Trial

__all__ = [
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
    "plan",
    "rest_poses",
    "resume",
    "run",
    "study",
    "try_out",
]

AnyPath = str | Path


def load(spec: AnyPath, station: AnyPath | None = None) -> Experiment:
    """Load and check an experiment spec and its station.

    Raises:
        SpecError: With every problem of both files.
    """
    return load_experiment(Path(spec), Path(station) if station else None)


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
    from hil.campaign.robots import planned

    with planned(experiment, connect=connect) as (_, made, _):
        return made


def run(
    experiment: Experiment,
    *,
    runs: AnyPath = "runs",
    operator: str = "",
    observers: Sequence[Observer] = (),
    waivers: Mapping[str, str] | None = None,
    desk: Desk | None = None,
) -> RunReport:
    """Plan, run, record, fit, judge and report.

    Args:
        experiment: From `load`.
        runs: Where run directories are kept.
        operator: Who is at the robot; by default the user of this process.
        observers: Told about progress, each on its own thread.
        waivers: Preflight check → why its failure is accepted; recorded.
        desk: Where prompts are answered and pauses are ended; by default the console.

    Returns:
        The report; a run that ended early says so in `outcome` and `error` and is not raised.

    Raises:
        HilError: What went wrong before there was a run directory.
    """
    return run_experiment(
        experiment,
        runs=Path(runs),
        operator=operator,
        observers=observers,
        waivers=waivers,
        desk=desk,
    )


def resume(
    run: AnyPath,
    *,
    operator: str = "",
    observers: Sequence[Observer] = (),
    waivers: Mapping[str, str] | None = None,
    desk: Desk | None = None,
) -> RunReport:
    """Go on with a run that ended early: what is whole stays, the rest is measured and judged.

    Args:
        run: The run directory.
        operator: Who is at the robot; by default the user of this process.
        observers: Told about progress, each on its own thread.
        waivers: Preflight check → why its failure is accepted; recorded.
        desk: Where prompts are answered and pauses are ended; by default the console.

    Returns:
        The report over all attempts.

    Raises:
        DataError: The run has nothing left to do, or its plan or spec was changed.
        PreflightFailed: It is another robot.
        HilError: What else keeps the run from going on.
    """
    return resume_experiment(
        Path(run), operator=operator, observers=observers, waivers=waivers, desk=desk
    )


def dataset(*sources: AnyPath) -> Dataset:
    """The samples of run directories or MCAP files, with their conditions."""
    from hil.data.load import load_source

    return Dataset.concatenate([load_source(Path(source)) for source in sources])


def fit(
    sources: AnyPath | Iterable[AnyPath],
    *,
    estimator: str,
    robot: str | None = None,
    payload: str | None = None,
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
        payload: `MASS` or `MASS,X,Y,Z` [kg, m]; by default what the data says.
        gains: File with `drive_gains_nm_a`; by default what the data says.
        validate: Held-out sources, or just one.
        parameters: The estimator's own parameters.
        out: Folder in which the model's folder is made.
        page: Also write an HTML report about the held-out sources here.
        checkpoints: Folder in which estimators that train networks keep their training, and from
            which they take it up again.
        watch: Told every epoch of such a training.
    """
    from hil.fitting import fit_sources, parse_payload
    from hil.gains_file import read_gains

    held_out = _paths(validate)
    result = fit_sources(
        _paths(sources),
        estimator=estimator,
        robot=robot,
        payload=parse_payload(payload) if payload else None,
        gains=read_gains(Path(gains)) if gains else None,
        validate=held_out,
        out=Path(out),
        watch=watch,
        checkpoints=None if checkpoints is None else Path(checkpoints),
        **(parameters or {}),
    )
    if page is not None:
        _fit_page(result, held_out, Path(page))
    return result


def _fit_page(result: FitReport, held_out: Iterable[Path], page: Path) -> None:
    from hil.data.load import load_source
    from hil.fitting import usable_part
    from hil.report import render_fit_report

    model = result.fitted.model
    data = {str(source): usable_part(load_source(source), model) for source in held_out}
    render_fit_report(result.fitted.folder, data, page)


def evaluate(model: AnyPath, sources: AnyPath | Iterable[AnyPath]) -> list[dict[str, Any]]:
    """Judge a saved model; one entry per source, with the keys of `FitReport.to_dict`.

    Raises:
        DataError: A source cannot be read, or was among the model's training data.
    """
    from hil.fitting import evaluate_sources

    return evaluate_sources(Path(model), _paths(sources))


def estimate_payload(
    model: AnyPath,
    sources: AnyPath | Iterable[AnyPath],
    *,
    friction: str = "auto",
    bare: AnyPath | Iterable[AnyPath] = (),
    gain_share: float | None = None,
) -> PayloadEstimate:
    """The load that was mounted in recordings, by a saved model of the arm.

    A recording of an arm at rest tells mass and centre of mass, one of motion inertia as well.

    Args:
        model: Its folder.
        sources: Run directories or MCAP files recorded with that load, or just one.
        friction: What of the model's friction may differ on that day: nothing (`model`), an
            `offset` per joint, or an offset and a factor (`scale`); `auto` lets the recording
            choose, by stretches that are left out in turn. At rest it is `auto`.
        bare: At rest: the same program run with nothing mounted, nor declared; much smaller errors.
        gain_share: Standard deviation of a drive gain, as a share of it, for the errors; by default
            0.05, or 0.01 where they were calibrated (`hil gains`); torques have none.

    Raises:
        DataError: A source cannot be read, is of another robot, or was fitted to.
        FitError: The recording does not tell the load.
        SpecError: There is no such way to treat friction, or `bare` was given with motion.
    """
    from typing import cast

    from hil.load_fit import payload_of_sources

    return payload_of_sources(
        Path(model), _paths(sources), cast("Any", friction),
        bare=_paths(bare), gain_share=gain_share,
    )  # fmt: skip


def export_data(source: AnyPath, out: AnyPath) -> dict[str, Any]:
    """Write the samples of a run for other programs: one row each, nothing rounded.

    Args:
        source: Run directory or MCAP file.
        out: `….parquet`, `….csv` or `….npz`.

    Returns:
        `files`, `samples`, `series`, `columns`, `notes`.

    Raises:
        DataError: The source cannot be read, or no format is called so.
        PluginError: Parquet without pyarrow.
        RecordingError: A file is there already, or cannot be written.
    """
    from hil.data.exporting import export_data as exported

    return exported(Path(source), Path(out)).to_dict()


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
        to: `c` and the other targets of `hil.deploy.export.targets`.
        prefix: What files and symbols of C begin with; by default `hil`.
        unchecked: Write C without a compiler to check it with, or a URDF however far off it is.

    Raises:
        DataError: The model cannot be read.
        FitError: It is of a kind that cannot be written so, or what was written does not agree.
        PluginError: Something it takes is not installed, such as a C compiler or cvxpy.
        RecordingError: The file or folder exists already.
        SpecError: There is no such target, or an option is none of it.
    """
    from hil.deploy.export.targets import export_model as export
    from hil.identify.model_file import load_model_file

    stored = load_model_file(Path(model))
    return export(stored, Path(out), to, prefix=prefix, unchecked=unchecked)


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
    from hil.campaign.studies import entries_for, run_studies, unwatched
    from hil.report import render_report

    path = Path(run)
    found = run_studies(path, entries_for(path, name, parameters or {}), watch or unwatched)
    render_report(path)
    if found.error is not None:
        raise found.error
    return tuple(result for _, result in found.made)


def figures(
    run: AnyPath, out: AnyPath, *, formats: Sequence[str] = ("pdf",), width: str = "column"
) -> list[Path]:
    """Write the figures and tables of a run's studies as files for papers.

    Args:
        run: The run directory.
        out: Folder for the files; made when missing.
        formats: Of the figures: `pdf`, `svg`, `png`.
        width: `column` (88 mm) or `page` (181 mm).

    Returns:
        What was written.

    Raises:
        PluginError: matplotlib is not installed.
        DataError: The run has no studies, or one is damaged.
        SpecError: There is no such format or width.
    """
    from hil.report.paper import write_papers

    return write_papers(Path(run), Path(out), formats=formats, width=width)


def rest_poses(
    model: AnyPath,
    *,
    station: AnyPath | None = None,
    robot: str | None = None,
    payload: str | None = None,
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
        payload: `MASS` or `MASS,X,Y,Z` [kg, m] that is mounted.
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
    from hil.fitting import parse_payload
    from hil.rest_report import find_rest_poses

    return find_rest_poses(
        Path(model),
        station=Path(station) if station else None,
        robot=robot,
        payload=parse_payload(payload) if payload else None,
        clearance_mm=clearance_mm,
        near_deg=near_deg,
        count=count,
        seed=seed,
        unchecked=unchecked,
    )


def try_out(
    model: AnyPath,
    out: AnyPath,
    *,
    station: AnyPath | None = None,
    robot: str | None = None,
    payload: str | None = None,
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
        payload: `MASS` or `MASS,X,Y,Z` [kg, m] that is mounted and told to the model.
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
    from hil.deploy.export.exported import require_new, write_folder
    from hil.fitting import parse_payload
    from hil.identify.model_file import json_bytes
    from hil.report.render import page_html
    from hil.report.trial_page import REPORT_FILE, trial_page
    from hil.trial.trial import run_trial

    folder = Path(out)
    require_new(folder)
    trial = run_trial(
        Path(model),
        station=Path(station) if station else None,
        robot=robot,
        payload=parse_payload(payload) if payload else None,
        seed=seed,
        friction_share=friction_share,
        progress=progress or (lambda text: None),
    )
    document = json_bytes(trial.to_dict()).decode()
    write_folder({REPORT_FILE: page_html(trial_page(trial)), "try-out.json": document}, folder)
    return trial


def _paths(given: AnyPath | Iterable[AnyPath]) -> list[Path]:
    """One path or several; a text is a path, not a row of letters."""
    return [Path(given)] if isinstance(given, str | Path) else [Path(path) for path in given]


def import_recording(
    file: AnyPath,
    *,
    map_file: AnyPath,
    out: AnyPath,
    format_: str | None = None,
    rows: tuple[int, int] | None = None,
    drop_bad_rows: bool = False,
    payload: str | None = None,
) -> dict[str, Any]:
    """Turn a recording of another tool into our MCAP.

    Args:
        file: What to import.
        map_file: YAML that says what its columns are.
        out: The MCAP to be made.
        format_: Overrides the map's format.
        rows: First and last row, counted from 1, both included; the map's windows do not apply.
        drop_bad_rows: Leave rows out that make no sense instead of refusing.
        payload: `MASS` or `MASS,X,Y,Z` [kg, m] that was mounted; by default what the map says.

    Raises:
        SpecError: The map or the payload is not valid.
        DataError: The file holds rows that make no sense (with their line numbers).
    """
    from hil.data.importing import import_file
    from hil.fitting import parse_payload

    report = import_file(
        Path(file),
        Path(map_file),
        out=Path(out),
        format_=format_,
        rows=rows,
        drop_bad_rows=drop_bad_rows,
        payload=parse_payload(payload) if payload else None,
    )
    return report.to_dict()


def parse_parameters(texts: Iterable[str]) -> dict[str, Any]:
    """`name=value` texts to a dict; values are read as YAML scalars."""
    from hil.errors import SpecError
    from hil.spec.yaml_values import scalar

    pairs = [text.partition("=") for text in texts]
    for name, equals, _ in pairs:
        if not (name and equals):
            raise SpecError(f"--set {name!r} is not NAME=VALUE", hint="for example: --set seed=3")
    return {name: scalar(value) for name, _, value in pairs}
